"""The reader of the benchmark's query files."""

import json
from fractions import Fraction

import numpy as np
import pytest

from warp_bsc.cli.query_file import find_query_files, read_query_file

ROW = "1,2,-3,4,5,1"


def write(folder, *lines, name="some_vf.csv"):
    path = folder / name
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def error_of(path, **options):
    with pytest.raises(ValueError) as error:
        read_query_file(path, **options)
    message = str(error.value)
    assert message.startswith(str(path))
    return message.removeprefix(str(path))


def test_points_in_order_and_truth(tmp_path):
    rows = [f"{row},1,{row},2,{-row},4,{int(row >= 8)}" for row in range(24)]
    rows[16:] = [row[:-1] + "0" for row in rows[16:]]
    queries = read_query_file(write(tmp_path, *rows))
    assert queries.points.shape == (3, 8, 3)
    assert queries.points.dtype == np.float64
    np.testing.assert_array_equal(queries.points[1, 2], [10, 5, -2.5])
    assert queries.truth.tolist() == [False, True, False]


def test_without_truth(tmp_path):
    queries = read_query_file(write(tmp_path, *[ROW] * 8))
    assert queries.truth is None and queries.truth_path is None


def test_truth_beside(tmp_path):
    path = write(tmp_path, *[ROW] * 16)
    (tmp_path / "some_vf_mma_bool.json").write_text("[true, false]")
    queries = read_query_file(path)
    assert queries.truth.tolist() == [True, False]
    assert queries.truth_path == tmp_path / "some_vf_mma_bool.json"


def test_doubles_in_any_form_are_exact(tmp_path):
    rng = np.random.default_rng(1)
    values = np.concatenate(
        [
            rng.normal(size=12) * 2.0 ** rng.integers(-1070, 1020, size=12),
            [
                0.1,
                5e-324,
                np.finfo(float).max,
                -np.finfo(float).tiny,
                3.0,
                -(2.0**63),
                2.0**53 + 2,
                1e300,
                0,
                1,
                2,
                -7.25,
            ],
        ]
    )
    rationals = [Fraction(value) for value in values]
    for scale in (1, 3, -1, 10**40):  # not in lowest terms, negative denominators
        fields = [f"{r.numerator * scale},{r.denominator * scale}" for r in rationals]
        path = write(tmp_path, *(",".join(fields[i : i + 3]) for i in range(0, 24, 3)))
        np.testing.assert_array_equal(read_query_file(path).points.reshape(-1), values)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("vertex-face/data_0_0.csv", "vertex-face"),
        ("vertex-face/edge-edge/data.csv", "edge-edge"),
        ("edge-edge/227vf.csv", "edge-edge"),
        ("227vf.csv", "vertex-face"),
        ("227EE.csv", "edge-edge"),
    ],
)
def test_kind_by_path(tmp_path, name, kind):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    assert read_query_file(write(tmp_path, *[ROW] * 8, name=name)).kind == kind


def test_kind_given(tmp_path):
    path = write(tmp_path, *[ROW] * 8, name="data.csv")
    assert read_query_file(path, kind="edge-edge").kind == "edge-edge"
    with pytest.raises(ValueError, match=f"^kind: {path} defines neither"):
        read_query_file(path)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], ": the file is empty"),
        ([ROW] * 12, ":12: the file ends within a query"),
        ([ROW] * 3 + ["1,2,3,0,5,1"] + [ROW] * 4, ":4: y has the denominator 0"),
        ([ROW] * 6 + ["1,2,3,4,5,x"] + [ROW], ":7: not integers"),
        ([ROW] * 6 + ["1,2,3,4,5.0,1"] + [ROW], ":7: not integers"),
        ([ROW] * 6 + [""] + [ROW], ":7: not integers"),
        (["x,y,z,x,y,z"] + [ROW] * 8, ":1: not integers"),
        ([ROW, "1_0,2,-3,4,5,1"] + [ROW] * 6, ":2: not integers"),
        ([ROW, " 1,2,-3,4,5,1"] + [ROW] * 6, ":2: not integers"),
        ([ROW, "1,2,-3,4,5,1 "] + [ROW] * 6, ":2: not integers"),
        ([ROW] * 7 + ["1,2,-3,4,5,1 "], ":8: not integers"),
        ([ROW, "+1,2,-3,4,5,1"] + [ROW] * 6, ":2: not integers"),
        ([ROW, "1,2,-3,4,5,\u0661"] + [ROW] * 6, ":2: not integers"),
        ([ROW + "\f" + ROW] + [ROW] * 6, ":1: 11 columns"),
        ([ROW, f"1,2,-3,4,5,{'0' * 4300}1"] + [ROW] * 6, ":2: an integer of more than 4300 digits"),
        (["1,2,3"] * 8, ":1: 3 columns"),
        ([ROW] * 4 + [ROW + ",1"] * 4, ":5: 7 columns, but 6"),
        ([ROW] * 7 + ["1,2,3,4,1,3"], ":8: z is not exactly a double: 1/3"),
        ([ROW] * 7 + [f"{2**53 + 1},1,3,4,1,2"], ":8: x is not exactly a double"),
        ([ROW] * 7 + [f"1,{2**1080},3,4,1,2"], ":8: x is not exactly a double"),
        ([ROW] * 7 + [f"{2**1080},1,3,4,1,2"], ":8: x is larger than any double: 129"),
        ([ROW + ",1"] * 12 + [ROW + ",0"] * 4, ":13: the true result must be 0 or 1, and the same"),
        ([ROW + ",2"] * 8, ":1: the true result must be 0 or 1"),
    ],
)
def test_broken_file(tmp_path, lines, message):
    error = error_of(write(tmp_path, *lines))
    assert error.startswith(message)
    assert len(error) < 200


def test_file_that_is_not_text(tmp_path):
    path = tmp_path / "some_vf.csv"
    path.write_bytes(bytes(range(256)) * 4)
    assert error_of(path)


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        ("[true]", "1 true results for the 2 queries"),
        ("[0, 1]", "not a list of true and false"),
        (f"[{'9' * 5000}, true]", "not a list of true and false"),
        ("[tru", "not JSON"),
        ("[" * 100_000, "not JSON"),
    ],
)
def test_broken_truth_beside(tmp_path, truth, message):
    path = write(tmp_path, *[ROW] * 16)
    truth_path = tmp_path / "some_vf_mma_bool.json"
    truth_path.write_text(truth)
    with pytest.raises(ValueError, match=message) as error:
        read_query_file(path)
    assert str(error.value).startswith(str(truth_path))


def test_true_answers_in_both_places(tmp_path):
    path = write(tmp_path, *[ROW + ",1"] * 8, *[ROW + ",0"] * 8)
    truth_path = tmp_path / "some_vf_mma_bool.json"
    truth_path.write_text("[true, false]")
    assert read_query_file(path).truth.tolist() == [True, False]
    truth_path.write_text("[true, true]")
    assert error_of(path) == f":9: the true result is 0, but 1 in {truth_path}"


def test_find_files_of_folder(tmp_path):
    (tmp_path / "b/edge-edge").mkdir(parents=True)
    paths = [write(tmp_path, ROW, name=name) for name in ("a.csv", "b/edge-edge/c.csv")]
    (tmp_path / "a_mma_bool.json").write_text(json.dumps([]))
    (tmp_path / "folder_vf.csv").mkdir()
    assert find_query_files([tmp_path]) == paths
    assert find_query_files(reversed(paths)) == paths[::-1]


def test_find_files_that_are_missing(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        find_query_files([tmp_path / "gone.csv"])
    with pytest.raises(FileNotFoundError, match=r"no \.csv file in this folder"):
        find_query_files([tmp_path])
