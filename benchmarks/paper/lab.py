"""Cases computed in several processes, and the contacts that they share; both are kept."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import joblib
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.cache.files import files_digest, locked
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_simulation.recording.run import simulator_version
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Motion, Scene
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.scenes.simulation import Simulation
from cmp_tactile_simulation.simulator import force_field

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


# Contact nodes of the quick run.
FAST_NODES = 24


@dataclass(frozen=True)
class Mechanics:
    """The gel in each of F frames; gel frame, m and N.

    observers: grid over the top of the gel on which `displacement` (F, rows, cols, 3) of the
    marker surface is known.  phase (F,): names of the motion's phases.  rate: frames/s.
    node_position (N, 3): contact nodes at rest; contact (F, N).  wrench (F, 6): as in ForceField.
    """

    observers: SurfaceGrid
    rate: float
    phase: NDArray[np.str_]
    displacement: NDArray[np.float64]
    node_position: NDArray[np.float64]
    contact: NDArray[np.bool_]
    wrench: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.displacement)

    def surface(self, frame: int, pattern: Pattern) -> DeformedSurface:
        """The marker surface in a frame, with any pattern on it."""
        return DeformedSurface(pattern, self.observers, self.displacement[frame])

    def frames(self, *phases: str) -> NDArray[np.intp]:
        """Indices of the frames of these phases."""
        return np.flatnonzero(np.isin(self.phase, phases))


def shortened(name: str, frames: Mapping[str, int | None], *, fast: bool) -> Scene:
    """A packaged scene with these phases alone, of so many frames; None: as many as it has.

    fast: on fewer contact nodes.
    """
    scene = load_scene(name)
    motion = tuple(
        replace(phase, frames=frames[phase.name] or phase.frames)
        for phase in scene.motion
        if phase.name in frames
    )
    return replace(scene, motion=motion, contact_nodes=FAST_NODES if fast else scene.contact_nodes)


def mechanics_of(scene: Scene, place: Workplace) -> Mechanics:
    """All frames of a scene's contact, from the workplace where they were solved before.

    What the scene says of print, camera and noise does not matter, nor the colours of the pattern.
    """
    folder = place.folder / "mechanics"
    folder.mkdir(parents=True, exist_ok=True)
    memory = joblib.Memory(folder, verbose=0)
    key = _key(scene)
    # Two prints have the same contact, in processes of their own.
    with locked(folder / f"{key}.lock"):
        mechanics: Mechanics = memory.cache(_solved, ignore=["scene"])(scene, key)
    return mechanics


def _key(scene: Scene) -> str:
    """Of all that the contact depends on."""
    sensor = scene.sensor
    facts = (
        simulator_version(),
        sensor.elastomer,
        sensor.pattern.surface,
        (sensor.pattern.rows, sensor.pattern.cols, sensor.pattern.pitch),
        scene.contact_nodes,
        scene.indenter,
        scene.start,
        scene.motion,
        scene.rate,
    )
    return str(joblib.hash(repr(facts)))


def _solved(scene: Scene, _facts: str) -> Mechanics:
    simulation, motion = Simulation(scene), Motion(scene.motion)
    displacement, phases, fields = [], [], []
    with threadpool_limits(1, "blas"):
        for state in simulation.states():
            displacement.append(simulation.elastomer.marker_displacement(state.contact.force))
            fields.append(force_field(simulation.contact, state.contact, scene.sensor))
            phases.append(motion.phase(state.frame).name)
    return Mechanics(
        observers=simulation.elastomer.observers,
        rate=scene.rate,
        phase=np.array(phases),
        displacement=np.array(displacement),
        node_position=simulation.elastomer.node_position,
        contact=np.array([field.contact for field in fields]),
        wrench=np.array([field.wrench for field in fields]),
    )
