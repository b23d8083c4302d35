"""Reads the query files of the CCD benchmark: elementary queries in exact rational numbers, with their true results.

A file holds eight rows for each query, the points in the order of :func:`warp_bsc.query_vertex_face` or
:func:`warp_bsc.query_edge_edge`. A row holds six integers, the numerator and denominator of x, y and z, or seven: the
seventh is the query's true result, 0 or 1, the same on all of its rows. The true results may also be in
``NAME_mma_bool.json`` next to ``NAME.csv``, as a list of true and false.

Files of vertex-face and of edge-edge queries look the same. The folder, ``vertex-face`` or ``edge-edge``, or a name
that ends in ``vf`` or ``ee`` defines their kind.
"""

import json
import os
import re
import reprlib
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

KINDS = ("vertex-face", "edge-edge")

_INTEGERS = re.compile("-?[0-9]+(,-?[0-9]+)*")
"""A row; Python's ``int`` would accept more, such as 1_0 for ten."""


@dataclass(frozen=True)
class QueryFile:
    """The queries of a file.

    Attributes:
        path: The file.
        kind: ``"vertex-face"`` or ``"edge-edge"``.
        points: The points, exactly the numbers of the file, float64, shape [query_count, 8, 3].
        truth: The true results, bool, shape [query_count]; None if they are not known.
        truth_path: The file with the true results; None if they are not known.
    """

    path: Path
    kind: str
    points: np.ndarray
    truth: np.ndarray | None
    truth_path: Path | None


def find_query_files(paths: Iterable[str | os.PathLike]) -> list[Path]:
    """Returns the given files, with each folder replaced by all ``.csv`` files in it and below.

    Raises:
        FileNotFoundError: If a path does not exist, or a folder has no such file.
    """
    files = []
    for path in map(Path, paths):
        if path.is_dir():
            below = sorted(file for file in path.rglob("*.csv") if not file.is_dir())
            if not below:
                raise FileNotFoundError(f"{path}: no .csv file in this folder")
            files += below
        elif path.exists():
            files.append(path)
        else:
            raise FileNotFoundError(f"{path}: no such file")
    return files


def read_query_file(path: str | os.PathLike, *, kind: str | None = None) -> QueryFile:
    """Reads a file of queries.

    Args:
        path: The file.
        kind: ``"vertex-face"`` or ``"edge-edge"``; default: that of the path.

    Raises:
        ValueError: If the path does not define the kind, the file is malformed, a number in it is not exactly a double
            (the result would be that of another query), or the true results in both files differ. The message names
            the file and the line.
    """
    path = Path(path)
    kind = kind or _kind_of(path)
    rows = _read_rows(path)
    points = _divide(path, rows[:, 0:6:2], rows[:, 1:6:2]).reshape(-1, 8, 3)
    truth, truth_path = _truth_beside(path, len(points))
    if rows.shape[1] == 7:
        truth_of_rows = _truth_of_rows(path, rows[:, 6])
        if truth is not None and (truth != truth_of_rows).any():
            query = int(np.argmax(truth != truth_of_rows))
            values = f"is {truth_of_rows[query]:d}, but {truth[query]:d} in {truth_path}"
            raise ValueError(f"{path}:{8 * query + 1}: the true result {values}")
        truth, truth_path = truth_of_rows, path
    return QueryFile(path, kind, points, truth, truth_path)


def _kind_of(path: Path) -> str:
    for folder in path.absolute().parts[-2::-1]:  # the innermost first
        if folder in KINDS:
            return folder
    for ending, kind in zip(("vf", "ee"), KINDS, strict=True):
        if path.stem.lower().endswith(ending):
            return kind
    raise ValueError(f"kind: {path} defines neither vertex-face nor edge-edge queries")


def _read_rows(path: Path) -> np.ndarray:
    """Returns the integers of a file, shape [row_count, 6 or 7], int64 where all fit and Python's own otherwise."""
    text = path.read_text(encoding="ascii", errors="replace").rstrip("\n")
    if not text:
        raise ValueError(f"{path}: the file is empty")
    lines = text.split("\n")
    width = lines[0].count(",") + 1
    if width not in {6, 7}:
        raise ValueError(f"{path}:1: {width} columns; a row has 6, or 7 with the true result")
    rows = []
    for number, line in enumerate(lines, 1):
        if not _INTEGERS.fullmatch(line):
            raise ValueError(f"{path}:{number}: not integers with commas between them: {line[:60]!r}")
        try:
            row = [int(field) for field in line.split(",")]
        except ValueError:
            most = sys.get_int_max_str_digits()
            raise ValueError(f"{path}:{number}: an integer of more than {most} digits") from None
        if len(row) != width:
            raise ValueError(f"{path}:{number}: {len(row)} columns, but {width} on the lines before")
        rows.append(row)
    if len(rows) % 8:
        raise ValueError(f"{path}:{len(rows)}: the file ends within a query: {len(rows)} rows are not a multiple of 8")
    try:
        return np.array(rows, dtype=np.int64)
    except OverflowError:
        return np.array(rows, dtype=object)


def _divide(path: Path, numerators: np.ndarray, denominators: np.ndarray) -> np.ndarray:
    """Returns the exact quotients as doubles, shape [row_count, 3]."""
    quotients = np.zeros(numerators.shape)
    exact = np.zeros(numerators.shape, bool)
    if numerators.dtype != object:
        # A double divided by a power of two is exact.
        exact = (abs(numerators) <= 2**53) & (denominators > 0) & (denominators & (denominators - 1) == 0)
        np.divide(numerators, denominators, out=quotients, where=exact)
    for row, column in np.argwhere(~exact):
        where = f"{path}:{row + 1}: {'xyz'[column]}"
        numerator, denominator = int(numerators[row, column]), int(denominators[row, column])
        if denominator == 0:
            raise ValueError(f"{where} has the denominator 0")
        try:
            quotient = numerator / denominator
        except OverflowError:
            raise ValueError(f"{where} is larger than any double: {_ratio(numerator, denominator)}") from None
        p, q = quotient.as_integer_ratio()
        if p * denominator != q * numerator:
            raise ValueError(f"{where} is not exactly a double: {_ratio(numerator, denominator)}")
        quotients[row, column] = quotient
    return quotients


def _ratio(numerator: int, denominator: int) -> str:
    """Returns a ratio as text, shortened if it is long."""
    return f"{reprlib.repr(numerator)}/{reprlib.repr(denominator)}"


def _truth_of_rows(path: Path, column: np.ndarray) -> np.ndarray:
    truth = column.reshape(-1, 8)
    wrong = (truth != truth[:, :1]) | ((truth != 0) & (truth != 1))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise ValueError(f"{path}:{row + 1}: the true result must be 0 or 1, and the same on the 8 rows of a query")
    return truth[:, 0].astype(bool)


def _truth_beside(path: Path, query_count: int) -> tuple[np.ndarray | None, Path | None]:
    truth_path = path.with_name(f"{path.stem}_mma_bool.json")
    if not truth_path.exists():
        return None, None
    try:
        truth = json.loads(truth_path.read_bytes(), parse_int=float)  # which takes any number of digits
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{truth_path}: not JSON: {error}") from None
    if not isinstance(truth, list) or not all(isinstance(value, bool) for value in truth):
        raise ValueError(f"{truth_path}: not a list of true and false")
    if len(truth) != query_count:
        raise ValueError(f"{truth_path}: {len(truth)} true results for the {query_count} queries of {path}")
    return np.array(truth), truth_path
