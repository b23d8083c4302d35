"""Benchmark queries with their truth, read from the folder of test data that lies beside the project.

Wang et al. 2021, "A Large Scale Benchmark and an Inclusion-Based Algorithm for Continuous Collision Detection", and the
cloth-funnel frames of Belgrod et al. 2023. Tests skip when the folder is missing.
"""

import csv
import json
import os
from pathlib import Path

import numpy as np


def data_folder():
    """Returns the folder of test data, $WARP_BSC_DATA or ../shared/data from the project's root; None when missing."""
    folder = Path(os.environ.get("WARP_BSC_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
    return folder if folder.is_dir() else None


def _read_rows(path):
    with open(path, newline="") as file:
        return [[int(field) for field in row] for row in csv.reader(file) if row]


def _points(rows):
    """Returns float64 points (n, 8, 3) from rows of three rationals; the division of integers is correctly rounded."""
    return np.array([[row[i] / row[i + 1] for i in (0, 2, 4)] for row in rows]).reshape(-1, 8, 3)


def load_queries():
    """Reads the hand-made queries.

    Returns:
        List with an entry for each file: (family, kind, points, truth), kind "vertex_face" or "edge_edge", points
        float64 of shape (n, 8, 3), truth bool of shape (n,).
    """
    queries = []
    for path in sorted((data_folder() / "queries").glob("*/*/*.csv")):
        rows = _read_rows(path)
        truth = np.array([row[6] for row in rows[::8]], dtype=bool)
        queries.append((path.parts[-3], path.parts[-2].replace("-", "_"), _points(rows), truth))
    return queries


def load_cloth_funnel_queries():
    """Reads the queries of cloth-funnel's frames.

    Returns:
        List of (family, kind, points, truth), as :func:`load_queries` does.
    """
    folder = data_folder() / "frames" / "cloth-funnel"
    queries = []
    for kind, name in (("vertex_face", "227vf"), ("edge_edge", "227ee")):
        truth = np.array(json.loads((folder / f"{name}_mma_bool.json").read_text()), dtype=bool)
        queries.append(("cloth-funnel", kind, _points(_read_rows(folder / f"{name}.csv")), truth))
    return queries
