"""Recordings of packaged scenes, simulated when they are first asked for."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from cmp_tactile_processing.cache.disk import default_cache_dir, own_contents
from cmp_tactile_processing.cache.file_lock import FileLock
from cmp_tactile_processing.elastic.problem import Progress
from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.recording.output_folder import OutputFolder, job_of
from cmp_tactile_simulation.recording.run import RunOptions, run_scene
from cmp_tactile_simulation.scenes.library import load_scene

__all__ = ["recording_of"]

WAITING = "waiting for another process that makes the same recording"


def recording_of(
    scene_name: str, progress: Progress | None = None, cache_dir: Path | None = None
) -> Path:
    """The bag of a packaged scene ("grasp"), from the cache folder or simulated now.

    The folder has the scene's name; scene.yaml and sensor.yaml are in it.  An interrupted
    simulation goes on where it stopped; where another process makes the same one, this waits.
    progress: called with what is done and the fraction of it.
    Raises SceneError for an unknown name, other SimulationErrors as `run_scene`.
    """
    scene = load_scene(scene_name)
    job = job_of(scene, scene.frame_count, "bag")
    digest = hashlib.sha256(json.dumps(job, sort_keys=True).encode()).hexdigest()[:16]
    place = (cache_dir or default_cache_dir()) / "recordings" / digest
    folder = OutputFolder(place / scene.name)
    try:
        own_contents(place)
    except OSError as error:
        msg = f"{place}: {error}"
        raise OutputError(msg) from None
    if folder.finished:
        return folder.path
    with FileLock(place / ".lock") as lock:
        if not lock.acquire(wait=False):
            if progress:
                progress(WAITING, 0.0)
            lock.acquire(wait=True)
        if not folder.finished:
            try:
                run_scene(scene, folder.path, RunOptions(), cache_dir, progress)
            except OutputError:
                # What a full disk or a strange hand left there is no recording to go on with.
                run_scene(scene, folder.path, RunOptions(overwrite=True), cache_dir, progress)
    return folder.path
