"""The films in assets, and what their programs do without Blender."""

import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

FOLDER = Path(__file__).parents[2]
PROGRAMS = sorted((FOLDER / "examples" / "figures").glob("film_*.py"))
ONE, ALL = 3_000_000, 12_000_000  # bytes at most


def load_module(path):
    """A script, as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


film = load_module(FOLDER / "examples" / "figures" / "film.py")


def film_of(program):
    """The path of the film that the command in assets/README.md, a line of a code block, makes."""
    commands = (FOLDER / "assets" / "README.md").read_text(encoding="utf-8")
    (name,) = re.findall(rf"^python examples/figures/{program.name} .*?(assets/\w+\.webp)$", commands, re.MULTILINE)
    return FOLDER / name


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)
def test_film_moves_and_is_small(program):
    path = film_of(program)
    assert path.stat().st_size <= ONE
    with PIL.Image.open(path) as moving:
        assert moving.n_frames >= 24
        assert moving.info["loop"] == 0  # for ever
        assert 480 <= moving.width <= 900
        first = np.asarray(moving.convert("RGB"), dtype=float)
        changes = []
        for frame in range(1, moving.n_frames):
            moving.seek(frame)
            changes.append(np.abs(np.asarray(moving.convert("RGB")) - first).mean())
        assert max(changes) > 0.5


def test_all_films_are_small():
    films = list((FOLDER / "assets").glob("*.webp"))
    assert sorted(films) == sorted(film_of(program) for program in PROGRAMS)
    assert sum(path.stat().st_size for path in films) <= ALL


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)
def test_program_needs_blender_only_to_render(program, monkeypatch):
    monkeypatch.setitem(sys.modules, "bpy", None)  # an import raises
    assert callable(load_module(program).make)
    with pytest.raises(ImportError):
        film.Studio((64, 64), (0.0, -1.0, 0.0), (0.0, 0.0, 0.0))


def make():
    """A film of two parts of three frames, each brighter than the last one."""
    return film.Film(6, lambda frame: PIL.Image.new("RGB", (8, 12), (40 * frame,) * 3), duration=40, pause=500, part=3)


def write(monkeypatch, *arguments):
    """Runs a program with arguments of the command line."""
    monkeypatch.setattr(sys, "argv", ["film", *map(str, arguments)])
    film.main("Films nothing.", make)


def test_film_is_written_with_its_times(monkeypatch, tmp_path):
    write(monkeypatch, tmp_path / "a.webp")
    with PIL.Image.open(tmp_path / "a.webp") as moving:
        assert moving.n_frames == 6 and moving.info["loop"] == 0
        durations = []
        for frame in range(6):
            moving.seek(frame)
            assert abs(np.asarray(moving.convert("RGB")).mean() - 40 * frame) < 5
            durations.append(moving.info["duration"])
    assert durations == [40, 40, 500, 40, 40, 500]


def test_strip_shows_the_frames_beside_each_other(monkeypatch, tmp_path):
    write(monkeypatch, tmp_path / "a.png", "--frames", 1, 4)
    strip = np.asarray(PIL.Image.open(tmp_path / "a.png").convert("RGB"))
    assert strip.shape == (12, 16, 3)
    assert (strip[:, :8] == 40).all() and (strip[:, 8:] == 160).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a.gif"], "picture"),
        (["a.webp", "--frames", "1"], "--frames"),
        (["a.png", "--frames", "6"], "--frames"),
        (["none/a.png"], "picture"),
    ],
)
def test_bad_arguments_are_named(monkeypatch, tmp_path, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        write(monkeypatch, *arguments)
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_colors_are_linear_in_light():
    np.testing.assert_allclose(film.linear("#ff8000"), [1.0, 0.2158605, 0.0], atol=1e-6)


def test_dots_are_where_they_should_be():
    picture = PIL.Image.new("RGB", (20, 10), "white")
    film.dots(picture, [[5.0, 5.0]], "#ff0000", 2.0)
    red = np.asarray(picture)[:, :, 1] < 128
    rows, columns = np.nonzero(red)
    assert abs(rows.mean() + 0.5 - 5.0) < 0.3 and abs(columns.mean() + 0.5 - 5.0) < 0.3
    assert 9 <= red.sum() <= 16
