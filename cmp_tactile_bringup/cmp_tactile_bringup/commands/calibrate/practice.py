"""`cmp_tactile calibrate practice`: simulated images to calibrate from, without a sensor."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cmp_tactile_bringup.commands.options import Command, Number, option

MAX_SEED = 2**31 - 1


@dataclass(frozen=True, kw_only=True)
class Practice(Command):
    """Simulate images of a rig that differs a little from its description: gel and mirrors are
    turned by 1 degree and shifted by 0.5 mm, and the focal length is 1 % off, each in an unknown
    direction.

      DIR/sensor.yaml   the description to start from
      DIR/board/        images of a board, taken before the gel was mounted
      DIR/rest/         frames of the gel at rest
      DIR/contact/      a recording of a contact, with its truth
      DIR/truth/        the true rig: do not look at it until the end

    example:
      cmp_tactile calibrate practice --output practice
    """

    output: Annotated[Path, option("folder to write", metavar="DIR")]
    sensor: Annotated[
        str, option("description of the rig as designed: a file or a packaged name")
    ] = "sample_rig"
    seed: Annotated[
        int | None,
        option(
            "the same seed makes the same set (default: a new set each time)",
            Number(0, MAX_SEED, kind=int),
        ),
    ] = None
    images: Annotated[int, option("number of images of the board", Number(3, 200, kind=int))] = 20
    overwrite: Annotated[bool, option("replace an earlier practice set")] = False

    def run(self) -> int:
        """Make the set and say what is in it."""
        import secrets

        from cmp_tactile_bringup.calibration.practice_set import PracticeSet, make_practice_set
        from cmp_tactile_bringup.terminal.output import shown_stages
        from cmp_tactile_processing.sensor.description import load_sensor

        seed = secrets.randbelow(MAX_SEED) if self.seed is None else self.seed
        practice = PracticeSet(load_sensor(self.sensor), seed, self.images)
        folder = self.output.expanduser()
        with shown_stages() as on_stage:
            make_practice_set(practice, folder, on_stage, overwrite=self.overwrite)
        target = practice.target
        board = f"--board {target.cols}x{target.rows} --square {target.square:g}"
        print(f"Practice set in {folder}: docs/tutorials/calibrate.md goes through it.")
        quoted = shlex.quote(str(folder))
        print(f"  cmp_tactile calibrate check {quoted}/contact --sensor {quoted}/sensor.yaml")
        print(
            f"  cmp_tactile calibrate board {quoted}/board --sensor {quoted}/sensor.yaml {board} "
            "--output board.yaml"
        )
        print(
            f"  cmp_tactile calibrate gel {quoted}/rest --sensor board.yaml --output my_sensor.yaml"
        )
        print(f"  cmp_tactile calibrate check {quoted}/contact --sensor my_sensor.yaml")
        return 0
