"""A run of warp-bsc replay: takes intervals as they are found, and writes them to files and to the terminal."""

import argparse
import contextlib
import time
from collections.abc import Generator
from typing import Any

from .._atomic_file import STDOUT, naming
from ..scene_replay.baseline import Baseline
from ..scene_replay.depths import DepthRecorder
from ..scene_replay.earlier import find_earlier
from ..scene_replay.hit_columns import HitsNpz
from ..scene_replay.hit_files import HitsCsv, HitsJson, replay_facts
from ..scene_replay.html_report import ReportPage
from ..scene_replay.intervals import replay
from ..scene_replay.limit import limit_rows, not_listed
from ..scene_replay.outputs import ReplayOutput
from ..scene_replay.results import IntervalResult, IntervalSummary, Work
from ..scene_replay.summary import Summary
from ..scene_replay.threads import WriteBehind
from ..scene_replay.usd_overlay import SHOWN_BY, Overlay
from ..usd.scene import Scene
from .error_boundary import describe, finish_outputs
from .exit_status import ExitStatus
from .interrupts import INTERRUPTS, Interrupted
from .progress import RunProgress
from .replay_options import command_of, repair_command_of
from .replay_tables import print_new, print_repair, print_replay, print_work
from .tables import Console, say

_MOST_TO_MEASURE = 64
"""Times that may wait for the depths of the first ones, which take seconds, of later ones next to nothing."""


class ReplayRun(contextlib.ExitStack):
    """Replays a scene into the files that the options name; those that are not finished go when it is closed.

    Attributes:
        interrupt: The signal that ended it.
        problems: Messages of errors.
    """

    def __init__(
        self,
        scene: Scene,
        arguments: argparse.Namespace,
        device: str,
        options: dict[str, Any],
        baseline: Baseline | None,
    ):
        """Opens the files; ``options`` are those that the results depend on, except method, device and clearance."""
        super().__init__()
        self._scene, self._arguments, self._baseline = scene, arguments, baseline
        self._settings = {"method": arguments.method, "device": device, "clearance": arguments.clearance}
        facts = replay_facts(scene, **self._settings, options=options)
        self.interrupt: KeyboardInterrupt | None = None
        self.problems: list[str] = []
        self._intervals: list[IntervalSummary] = []
        self._works: list[Work | None] = []
        self._writing = 0.0
        self._depths = DepthRecorder()
        self._measured = WriteBehind(self._depths.add, _MOST_TO_MEASURE)
        self._outputs: list[ReplayOutput] = []
        try:
            self._earlier = find_earlier(arguments.json, facts) if arguments.resume else None
            if self._earlier:
                self.callback(self._earlier.close)
            self._open(facts)
        except BaseException:
            self.close()
            raise

    def _open(self, facts: dict[str, Any]) -> None:
        """Opens the files that the options name."""
        arguments, scene = self._arguments, self._scene
        count = self._earlier.count if self._earlier else 0
        makers = (
            (
                arguments.json,
                lambda path: HitsJson(path, facts=facts, has_strands=scene.has_strands, earlier_count=count),
            ),
            (arguments.csv, lambda path: HitsCsv(path, scene=scene)),
            (arguments.npz, lambda path: HitsNpz(path, facts=facts, interval_count=len(scene))),
            (arguments.overlay, lambda path: Overlay(path, scene=scene, command=command_of(arguments))),
            (arguments.report, lambda path: ReportPage(path, scene=scene, baseline=self._baseline)),
        )
        for path, make in makers:
            if path:
                self._outputs.append(make(path))
                self.callback(self._outputs[-1].discard)

    def run(self) -> int:
        """Replays the scene as far as no signal or error stops it, writes the files, and returns the exit status.

        Raises:
            ValueError: If the scene is broken at some time, or a file cannot be written. The files contain the finished
                intervals, or as many as the disk has space for.
            KeyboardInterrupt: If a signal stopped it, after the files are written.
        """
        written = self.enter_context(contextlib.closing(WriteBehind(self._write)))
        self.enter_context(contextlib.closing(self._measured))
        with INTERRUPTS.held():
            self._find(written)
            stopped = f"stopped by an error: {self.problems[0]}" if self.problems else str(self.interrupt or "")
            limit = self._arguments.limit
            found = {"intervals": self._intervals, "depths": self._depths.largest()}
            summary = Summary(self._scene, stopped=stopped, limit=limit, **found, **self._settings)
            finished = self._finish(summary)
            if self.problems:
                raise ValueError("; ".join([str(self.interrupt)] * bool(self.interrupt) + self.problems))
            if not self.interrupt:
                INTERRUPTS.check()
        if STDOUT not in (self._arguments.json, self._arguments.csv, self._arguments.report):
            with naming("standard output"):
                self._show(summary, finished)
        if self.interrupt:
            raise self.interrupt
        return self._status(summary)

    def _find(self, written: WriteBehind) -> None:
        """Finds the intervals that ``written`` writes, and keeps what stops it."""
        try:
            with INTERRUPTS.raised(), contextlib.closing(self._track()) as found:
                for result in found:
                    written.put(result)
                    INTERRUPTS.check()
                written.wait()
        except KeyboardInterrupt as stopped:
            self.interrupt = stopped if isinstance(stopped, Interrupted) else Interrupted()
        except Exception as error:
            self.interrupt = INTERRUPTS.came  # a library may have turned it into another error
            self.problems += [] if self.interrupt else [self._explain(error)]
        for behind in (written, self._measured):
            try:
                behind.wait()
            except Exception as error:
                problem = self._explain(error)  # readers and writers all find a change of the scene's files
                self.problems += [] if self.interrupt or problem in self.problems else [problem]

    def _track(self) -> Generator[IntervalResult, None, None]:
        """Yields the intervals of an earlier replay, then the others as they are found, and shows the progress."""
        scene, arguments, hits = self._scene, self._arguments, 0
        with RunProgress("Replaying", as_json=arguments.progress == "json") as progress:
            progress.show(0, len(scene), hits=hits)
            for result in replay(
                scene,
                method=arguments.method,
                device=arguments.device,
                intersections=arguments.intersections,
                ignore_initial=arguments.ignore_initial,
                clearance=arguments.clearance,
                validate=arguments.validate,
                earlier=self._earlier.results(scene) if self._earlier else (),
                workers=arguments.workers,
            ):
                yield result
                hits += result.summary.hits
                progress.show(result.summary.index + 1, len(scene), f"time {result.summary.end:g}", hits=hits)

    def _write(self, result: IntervalResult) -> None:
        """Writes an interval to all files."""
        started = time.perf_counter()
        self._scene.files.check()
        if result.intersections:
            self._measured.put(result.intersections)
        if self._arguments.limit:
            result = limit_rows(result, self._arguments.limit)
        for output in self._outputs:
            with naming(output.file.name):
                output.add(result)
        self._intervals.append(result.summary)
        self._works.append(result.work)
        self._writing += time.perf_counter() - started

    def _finish(self, summary: Summary) -> list[ReplayOutput]:
        """Finishes the files, and returns those that were to be finished."""
        finished = self._outputs if self._intervals else []  # an earlier file is better than an empty one
        if self._earlier and len(self._intervals) < self._earlier.count:  # or than a shorter one, to resume
            finished = [output for output in finished if not isinstance(output, HitsJson)]
        files, streams = (
            {output.file.name: output for output in finished if output.file.is_stream == which}
            for which in (False, True)
        )

        def finish(output: ReplayOutput, _shortage: str) -> None:
            output.finish(summary)

        # Signals do not interrupt the files. They do interrupt streams, whose reader may not read to the end.
        self.problems += finish_outputs(files, finish)
        try:
            with INTERRUPTS.raised():
                self.problems += finish_outputs(streams, finish)
        except BrokenPipeError:
            if not self.problems:
                raise
        return finished

    def _show(self, summary: Summary, finished: list[ReplayOutput]) -> None:
        """Prints the results and the names of the files."""
        console = Console()
        print_replay(console, summary)
        print_work(console, self._works, self._writing)
        print_repair(console, summary, repair_command_of(self._scene, self._arguments))
        if self._baseline:
            print_new(console, self._baseline.new_in(summary))
        if finished and (missing := str(not_listed(summary, with_end=True) or "")):
            say(console, f"--limit: {missing}")
        for output in finished:
            say(console, f"Wrote {output.file.path}.")
            if isinstance(output, Overlay):
                say(console, f"  {SHOWN_BY}")

    def _status(self, summary: Summary) -> ExitStatus:
        """Returns the exit status of what was found."""
        if summary.validation and summary.validation.disagreements:
            return ExitStatus.DISAGREES
        fails = {
            "intersections": any(sample.crossings or sample.inside for sample in summary.intersections),
            "collisions": summary.hits > 0,
            "distance": bool(summary.nearest),
            "duplicates": bool(summary.duplicate_spans),
            "inversions": bool(summary.inversion_spans),
            "new": self._baseline is not None and bool(self._baseline.new_in(summary)),
        }
        if any(fails[reason] for reason in self._arguments.fail_on):
            return ExitStatus.FOUND
        return ExitStatus.LEFT_OUT if self._scene.left_out else ExitStatus.DONE

    def _explain(self, error: Exception) -> str:
        """Returns why a replay stopped: a change of the scene's files, which may cause any error, or else the error."""
        try:
            self._scene.files.check()
        except ValueError as changed:
            return str(changed)
        return describe(error) if isinstance(error, OSError | ValueError) else f"{self._scene.path}: {describe(error)}"
