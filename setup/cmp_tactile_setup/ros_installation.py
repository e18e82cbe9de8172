"""The ROS 2 that the shell has sourced, if it has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from .problem import SetupProblem

_TOO_OLD = frozenset(
    ("ardent", "bouncy", "crystal", "dashing", "eloquent", "foxy", "galactic", "humble", "iron")
)


@dataclass(frozen=True)
class RosInstallation:
    """A sourced ROS 2: its distribution and the prefixes of AMENT_PREFIX_PATH outside the checkout."""

    distro: str
    prefixes: tuple[Path, ...]

    def has_package(self, name: str) -> bool:
        """Whether one of the prefixes provides the package."""
        return any((prefix / "share" / name / "package.xml").is_file() for prefix in self.prefixes)


def sourced_ros(env: Mapping[str, str], root: Path) -> RosInstallation | None:
    """The ROS 2 installation that `env` has sourced, or None.

    A virtual environment that holds ROS 2 wheels, this checkout's or another's, is none.
    Raises SetupProblem for a distribution that is too old.
    """
    distro = env.get("ROS_DISTRO", "")
    prefixes = tuple(
        Path(entry)
        for entry in env.get("AMENT_PREFIX_PATH", "").split(":")
        if entry and not _below(Path(entry), root) and not (Path(entry) / "pyvenv.cfg").exists()
    )
    installation = RosInstallation(distro, prefixes)
    if not distro or not installation.has_package("rclpy"):
        return None
    if distro in _TOO_OLD:
        raise SetupProblem(
            f"ROS 2 '{distro}' is too old: source Jazzy or newer, or open a shell without ROS 2 "
            "to use wheels"
        )
    return installation


def _below(path: Path, root: Path) -> bool:
    return root in (path.resolve(), *path.resolve().parents)
