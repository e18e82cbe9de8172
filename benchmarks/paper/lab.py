"""Computes the cases of an experiment in several processes and keeps the results."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import joblib
from numpy.typing import NDArray

from cmp_tactile_processing.cache.files import files_digest
from cmp_tactile_simulation.recording.run import simulator_version

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Workplace:
    """Where cases keep what other cases use as well.  fast: the quick run, of fewer cases."""

    folder: Path
    fast: bool = False


class Lab:
    """Where an experiment has its cases computed.

    place: handed to every case.  jobs: processes at once, of one thread each.  A result holds as
    long as the arguments, the experiment's module, those of this folder and the simulator stay.
    """

    def __init__(self, place: Workplace, jobs: int) -> None:
        self.place, self.jobs = place, jobs

    @property
    def fast(self) -> bool:
        """Whether the quick run is asked for."""
        return self.place.fast

    def compute(self, work: Callable[..., Any], cases: Sequence[tuple[Any, ...]]) -> list[Any]:
        """What work(place, *arguments) returns for each of these arguments, in order."""
        kept = self.place.folder / "results" / digest_of(work.__module__)
        memory = joblib.Memory(kept, verbose=0)
        with joblib.parallel_config("loky", n_jobs=self.jobs, inner_max_num_threads=1):
            done = joblib.Parallel(return_as="generator")(
                joblib.delayed(_in_one_thread)(memory.cache(work), self.place, *case)
                for case in cases
            )
            results = []
            for result in done:
                results.append(result)
                print(f"  {work.__name__}: {len(results)} of {len(cases)}", flush=True)
        return results


def _in_one_thread(work: Callable[..., Any], *arguments: Any) -> Any:
    cv2.setNumThreads(1)
    return work(*arguments)


def digest_of(module: str) -> str:
    """Of the sources that a module's cases rest on."""
    own = Path(str(sys.modules[module].__file__))
    paths = sorted({own, *Path(__file__).parent.glob("*.py")})
    sources = files_digest((path.name, path) for path in paths)
    return f"{own.stem}-{joblib.hash((sources, simulator_version()))[:16]}"
