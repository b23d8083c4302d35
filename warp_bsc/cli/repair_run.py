"""A run of warp-bsc repair: finds collisions, repairs, and writes the USD layer and what it takes to resume."""

import argparse
import functools
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from .._atomic_file import OutputFile, naming, unfinished_path
from ..mesh_files.file_scene import FrameFiles
from ..repairing.shot.findings import Finding, MeshPair, count_found, find_collisions
from ..repairing.shot.journal import Journal
from ..repairing.shot.repair_shot import repair_shot
from ..repairing.shot.report import write_page
from ..repairing.shot.stretch import RepairedStretch
from ..scene_replay.intervals import replay
from ..scene_replay.results import IntervalResult
from ..usd.scene import Scene
from ..usd.write.points_layer import PointsLayer
from .device import loading_kernels
from .error_boundary import describe, finish_outputs
from .interrupts import INTERRUPTS, Interrupted
from .progress import RunProgress


class RepairRun:
    """Finds collisions, repairs, and writes the USD layer of the stretches that are done, or the files of the frames.

    Attributes:
        scene: The scene.
        journal: The findings, and the stretches with their frames, also those of an earlier run.
        found: Numbers of what was found before, by its name.
        unrepaired_pairs: Pairs of meshes that stay as they are.
        stretches: The stretches, without their frames.
        frames: Times and numbers of moved vertices of the moved frames, by stretch.
        distorted: Smallest and largest lengths of edges in frames that are not good, by time.
        earlier: Number of stretches of an earlier run.
        seconds: Times to find and to repair [s].
        interrupt: The signal that ended it.
        problems: Messages of errors.
        notes: Messages on what else did not work.
        output: Path of the USD layer, or of the files; a layer in which nothing is moved shows the scene as it is.
        page: Path of the report, once it is written.
    """

    def __init__(
        self,
        scene: Scene,
        layer: PointsLayer | FrameFiles,
        arguments: argparse.Namespace,
        device: str,
        facts: dict[str, Any],
    ):
        """Opens the files. The facts, scene and options, must be the same in a run that resumes this one."""
        self.scene, self._layer, self._arguments, self._device = scene, layer, arguments, device
        try:
            self.journal = Journal(unfinished_path(arguments.output), facts, resume=arguments.resume)
        except BaseException:
            self._layer.discard()
            raise
        self.found: dict[str, int] = {}
        self.unrepaired_pairs: tuple[MeshPair, ...] = ()
        self.stretches: list[RepairedStretch] = []
        self.frames: list[list[tuple[float, int]]] = []
        self.distorted: dict[float, tuple[float, float]] = {}
        self.earlier = 0
        self.seconds = {"finding": 0.0, "repairing": 0.0}
        self.interrupt: KeyboardInterrupt | None = None
        self.problems: list[str] = []
        self.notes: list[str] = []
        self.output = arguments.output
        self.page: Path | None = None

    @property
    def is_whole(self) -> bool:
        """Whether neither a signal nor an error has stopped it."""
        return not self.interrupt and not self.problems

    @property
    def _stopped(self) -> str:
        return str(self.interrupt or "") or "; ".join(self.problems)

    @property
    def has_moved(self) -> bool:
        """Whether a frame is moved."""
        return any(stretch.moved for stretch in self.stretches)

    def run(self) -> None:
        """Repairs the scene as far as no signal or error stops it, and writes the layer."""
        done = 0
        with INTERRUPTS.held():
            try:
                with INTERRUPTS.raised():
                    for number in self._repair():
                        done = number
                        INTERRUPTS.check()
                    done = len(self.scene)
            except KeyboardInterrupt as stopped:
                self.interrupt = stopped if isinstance(stopped, Interrupted) else Interrupted()
            except Exception as error:
                self.interrupt = INTERRUPTS.came  # a library may have turned it into another error
                self.problems += [] if self.interrupt else [describe(error)]
            is_layer = isinstance(self._layer, PointsLayer)
            if not done or (is_layer and not self.is_whole and not self.has_moved):
                return  # an earlier file is better than one of a run that came to nothing
            if done < len(self.scene):
                self._layer.end = self.scene.times[done]
            self._finish()

    def close(self) -> None:
        """Removes the temporary files; what a later run can resume stays."""
        self._layer.discard()
        self.journal.close(remove=self.is_whole)

    def _repair(self) -> Iterator[int]:
        """Finds and repairs; yields the number of intervals that are done after each stretch."""
        scene, arguments, journal = self.scene, self._arguments, self.journal
        started = time.perf_counter()
        if journal.findings is None:
            unrepaired_pairs = () if arguments.include_initial else None
            findings = find(scene, "Finding", arguments, self._device, unrepaired_pairs)
            self._keep(lambda: journal.begin(findings))
        assert journal.findings is not None
        self.found = count_found(journal.findings, arguments.min_distance)
        self.unrepaired_pairs = journal.findings[0].unrepaired_pairs
        if near := sum(finding.initially_near for finding in journal.findings):
            self.notes.append(
                f"pairs that are nearer than {arguments.min_distance:g} from the start: {near:,}, which are not "
                "counted; where the scene is repaired, they come no nearer"
            )
        if kept_hits := sum(finding.kept_hits for finding in journal.findings):
            self.notes.append(f"collisions of meshes that are not moved with each other: {kept_hits:,}, not counted")
        if ignored := {pair for finding in journal.findings for pair in finding.ignored_pairs}:
            self.notes.append(
                f"pairs of meshes that collide, and are meant to or ignored: {len(ignored):,}, not counted and not "
                f"repaired, the first is {' with '.join(min(ignored))}"
            )
        self.seconds["finding"] = time.perf_counter() - started
        done = 0
        for stretch in journal.stretches(scene):
            self._add(stretch)
            done = _interval_after(scene, stretch)
            yield done
        self.earlier = len(self.stretches)
        started = time.perf_counter()
        with RunProgress("Repairing") as progress, loading_kernels(self._device, progress.console):
            progress.show(done, len(scene))
            options = {name: getattr(arguments, name) for name in ("keep", "rigid", "max_move", "min_distance")}
            options |= {"device": self._device, "start": done}
            show = functools.partial(progress.show, total=len(scene))
            for stretch in repair_shot(scene, journal.findings, **options, progress=show):
                scene.files.check()
                if journal.is_open:
                    self._keep(functools.partial(journal.add, stretch))
                self._add(stretch)
                self.seconds["repairing"] = time.perf_counter() - started
                yield _interval_after(scene, stretch)

    def _keep(self, write: Callable[[], None]) -> None:
        """Writes to the journal; without space for it, the run goes on without one."""
        try:
            with naming(self.journal.path):
                write()
        except OSError as error:
            self.journal.close(remove=True)
            self.notes.append(f"a later run cannot resume this one: {describe(error)}")

    def _add(self, stretch: RepairedStretch) -> None:
        """Adds a stretch to the layer and to the numbers."""
        for frame in stretch.frames:
            with naming(self._arguments.output):
                self._layer.add(frame)
        self.frames.append([(frame.time, len(frame.vertices)) for frame in stretch.frames])
        self.distorted |= stretch.distorted()
        self.stretches.append(replace(stretch, frames=()))

    def _finish(self) -> None:
        """Writes the layer, without its last frames if the disk is full."""
        facts = self.found | {"stretches": len(self.stretches)}

        def finish(layer: PointsLayer | FrameFiles, shortage: str) -> None:
            stopped = shortage or self._stopped
            layer.finish(facts | ({"stopped": stopped} if stopped else {}))

        self.problems += finish_outputs({self._arguments.output: self._layer}, finish)

    def report(self, page: OutputFile, kept: dict[str, str], after: list[Finding] | None) -> None:
        """Writes the page of what is done; ``after`` is what a replay finds in the layer, None if it was not replayed.

        Without space on the disk there is no page, and a problem says so.
        """
        assert self.journal.findings is not None
        try:
            if self.stretches and not self.journal.is_open:
                raise OSError(f"it needs {self.journal.path}, which could not be written")
            stretches = functools.partial(self.journal.stretches, self.scene)
            found = {"before": self.journal.findings, "after": after, "min_distance": self._arguments.min_distance}
            with naming(page.name):
                write_page(page, self.scene, stretches=stretches, **found, kept=kept, stopped=self._stopped)
            self.page = page.path
        except Exception as error:
            self.problems.append(f"{page.name}: not written: {describe(error)}")

    def facts(self, kept: dict[str, str], remaining: dict[str, int]) -> dict[str, Any]:
        """Returns what was done, for programs."""
        stretches = []
        for stretch, frames in zip(self.stretches, self.frames, strict=True):
            values = asdict(stretch)
            moves, ratios = values.pop("largest_moves"), values.pop("edge_ratios")
            of_frames = [
                {"time": time, "moved": moved, "largest_move": move, "edge_ratio": ends}
                for (time, moved), move, ends in zip(frames, moves, ratios, strict=True)
            ]
            stretches.append(values | {"edge_ratio": stretch.edge_ratio, "frames": of_frames})
        return {
            "scene": self.scene.path,
            "output": str(self.output),
            "before": self.found,
            "remaining": remaining,
            "initially_near": sum(finding.initially_near for finding in self.journal.findings or ()),
            "unrepaired_pairs": self.unrepaired_pairs,
            "kept": kept,
            "distorted": list(self.distorted),
            "stretches": stretches,
            "seconds": self.seconds,
        }


def find(
    scene: Scene,
    activity: str,
    arguments: argparse.Namespace,
    device: str,
    unrepaired_pairs: tuple[MeshPair, ...] | None,
) -> list[Finding]:
    """Returns what an exact replay of a scene finds, and shows its progress; pairs as of :func:`.find_collisions`."""
    options = {"keep": arguments.keep, "unrepaired_pairs": unrepaired_pairs, "min_distance": arguments.min_distance}
    return list(find_collisions(scene, tracked(scene, activity, arguments.device), **options, device=device))


def _interval_after(scene: Scene, stretch: RepairedStretch) -> int:
    """Returns the number of the interval after a stretch; one that ends where it starts is the last, without motion."""
    return len(scene) if stretch.start == stretch.end else scene.times.index(stretch.end)


def tracked(scene: Scene, activity: str, device: str | None) -> Iterator[IntervalResult]:
    """Yields what an exact replay finds, and shows its progress."""
    with RunProgress(activity) as progress:
        progress.show(0, len(scene))
        for result in replay(scene, method="exact", device=device):
            yield result
            progress.show(result.summary.index + 1, len(scene), f"time {result.summary.end:g}")
