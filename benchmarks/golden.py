"""Process recordings in an older checkout and in this one, and print how far the results differ.

    setup/run python3 benchmarks/golden.py OLD_CHECKOUT grasp FOLDER_OR_BAG --sensor sensor.yaml

Both checkouts must be built (`make build`). A packaged scene is simulated once, by this checkout.
For each recording it prints the largest difference of positions, displacements, forces and wrench,
and every other array of `cmp_tactile process --arrays` that is not equal. The exit code is 1 if
anything differs.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tables import CommandLine, head, line

from cmp_tactile_bringup.recordings import library
from cmp_tactile_processing.errors import CmpTactileError

ROOT = Path(__file__).resolve().parents[1]
PRINTED = ("position", "displacement", "force", "wrench")

Arrays = dict[str, NDArray[np.generic]]


def processed(checkout: Path, recording: Path, sensor: str, output: Path) -> Arrays:
    """All arrays that a checkout computes from a recording; they are written into output."""
    options = ["--sensor", sensor, "--arrays", "--output", str(output)]
    command = [f"{checkout}/setup/run", "cmp_tactile", "process", str(recording), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)}: failed:\n{done.stdout}{done.stderr}")
    (file,) = output.glob("*.npz")
    with np.load(file, allow_pickle=False) as arrays:
        return dict(arrays)


def differences(old: Arrays, new: Arrays) -> dict[str, str]:
    """How far each array differs, by its name; printed arrays even where they are equal."""
    found = dict.fromkeys(old.keys() - new.keys(), "only in the old results")
    found |= dict.fromkeys(new.keys() - old.keys(), "only in the new results")
    for name in old.keys() & new.keys():
        if name in PRINTED or old[name].tobytes() != new[name].tobytes():
            found[name] = _difference(old[name], new[name])
    return found


def _difference(old: NDArray[np.generic], new: NDArray[np.generic]) -> str:
    if (old.shape, old.dtype) != (new.shape, new.dtype):
        return f"{old.dtype} {old.shape} became {new.dtype} {new.shape}"
    if old.tobytes() == new.tobytes():
        return "0"
    if old.dtype.kind not in "fiub":
        return f"{np.count_nonzero(old != new)} of {old.size} elements"
    before, after = old.astype(np.float64), new.astype(np.float64)
    found = np.isfinite(before) & np.isfinite(after)
    apart = np.abs(after - before)[found].max(initial=0.0)
    largest = np.abs(before[found]).max(initial=0.0)
    text = f"{apart:.3g} (largest value {largest:.3g})"
    one_is_nan = np.count_nonzero(np.isnan(before) != np.isnan(after))
    return f"{text}, {one_is_nan} became or were NaN" if one_is_nan else text


def main() -> int:
    """Process and compare."""
    parser = CommandLine(__doc__)
    parser.add_argument("old", type=Path, metavar="OLD_CHECKOUT")
    parser.add_argument("inputs", nargs="+", metavar="INPUT", help="packaged scene or recording")
    parser.add_argument("--sensor", help="sensor description of recordings that have none")
    arguments = parser.parse_args()
    equal = True
    print(head("input", "array", "largest difference (m, N, N m)"))
    for name in arguments.inputs:
        try:
            library.check_source(Path(name))
            recording = library.recorded_source(Path(name)).resolve()
            sensor = library.required_sensor(recording, arguments.sensor)
        except CmpTactileError as error:
            sys.exit(f"error: {error}")
        with tempfile.TemporaryDirectory() as folder:
            old, new = (
                processed(checkout, recording, sensor, Path(folder) / label)
                for checkout, label in ((arguments.old.resolve(), "old"), (ROOT, "new"))
            )
        found = differences(old, new)
        for array in (*PRINTED, *sorted(found.keys() - set(PRINTED))):
            print(line(name, array, found[array]), flush=True)
        equal = equal and all(text == "0" for text in found.values())
    return 0 if equal else 1


if __name__ == "__main__":
    sys.exit(main())
