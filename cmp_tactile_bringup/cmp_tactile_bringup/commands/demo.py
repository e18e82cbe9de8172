"""`cmp_tactile demo`: a simulated grasp through the nodes, and a report of what was felt."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cmp_tactile_bringup.commands.options import Command, Number, option

if TYPE_CHECKING:
    from rich.progress import Progress

    from cmp_tactile_bringup.report.results import DemoResults, Recording
    from cmp_tactile_processing.sensor.description import SensorDescription

# A recording of 60 frames shows the rate to a few percent.
KEPT_SHARE = 0.95
# Where a machine loses frames it is played again, so many times at most, at this share of the rate
# at which results came.
PLAYED_AGAIN, SLOWER = 2, 0.6
RATE_HZ = 20.0


@dataclass(frozen=True, kw_only=True)
class Demo(Command):
    """Simulate a grasp, play it through the nodes over ROS topics, write a page with figures, and
    print the errors against the truth. The simulated grasp is kept in the cache. If frames are
    lost and --rate is not given, the grasp is played again, slower. The exit code is 1 if frames
    are still lost or an error is above its limit.
    """

    output: Annotated[Path, option("folder to write", metavar="DIR")] = Path("demo_output")
    rate: Annotated[
        float | None,
        option(
            f"frames per second (default: {RATE_HZ:g}, lower if the machine loses frames)",
            Number(0.1, 1000, "Hz"),
        ),
    ] = None
    recording: Annotated[str, option("packaged scene, or a recording from `simulate`")] = "grasp"

    def run(self) -> int:
        """Play, report; 1 where a limit is missed."""
        from rich.markup import escape
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        from cmp_tactile_bringup.report.evaluation import evaluate, table_rows
        from cmp_tactile_bringup.report.results import find_recording
        from cmp_tactile_bringup.terminal import output_console, results_table, stage_bars
        from cmp_tactile_processing.errors import printable
        from cmp_tactile_processing.prepare import prepare
        from cmp_tactile_processing.sensor.description import load_sensor

        self.output.mkdir(parents=True, exist_ok=True)
        console = output_console()
        columns = (
            TextColumn("{task.description:<33}"),
            BarColumn(),
            TextColumn("{task.fields[note]}"),
        )
        bars = Progress(*columns, TimeElapsedColumn(), console=console)
        with bars as progress:
            note, began = "first time only", time.monotonic()
            recording = find_recording(self.recording, stage_bars(progress, note=note))
            stages_s = {"Recording": time.monotonic() - began}
            sensor, began = load_sensor(recording.sensor), time.monotonic()
            # The nodes find in the cache what is compiled and built here.
            prepare(sensor, progress=stage_bars(progress, note=note))
            stages_s["Trackers and elastic model"] = time.monotonic() - began
            results, lost = _play(recording, sensor, self, progress)
            stages_s |= results.run.stages_s
            results = replace(results, run=replace(results.run, stages_s=stages_s))
            rows = table_rows(results, evaluate(results))
            page = _report(results, rows, self.output, progress)
        console.print(results_table(f"{recording.title}, against its truth", rows))
        run = results.run
        log = escape(printable(str(self.output / "container.log")))
        for rate, count in lost.items():
            console.print(
                f"[yellow]{count} frames were lost at {rate:.3g} Hz: the machine is slow or busy. "
                f"All frames were played again, slower; see {log}.[/]",
                soft_wrap=True,
            )
        if not run.rate_hz >= KEPT_SHARE * run.asked_hz:
            console.print(
                f"[yellow]Frames came at {run.rate_hz:.1f} Hz instead of {run.asked_hz:g} Hz: on "
                "a busy machine the replay slows down so that no frame is lost.[/]",
                soft_wrap=True,
            )
        missed = [row.name for row in rows if row.passed is False]
        if missed:
            console.print(f"[bold red]Limits missed:[/] {', '.join(missed)}", soft_wrap=True)
        if page:
            console.print(
                f"Open [bold]{escape(printable(str(page)))}[/] for the figures, or see each frame "
                f"in a browser: [bold]cmp_tactile view {escape(self.recording)}[/]",
                soft_wrap=True,
            )
        return int(bool(missed))


def _play(
    recording: Recording,
    sensor: SensorDescription,
    arguments: Demo,
    progress: Progress,
) -> tuple[DemoResults, dict[float, int]]:
    """The results, and how many frames were lost at rates that were too high for the machine.

    What the sensor felt is to be seen on a slow or busy machine, too.
    """
    (arguments.output / "container.log").unlink(missing_ok=True)
    rate, lost = arguments.rate or RATE_HZ, dict[float, int]()
    while True:
        results = _play_at(rate, recording, sensor, arguments, progress)
        missing = results.run.frames_sent - len(results.frames)
        if not missing or arguments.rate is not None or len(lost) == PLAYED_AGAIN:
            return results, lost
        lost[rate] = missing
        reached = results.run.rate_hz
        rate = SLOWER * (min(rate, reached) if reached > 0 else rate)


def _play_at(
    rate: float,
    recording: Recording,
    sensor: SensorDescription,
    arguments: Demo,
    progress: Progress,
) -> DemoResults:
    from cmp_tactile_bringup.demo import PlayOptions, PlayProgress, play

    total = len(recording.truth.stamp_ns)
    start = progress.add_task("Starting the component container", total=None, note="")
    task = progress.add_task(f"Playing at {rate:.3g} Hz", total=total, note="", start=False)

    def on_ready() -> None:
        progress.update(start, total=1, completed=1, note="nodes are ready")
        progress.start_task(task)

    def on_frames(count: int) -> None:
        progress.update(task, completed=count, note=f"{count} of {total} frames")

    options = PlayOptions(rate, arguments.output / "container.log")
    return play(recording, sensor, options, PlayProgress(on_ready, on_frames))


def _report(results: DemoResults, rows: Any, folder: Path, progress: Progress) -> Path | None:
    """The page, or None where no frame came through."""
    from cmp_tactile_bringup.report.demo import write_report

    task = progress.add_task("Drawing figures", total=1, note="")
    if not results.frames:
        progress.update(task, note="no figures: no frame came through")
        return None
    page = write_report(results, rows, folder)
    progress.advance(task)
    return page
