"""The ROS 2 that the shell has sourced, if it has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cmp_tactile_setup.errors import SetupError

_TOO_OLD = frozenset(
    ("ardent", "bouncy", "crystal", "dashing", "eloquent", "foxy", "galactic", "humble", "iron")
)


@dataclass(frozen=True)
class RosInstallation:
    """A sourced ROS 2: its distribution and the prefixes of AMENT_PREFIX_PATH that are not ours."""

    distro: str
    prefixes: tuple[Path, ...]

    def prefix_of(self, package: str) -> Path | None:
        """The first prefix that provides the package, or None."""
        found = (p for p in self.prefixes if (p / "share" / package / "package.xml").is_file())
        return next(found, None)


def sourced_ros(env: Mapping[str, str], root: Path) -> RosInstallation | None:
    """The ROS 2 installation that `env` has sourced, or None.

    A virtual environment that holds ROS 2 wheels, this checkout's or another's, is none.
    Raises SetupError for a distribution that is too old.
    """
    distro = env.get("ROS_DISTRO", "")
    prefixes = tuple(
        Path(entry)
        for entry in env.get("AMENT_PREFIX_PATH", "").split(":")
        if entry and not is_below(entry, root) and not (Path(entry) / "pyvenv.cfg").exists()
    )
    installation = RosInstallation(distro, prefixes)
    if not distro or installation.prefix_of("rclpy") is None:
        return None
    if distro in _TOO_OLD:
        raise SetupError(
            f"ROS 2 '{distro}' is too old: source Jazzy or newer, or open a shell without ROS 2 "
            "to use wheels"
        )
    return installation


def is_below(path: str, root: Path) -> bool:
    """Whether the path is `root` or lies below it."""
    resolved = Path(path).resolve()
    return root in (resolved, *resolved.parents)
