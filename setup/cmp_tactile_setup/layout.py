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
        return self.root / ".venv"

    @property
    def venv_python(self) -> Path:
        return self.venv / "bin" / "python"

    @property
    def venv_record(self) -> Path:
        return self.venv / "cmp_tactile_wheels.json"

    @property
    def install(self) -> Path:
        return self.root / "install"

    @property
    def build(self) -> Path:
        return self.root / "build"

    @property
    def logs(self) -> Path:
        return self.root / "log"

    @property
    def build_record(self) -> Path:
        return self.install / "cmp_tactile_build.json"

    @property
    def environment_file(self) -> Path:
        return self.install / "cmp_tactile_environment.sh"

    @property
    def lock(self) -> Path:
        return self.root / ".setup.lock"

    def requirements(self, name: str) -> Path:
        return self.root / "setup" / name
