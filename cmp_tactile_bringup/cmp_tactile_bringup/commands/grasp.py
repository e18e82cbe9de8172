"""`cmp_tactile grasp`: a gripper with two sensors holds an object, in MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from cmp_tactile_bringup.commands.graphs import ASSIGNMENTS, GraphCommand
from cmp_tactile_bringup.commands.options import argument, misuse, option


@dataclass(frozen=True, kw_only=True)
class Grasp(GraphCommand):
    """Simulate a grasp: a gripper whose fingertips are sensors lifts, tilts and shakes an object in
    MuJoCo, and the gels' contact holds it. Writes one bag with the frames of both sensors, their
    truth, what is measured in them, and the poses; a table of both wrenches; a video. docs/grasp.md
    lists the keys of a scene. With --live, it runs in real time with the nodes of both sensors, as
    `ros2 launch cmp_tactile_bringup grasp.launch.py` does. Needs MuJoCo: pip install mujoco

    examples:
      cmp_tactile grasp box --output box
      cmp_tactile view box
      cmp_tactile grasp my_grasp.yaml --output mine
      cmp_tactile grasp cup --live view:=true drive:=command
    """

    words: Annotated[
        list[str] | None,
        argument(
            "[SCENE] [NAME:=VALUE]",
            f"a grasp's file or packaged name; without it, list these. With --live, {ASSIGNMENTS}",
        ),
    ] = None
    live: Annotated[bool, option("run it in real time, until Ctrl-C")] = False
    output: Annotated[
        str | None, option("folder to write (default: the scene's name)", short="-o")
    ] = None

    def run(self) -> int:
        """Play and record the grasp, run it live, or list the packaged ones."""
        from cmp_tactile_simulation.grasp.scene import load_grasp, packaged_grasps

        scenes = self._inputs()
        if len(scenes) > 1:
            misuse(f"found {scenes[1]!r} after the scene, expected NAME:=VALUE")
        if self.live and self.output:
            misuse("found --output, expected it without --live")
        if self.live or self.show_args:
            return self._start("grasp", *(f"scene:={scene}" for scene in scenes))
        if len(self.words or []) > len(scenes):
            misuse("found NAME:=VALUE, expected it with --live alone")
        if not scenes:
            for name, path in packaged_grasps().items():
                print(f"{name:12} {load_grasp(str(path)).title}")
            return 0
        return self._record(scenes[0])

    def _record(self, name: str) -> int:
        from cmp_tactile_bringup.report.grasp import write_grasp_page
        from cmp_tactile_bringup.terminal import print_findings, shown_stages
        from cmp_tactile_processing.cache.files import expanded_path
        from cmp_tactile_processing.errors import warnings_of
        from cmp_tactile_simulation.grasp.play import Grasp as Played
        from cmp_tactile_simulation.grasp.record import record_grasp
        from cmp_tactile_simulation.grasp.scene import load_grasp

        scene = load_grasp(name)
        folder = expanded_path(self.output or scene.name)
        with shown_stages() as on_stage:
            grasp = Played(scene, progress=on_stage)
            found = record_grasp(grasp, folder, lambda share: on_stage("grasping", share))
        error = ", ".join(f"{1e3 * value:.1f}" for value in found.error)
        most = ", ".join(f"{1e3 * value:.1f}" for value in found.most)
        measured = (
            f"measured force of {found.usable} of {2 * found.frames} (usable): error RMS ({error}) "
            f"mN, largest ({most}) mN along x, y, z"
        )
        page = write_grasp_page(folder, scene, measured)
        seconds = found.frames / scene.rate
        print(f"{folder}: {found.frames} frames of each finger, {seconds:g} s\n{measured}")
        print(f"page: {page}")
        if found.ended:
            print_findings(warnings_of(f"it ended early: {found.ended}"))
        return 0
