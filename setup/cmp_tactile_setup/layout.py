"""Where things lie in a checkout: once for each ROS 2 distribution that it is set up for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cmp_tactile_setup.steps import SetupError

# The distributions that wheels exist for; the first is what a checkout is set up for by default.
DISTRIBUTIONS = ("kilted", "jazzy")


def chosen_distribution(value: str) -> str:
    """The distribution that the variable ROS names. Raises SetupError if there is none of it."""
    distro = value or DISTRIBUTIONS[0]
    if distro not in DISTRIBUTIONS:
        raise SetupError(
            f"ROS={value}: there are wheels of {' and '.join(DISTRIBUTIONS)}; unset the variable "
            "ROS, or give it one of these values"
        )
    return distro


@dataclass(frozen=True)
class Layout:
    """Paths of one checkout; `root` is absolute and free of symbolic links.

    Each of the `DISTRIBUTIONS` has folders of its own, so that they lie side by side.
    """

    root: Path
    distro: str = DISTRIBUTIONS[0]

    @property
    def venv(self) -> Path:
        """The virtual environment."""
        return self._folder(".venv")

    @property
    def venv_python(self) -> Path:
        """The virtual environment's interpreter."""
        return self.venv / "bin" / "python"

    @property
    def venv_record(self) -> Path:
        """What the virtual environment was made from, once it is complete."""
        return self.venv / "cmp_tactile_wheels.json"

    @property
    def install(self) -> Path:
        """Where the packages are installed."""
        return self._folder("install")

    @property
    def build(self) -> Path:
        """Where the packages are built."""
        return self._folder("build")

    @property
    def logs(self) -> Path:
        """Where the output of each step is kept."""
        return self._folder("log")

    @property
    def build_record(self) -> Path:
        """What the installed packages were built from, once they are complete."""
        return self.install / "cmp_tactile_build.json"

    @property
    def environment_file(self) -> Path:
        """What setup/env.sh sources."""
        return self.install / "cmp_tactile_environment.sh"

    @property
    def lock(self) -> Path:
        """Held by the set-up that runs."""
        return self.root / ".setup.lock"

    def requirements(self, name: str) -> Path:
        """A requirements file of that name."""
        return self.root / "setup" / name

    def _folder(self, name: str) -> Path:
        suffix = "" if self.distro == DISTRIBUTIONS[0] else f"-{self.distro}"
        return self.root / f"{name}{suffix}"
