"""Where things lie in a checkout."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Layout:
    """Paths of one checkout; `root` is absolute and free of symbolic links."""

    root: Path

    @property
    def venv(self) -> Path:
        """The virtual environment."""
        return self.root / ".venv"

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
        return self.root / "install"

    @property
    def build(self) -> Path:
        """Where the packages are built."""
        return self.root / "build"

    @property
    def logs(self) -> Path:
        """Where the output of each step is kept."""
        return self.root / "log"

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
