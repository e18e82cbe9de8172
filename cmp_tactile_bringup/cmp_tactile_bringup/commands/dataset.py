"""`cmp_tactile dataset`: many simulated presses with their truth, for learning."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

from cmp_tactile_bringup.commands.options import Command, Number, argument, option
from cmp_tactile_bringup.commands.process import MOST_JOBS
from cmp_tactile_bringup.commands.simulate import MAX_SEED

if TYPE_CHECKING:
    from cmp_tactile_processing.errors import CmpTactileError
    from cmp_tactile_processing.processes import OnProgress
    from cmp_tactile_simulation.dataset.recipe import Recipe
    from cmp_tactile_simulation.dataset.shards import Shard

# As the module that does the work has it, which is loaded when it begins.
MAX_DATASET = 1_000_000


@dataclass(frozen=True, kw_only=True)
class Dataset(Command):
    """Simulate a dataset for learning: presses that are drawn from a recipe, each with its picture
    and with all that is true of it. docs/datasets.md lists the keys of a recipe.

    A sample depends on the recipe and its number alone: it is the same on any machine, with any
    number of processes, and after an interruption.

    examples:
      cmp_tactile dataset presses --samples 1000 --output presses
      cmp_tactile dataset presses --samples 1000 --output presses --resume
      cmp_tactile dataset my_recipe.yaml --output mine --jobs 8
    """

    recipe: Annotated[
        str | None, argument("RECIPE", "a recipe's file or packaged name; without it, list these")
    ] = None
    output: Annotated[
        str | None, option("folder of the dataset (default: the recipe's name)", short="-o")
    ] = None
    samples: Annotated[
        int | None,
        option("number of samples (default: the recipe's)", Number(1, MAX_DATASET, kind=int)),
    ] = None
    seed: Annotated[
        int | None, option("seed in place of the recipe's", Number(0, MAX_SEED, kind=int))
    ] = None
    resume: Annotated[bool, option("go on with a dataset, or make it larger")] = False
    jobs: Annotated[
        int | None,
        option("processes (default: one for each core)", Number(1, MOST_JOBS, kind=int)),
    ] = None
    scheduler: Annotated[
        str | None,
        option(
            "address of a running dask cluster, as tcp://host:8786; its machines must see the "
            "same folder",
            metavar="ADDRESS",
        ),
    ] = None

    def run(self) -> int:
        """Make what is missing; returns 1 where a part could not be made."""
        from cmp_tactile_bringup.terminal import output_console, print_line, shown_stages
        from cmp_tactile_processing.cache.files import expanded_path
        from cmp_tactile_simulation.dataset.recipe import load_recipe, packaged_recipes
        from cmp_tactile_simulation.dataset.shards import begin, left_out

        self.check_exclusive("jobs", "scheduler")
        if self.recipe is None:
            for name, path in packaged_recipes().items():
                print(f"{name:10} {load_recipe(str(path)).title}")
            return 0
        recipe = self._changed(load_recipe(self.recipe))
        folder = expanded_path(self.output or recipe.name).absolute()
        console = output_console(stderr=True)
        shards = begin(recipe, folder, resume=self.resume)
        failed = 0
        with shown_stages() as on_stage, closing(self._run(recipe, shards)) as results:
            if shards:
                _prepare(recipe, on_stage)
            done = recipe.samples - sum(shard.end - shard.first for shard in shards)
            for shard, result in results:
                if isinstance(result, Exception):
                    failed += 1
                    print_line(console, f"{result}", "red")
                else:
                    done += shard.end - shard.first
                    on_stage("samples", done / recipe.samples)
        missing = list(left_out(folder))
        for number, why in missing[:3]:
            print_line(console, f"warning: sample {number} was left out: {why}", "yellow")
        print(
            f"{folder}: {done - len(missing)} of {recipe.samples} samples, {len(missing)} left out"
        )
        print(f'open it: cmp_tactile_processing.load("{folder}")  (xarray)')
        if failed:
            print_line(console, f"{failed} files are missing: --resume makes them", "red")
        return int(failed > 0)

    def _changed(self, recipe: Recipe) -> Recipe:
        """The recipe with what options say instead, in its file's content as well."""
        samples = recipe.samples if self.samples is None else self.samples
        seed = recipe.seed if self.seed is None else self.seed
        content = {**recipe.file.content, "samples": samples, "seed": seed}
        return replace(
            recipe, samples=samples, seed=seed, file=replace(recipe.file, content=content)
        )

    def _run(
        self, recipe: Recipe, shards: list[Shard]
    ) -> Generator[tuple[Shard, int | CmpTactileError], None, None]:
        from functools import partial
        from os import cpu_count

        from cmp_tactile_bringup.offline.pools import connected, in_processes, on_cluster

        work = partial(_made, recipe)
        if self.scheduler is not None:
            with connected(self.scheduler) as client:
                yield from on_cluster(shards, work, client)
            return
        processes = min(self.jobs or cpu_count() or 1, len(shards))
        if processes > 1:
            yield from in_processes(shards, work, processes)
            return
        for shard in shards:
            yield shard, work(shard)


def _made(recipe: Recipe, shard: Shard) -> int | CmpTactileError:
    """Make a shard in another process; no error leaves this."""
    from cmp_tactile_processing.errors import CmpTactileError
    from cmp_tactile_simulation.dataset.shards import make_shard

    try:
        return make_shard(recipe, shard)
    except CmpTactileError as error:
        return error


def _prepare(recipe: Recipe, on_stage: OnProgress) -> None:
    """Build the gels of all variants, and compile, before several processes need both."""
    from cmp_tactile_processing.cache.compiled import when_compiling
    from cmp_tactile_processing.errors import CmpTactileError
    from cmp_tactile_simulation.dataset.sampling import Sampler, draw

    sampler = Sampler(recipe, on_stage)
    for variant in range(recipe.variants):
        sampler.simulator(variant)
    # A sample that cannot be simulated is reported when its turn comes.
    with when_compiling(on_stage), suppress(CmpTactileError):
        sampler.frames(draw(recipe, 0))
