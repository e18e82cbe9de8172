"""The files of a printed pattern: a sheet in each format, and the description that agrees."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_bringup.printing.dxf import dxf_bytes
from cmp_tactile_bringup.printing.pdf import pdf_bytes
from cmp_tactile_bringup.printing.svg import svg_bytes
from cmp_tactile_processing.cache.files import write_whole
from cmp_tactile_processing.printing.sheet import PrintSheet
from cmp_tactile_processing.sensor.description import SensorDescription, write_sensor_description

WRITERS: dict[str, Callable[[PrintSheet, str], bytes]] = {
    "svg": svg_bytes,
    "pdf": pdf_bytes,
    "dxf": dxf_bytes,
}
FORMATS = tuple(WRITERS)
LIBRARIES = {"pdf": "reportlab", "dxf": "ezdxf"}


@dataclass(frozen=True)
class PatternFiles:
    """NAME.svg, NAME.pdf, NAME.dxf, as far as they are asked for, and NAME.yaml."""

    sheets: dict[str, Path]
    sensor: Path

    @classmethod
    def from_output(cls, output: Path, formats: Sequence[str]) -> PatternFiles:
        """Files of that name; an ending that is one of theirs is left out of it.

        Raises OutputError for a folder: a name in it is needed.
        """
        output = output.expanduser()
        if output.is_dir():
            msg = f"{output}: found a folder, expected a name, as {output / 'my_pattern'}"
            raise OutputError(msg)
        if output.suffix in {".yaml", *(f".{name}" for name in FORMATS)}:
            output = output.with_suffix("")
        files = {name: output.with_name(f"{output.name}.{name}") for name in (*formats, "yaml")}
        sensor = files.pop("yaml")
        return cls(files, sensor)

    def check_free(self, source: Path, *, overwrite: bool) -> None:
        """Raise OutputError where a file is there already, or is the description that is read."""
        for path in (*self.sheets.values(), self.sensor):
            if path.resolve() == source.resolve():
                msg = (
                    f"{path}: is the input, so it is not replaced; give another name with --output"
                )
                raise OutputError(msg)
            if path.is_dir():
                msg = f"{path}: is a folder, so it is not replaced; give another name with --output"
                raise OutputError(msg)
            if path.exists() and not overwrite:
                msg = f"{path}: exists already; --overwrite replaces it"
                raise OutputError(msg)

    def write(self, sheet: PrintSheet, sensor: SensorDescription) -> tuple[list[Path], list[str]]:
        """Write everything; returns the files and, for each that is missing, a line why.

        The description is written last, and only beside a sheet.
        """
        without = {name: LIBRARIES[name] for name in self.sheets if not _is_there(name)}
        contents = {
            path: WRITERS[name](sheet, sensor.name)
            for name, path in self.sheets.items()
            if name not in without
        }
        missing = [
            f"{self.sheets[name]}: not written: found no library {library}; install it: python3 "
            f"-m pip install {library}"
            for name, library in without.items()
        ]
        if not contents:
            return [], missing
        self.sensor.parent.mkdir(parents=True, exist_ok=True)
        for path, content in contents.items():
            write_whole(path, content)
        write_sensor_description(self.sensor, sensor)
        return [*contents, self.sensor], missing


def _is_there(name: str) -> bool:
    """Whether the library that a format needs can be imported."""
    return name not in LIBRARIES or importlib.util.find_spec(LIBRARIES[name]) is not None
