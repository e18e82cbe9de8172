"""`cmp_tactile export`: datasets and bags for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cmp_tactile_bringup.commands.options import Choice, Command, Number, argument, option
from cmp_tactile_processing.cache.files import expanded_path

if TYPE_CHECKING:
    from cmp_tactile_bringup.export.lerobot import LeRobotWriter


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write datasets and bags as a LeRobot dataset v3.0. Each sample and each bag becomes an
    episode. A bag needs the topics surface and force_field, measured or of a simulator, and may
    have images.

    \b
    examples:
      cmp_tactile export presses --to lerobot --output presses_lerobot
      cmp_tactile export grasp1 grasp2 --to lerobot --map robot.yaml --output grasps
      cmp_tactile export results --to lerobot --recordings bags --output grasps
    """

    sources: Annotated[
        list[Path], argument("SOURCE", "a folder of `cmp_tactile dataset` or `process`, or a bag")
    ]
    to: Annotated[str, option("format", Choice(("lerobot",)))]
    output: Annotated[Path, option("new folder to write", metavar="DIR")]
    map_: Annotated[
        Path | None,
        option("YAML file that names further topics of the bags", metavar="FILE"),
    ] = None
    recordings: Annotated[
        Path | None,
        option(
            "bag that results of process were computed from, or folder of such bags: its images "
            "and topics of --map are exported as well",
            metavar="PATH",
        ),
    ] = None
    fps: Annotated[
        int | None,
        option("rate of the clock (default: that of the frames)", Number(1, 1000, "Hz", int)),
    ] = None
    max_error: Annotated[
        float | None,
        option(
            "how far a frame or message may be from its tick of the clock (default: one and a "
            "half periods)",
            Number(0, 1e6, "s"),
        ),
    ] = None
    images: Annotated[
        str,
        option(
            "png: lossless, in the data files; video: MP4, smaller, not lossless (needs av)",
            Choice(("png", "video")),
        ),
    ] = "png"
    task: Annotated[str, option("what the robot does, in words, for all episodes")] = "touch"

    def run(self) -> int:
        """Write the folder, and print what it holds."""
        from cmp_tactile_bringup.export import episodes, lerobot, topics
        from cmp_tactile_bringup.terminal import shown_stages

        if self.images == "video":
            lerobot.require_video()
        mapping = topics.read_feature_map(expanded_path(self.map_)) if self.map_ else None
        output, writer = expanded_path(self.output).absolute(), None
        sources = [expanded_path(source) for source in self.sources]
        recorded = expanded_path(self.recordings) if self.recordings else None
        found = episodes.episodes(sources, mapping, self.fps, self.max_error, recorded)
        with lerobot.new_folder(output) as folder, shown_stages() as on_stage:
            for episode, share in found:
                if writer is None:
                    video, facts = self.images == "video", self._facts(sources)
                    writer = lerobot.LeRobotWriter(
                        folder, episode, self.task, video=video, facts=facts
                    )
                writer.add(episode)
                on_stage("exporting", share)
            if writer is not None:
                writer.close()
        if writer is not None:
            _report(output, writer)
        return 0

    def _facts(self, sources: Sequence[Path]) -> dict[str, object]:
        from cmp_tactile_bringup.terminal import installed_version

        version = installed_version("cmp_tactile_processing")
        return {"software": f"cmp_tactile {version}", "sources": list(map(str, sources))}


def _report(output: Path, writer: LeRobotWriter) -> None:
    from cmp_tactile_bringup.terminal import output_console, print_line

    console = output_console()
    print_line(console, f"{writer.episodes} episodes, {writer.frames} frames -> {output}")
    worst = max(writer.error_s, key=writer.error_s.__getitem__)
    error = f"largest error of synchronisation: {writer.error_s[worst]:.3g} s ({worst})"
    print_line(console, error)
    if writer.left_out:
        why = "before the first message of a mapped topic"
        print_line(console, f"warning: left out {writer.left_out} frames {why}", "yellow")
    print_line(console, f'open in Python: LeRobotDataset("{output.name}", root="{output}")')
