"""Writes every collision, intersection and proximity of a replay as columns, in the compressed format of NumPy."""

import io
import json
import os
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from itertools import islice, pairwise
from typing import Any, cast

import numpy as np

from ..usd.segment import Segment
from .limit import not_listed
from .outputs import ReplayOutput, without_last_eighth
from .results import AnyPairs, IntervalResult
from .scene_contacts import SceneContacts
from .scene_pairs import ALL_PHASES, ELEMENT_WORDS, KINDS
from .scene_proximities import SceneProximities
from .summary import Summary

_PHASES = (*ALL_PHASES, "")  # the last of contacts that are not compared with intersections
_NORMAL_UNIT = 2**15 - 1
"""Units of a component of a normal: it is within 1.6e-5."""
_ROW = np.dtype(
    [
        ("interval", "<u4"),
        ("kind", "u1"),
        ("phase", "u1"),
        ("element", "u1", 2),
        ("mesh", "<u4", 2),
        ("index", "<i4", (2, 2)),
        ("toi", "<f4"),
        ("position", "<f4", 3),
        ("normal", "<i2", 3),
        ("distance", "<f4"),
    ]
)
"""What is kept of a pair; its fields are the columns."""
_BLOCK, _BLOCKS_AT_ONCE = 2**20, 32  # bytes that a thread deflates, and number of blocks in memory
_LEVEL = 4  # 2% more bytes than at zlib's default, in 0.6 of its time


class HitsNpz(ReplayOutput):
    """A ``.npz`` file: columns with a row for each pair.

    A pair takes less than 30 bytes, a fifteenth of its text in JSON. Its columns, and what their numbers stand for::

        hits = np.load("hits.npz")
        hits["starts"][hits["interval"]], hits["ends"][hits["interval"]]  # time codes; toi is the share between them
        hits["kinds"][hits["kind"]], hits["phases"][hits["phase"]]  # as in CSV, which has the same rows
        hits["prims"][hits["mesh"]], hits["meshes"][hits["mesh"]]  # paths and names of both sides, shape [n, 2]
        hits["elements"][hits["element"]], hits["index"]  # shape [n, 2], and [n, 2, 2]: one and -1, or both of an edge
        hits["position"], hits["normal"] / 32767.0  # shape [n, 3]; normals are rounded, 0 for pairs at rest
        json.loads(str(hits["facts"]))  # the scene, options, whether all intervals are there, what a limit leaves out

    Times of impact, positions and distances are in single precision. Pairs at rest, intersections and proximities, are
    at ``toi`` 0, in the last interval some at 1. The whole is on disk until the file is finished, so that memory does
    not grow with it: the columns of an interval one after the other, then those of the next.
    """

    def __init__(self, path: str | os.PathLike, *, facts: dict[str, Any], interval_count: int):
        """Opens the file.

        Args:
            path: The file.
            facts: What :func:`~warp_bsc.scene_replay.hit_files.replay_facts` returns.
            interval_count: Number of intervals of the scene.

        Raises:
            OSError: If it cannot be written.
        """
        super().__init__(path)
        self._rows = tempfile.TemporaryFile(dir=self.file.folder)  # noqa: SIM115 (closed when discarded)
        self._facts, self._last = facts, interval_count - 1
        self._meshes: dict[tuple[str, str], int] = {}  # numbers of names and prims
        self._ends: list[int] = []  # numbers of rows up to each interval
        self._times: list[tuple[float, float]] = []

    def add(self, result: IntervalResult) -> None:
        """Appends the rows of an interval."""
        interval = result.summary
        all_pairs = result.pairs(is_last=interval.index == self._last)
        rows = np.concatenate([self._rows_of(pairs, interval.start) for pairs in all_pairs])
        rows["interval"] = len(self._ends)
        before = self._ends[-1] if self._ends else 0
        self._rows.seek(before * _ROW.itemsize)
        self._rows.write(b"".join(rows[name].tobytes() for name in _ROW.names or ()))
        self._ends.append(before + len(rows))
        self._times.append((interval.start, interval.end))

    def finish(self, summary: Summary) -> None:
        """Compresses the columns, and moves the file to its path."""
        count = min(len(summary.intervals), len(self._ends))  # the last interval may be missing
        self.file.truncate(0)
        part = summary.first(count)
        facts = self._facts | {"complete": part.is_complete, "stopped": part.stopped, "hits": part.hits}
        missing = not_listed(part, with_end=part.is_complete)
        facts["not_listed"] = asdict(missing) if missing else None
        facts["left_out"] = summary.scene.left_out
        names, prims = ([names[side] for names in self._meshes] for side in range(2))
        words = {"meshes": names, "prims": prims, "kinds": KINDS, "phases": _PHASES, "elements": ELEMENT_WORDS}
        starts, ends = np.array(self._times[:count], dtype=float).reshape(-1, 2).T
        with zipfile.ZipFile(cast(Any, self.file), "w", zipfile.ZIP_DEFLATED) as archive:
            values = {"facts": json.dumps(facts), "starts": starts, "ends": ends} | words
            for name, value in values.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, np.asarray(value), allow_pickle=False)
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                for name in _ROW.names or ():
                    self._write_column(archive, pool, name, count)
        self.file.commit()
        self._rows.close()

    def shrink(self) -> bool:
        """Drops the last eighth of the intervals."""
        if not self._ends:
            return False
        self._ends = without_last_eighth(self._ends)
        del self._times[len(self._ends) :]
        self.file.truncate(0)
        self._rows.truncate((self._ends[-1] if self._ends else 0) * _ROW.itemsize)
        return True

    def discard(self) -> None:
        """Removes the temporary files."""
        self._rows.close()
        super().discard()

    def _write_column(self, archive: zipfile.ZipFile, pool: ThreadPoolExecutor, name: str, count: int) -> None:
        """Writes a column of some intervals to the archive, as zipfile would, but deflated in blocks by threads."""
        info = zipfile.ZipInfo(f"{name}.npy")
        info.compress_type, info.flag_bits, info.header_offset = zipfile.ZIP_DEFLATED, 0x08, self.file.tell()
        self.file.write(info.FileHeader(zip64=True))
        start, blocks, info.CRC = self.file.tell(), self._blocks(name, count), 0
        while some := list(islice(blocks, _BLOCKS_AT_ONCE)):
            for block, deflated in zip(some, pool.map(_deflate, some), strict=True):
                self.file.write(deflated)
                info.CRC, info.file_size = zlib.crc32(block, info.CRC), info.file_size + len(block)
        self.file.write(zlib.compressobj(wbits=-15).flush())  # the end of the stream
        info.compress_size = self.file.tell() - start
        # the sizes follow the data, as flag 0x08 says
        self.file.write(b"PK\x07\x08" + struct.pack("<LQQ", info.CRC, info.compress_size, info.file_size))
        archive.filelist.append(info)
        archive.start_dir = self.file.tell()

    def _blocks(self, name: str, count: int) -> Iterator[bytearray]:
        """Yields the bytes of a column of some intervals, the header of NumPy's format first."""
        dtype, offset = cast(Any, _ROW.fields)[name]
        shape = (self._ends[count - 1] if count else 0, *dtype.shape)
        header = {"descr": np.lib.format.dtype_to_descr(dtype.base), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(stream := io.BytesIO(), header)
        block = bytearray(stream.getvalue())
        for first, last in pairwise([0, *self._ends[:count]]):
            self._rows.seek(first * _ROW.itemsize + (last - first) * offset)
            block += self._rows.read((last - first) * dtype.itemsize)
            if len(block) >= _BLOCK:
                yield block
                block = bytearray()
        yield block

    def _rows_of(self, pairs: AnyPairs, start: float) -> np.ndarray:
        """Returns the rows of pairs of an interval that starts at a time."""
        rows = np.zeros(len(pairs), dtype=_ROW)
        rows["element"], rows["index"], rows["position"] = pairs.elements, pairs.indices, pairs.position
        rows["kind"], rows["mesh"] = pairs.kind, self._numbers(pairs.segment, pairs.meshes)
        phase = np.full(len(pairs), -1) if pairs.phase is None else pairs.phase
        rows["phase"] = np.where(phase < 0, len(ALL_PHASES), phase)
        if isinstance(pairs, SceneContacts):
            rows["toi"], rows["normal"] = pairs.toi, np.rint(_NORMAL_UNIT * pairs.normal)
        else:
            rows["toi"] = pairs.time > start
        if isinstance(pairs, SceneProximities):
            rows["distance"] = pairs.distance
        return rows

    def _numbers(self, segment: Segment, meshes: np.ndarray) -> np.ndarray:
        """Returns the numbers in the file of meshes of a segment."""
        number = np.zeros(len(segment.meshes), dtype=np.uint32)
        for mesh in np.unique(meshes).tolist():
            part = segment.meshes[mesh]
            number[mesh] = self._meshes.setdefault((part.name, part.path), len(self._meshes))
        return number[meshes]


def _deflate(block: bytearray) -> bytes:
    """Returns a part of a stream of zlib's that needs none of the parts before."""
    deflater = zlib.compressobj(_LEVEL, wbits=-15)
    return deflater.compress(block) + deflater.flush(zlib.Z_FULL_FLUSH)
