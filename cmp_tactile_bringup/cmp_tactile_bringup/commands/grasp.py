"""`cmp_tactile grasp`: a gripper with two sensors holds an object, in MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from cmp_tactile_bringup.commands.options import Command, argument, option


@dataclass(frozen=True, kw_only=True)
class Grasp(Command):
    """Simulate a grasp: a gripper whose fingertips are sensors lifts, tilts and shakes an object in
    MuJoCo, and the gels' contact holds it. Writes one bag with the frames of both sensors, their
    truth, what is measured in them, and the poses; a table of both wrenches; a video. docs/grasp.md
    lists the keys of a scene. Needs MuJoCo: pip install mujoco

    examples:
      cmp_tactile grasp box --output box
      cmp_tactile view box
      cmp_tactile grasp my_grasp.yaml --output mine
    """

    scene: Annotated[
        str | None,
        argument("SCENE", "a grasp's file or packaged name; without it, list these"),
    ] = None
    output: Annotated[
        str | None, option("folder to write (default: the scene's name)", short="-o")
    ] = None

    def run(self) -> int:
        """Play and record the grasp, or list the packaged ones."""
        from cmp_tactile_bringup.terminal import shown_stages
        from cmp_tactile_processing.cache.files import expanded_path
        from cmp_tactile_simulation.grasp.play import Grasp as Played
        from cmp_tactile_simulation.grasp.record import record_grasp
        from cmp_tactile_simulation.grasp.scene import load_grasp, packaged_grasps

        if self.scene is None:
            for name, path in packaged_grasps().items():
                print(f"{name:12} {load_grasp(str(path)).title}")
            return 0
        scene = load_grasp(self.scene)
        folder = expanded_path(self.output or scene.name)
        with shown_stages() as on_stage:
            grasp = Played(scene, progress=on_stage)
            found = record_grasp(grasp, folder, lambda share: on_stage("grasping", share))
        print(f"{folder}: {found.frames} frames of each finger, {scene.duration:g} s")
        error = ", ".join(f"{1e3 * value:.1f}" for value in found.error)
        most = ", ".join(f"{1e3 * value:.1f}" for value in found.most)
        print(
            f"measured force of {found.usable} of {2 * found.frames} (usable): error RMS ({error}) "
            f"mN, largest ({most}) mN along x, y, z"
        )
        return 0
