"""Samples of a dataset and bags as episodes: all features on the ticks of one clock.

A tick has the tactile frame that is nearest to it, and of each further topic the latest message at
or before that frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.export.topics import (
    Feature,
    FeatureMap,
    Series,
    image_feature,
    mapped_series,
)
from cmp_tactile_driver.bags.arrays import topics_of_sensors
from cmp_tactile_driver.bags.recording import is_bag
from cmp_tactile_driver.bags.storage import STORAGE_SUFFIXES, BagStorage
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.sensor.yaml_file import YamlFile
from cmp_tactile_processing.tables import TABLE, WRENCH_COMPONENTS, load

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[Any]
Stamps = NDArray[np.int64]

RULE = (
    "ticks of a regular clock from the first frame on; each has the tactile frame and image "
    "nearest to the tick, and of further topics the latest message at or before that frame"
)
# A topic of the clock's own rate, with the jitter of a half of its period.
DEFAULT_ERROR_PERIODS = 1.5
POINTS = ("row", "col", "dx dy dz (m) fx fy fz (N)")
SLIP = ("slip_state", "slip_ratio", "traction_ratio")
# Of a dataset, so many frames are read at once.
FRAMES_AT_ONCE = 256


@dataclass(frozen=True)
class Recording:
    """A bag or a sample.  series: by feature, the first gives the clock.  rate_hz: of frames.

    share: of its source, that is read with it.
    """

    label: str
    series: Mapping[str, Series]
    rate_hz: float
    share: float = 1.0


@dataclass(frozen=True)
class Episode:
    """numbers: of the entries of each series, at each tick.  fps: ticks per second.

    error_s: the largest of each series, at most limit_s.  left_out: frames before the first message
    of a further topic.
    """

    label: str
    series: Mapping[str, Series]
    numbers: Mapping[str, NDArray[np.intp]]
    error_s: Mapping[str, float]
    limit_s: float
    left_out: int
    fps: int

    @property
    def length(self) -> int:
        """How many ticks it has."""
        return len(next(iter(self.numbers.values())))

    @property
    def features(self) -> dict[str, Feature]:
        """What each frame has, by name."""
        return {name: series.feature for name, series in self.series.items()}

    def read(self, part: slice) -> dict[str, Array]:
        """The values of some ticks, by feature."""
        return {name: item.values(self.numbers[name][part]) for name, item in self.series.items()}


def recordings(
    source: Path, mapping: tuple[YamlFile, FeatureMap] | None, recorded: Path | None = None
) -> Iterator[Recording]:
    """The samples of a dataset, a bag, or those in a folder of results; mapping: further topics.

    recorded: the bag that results were computed from, or a folder of such bags: it has their
    images and the further topics.
    Raises CmpTactileError for a source that cannot be exported.
    """
    if results := sorted(source.glob(f"*{TABLE}")) if source.is_dir() else ():
        for table in results:
            bag = source / f"{table.name.removesuffix(TABLE)}.mcap"
            yield from recordings(bag, mapping, recorded)
        return
    if is_bag(source):
        origin = None if recorded is None else _recorded_bag(source, recorded)
        names = list(topics_of_sensors(BagStorage(source).topics))
        # Without any, `load` says what is there.  A recording may have another name for one.
        asked = names if len(names) > 1 else [""]
        datasets = {
            name: load(source, sensor, origin or "")
            for name, sensor in zip(names or [""], asked, strict=True)
        }
        series = {k: v for name, item in datasets.items() for k, v in tactile_series(name, item)}
        if mapping is not None:
            series |= dict(mapped_series(origin or source, *mapping))
        yield Recording(str(source), series, _rate(next(iter(datasets.values()))))
        return
    dataset = load(source)
    if "sample" not in dataset.coords:
        expected = "a folder of `cmp_tactile dataset` or `process`, or a bag"
        msg = f"{source}: found no samples and no bag, expected {expected}"
        raise InputError(msg)
    if mapping is not None:
        raise mapping[0].error("features", str(source), "a bag: a dataset has no further topics")
    yield from _samples(source, dataset)


def _recorded_bag(result: Path, recorded: Path) -> Path:
    """The bag itself, or that with the name of the result in a folder of bags."""
    places = (recorded, *(recorded / f"{result.stem}{end}" for end in ("", *STORAGE_SUFFIXES)))
    found = next((place for place in reversed(places) if is_bag(place)), None)
    if found is None:
        msg = f"{recorded}: found no bag {result.stem}, expected the recording of {result}"
        raise InputError(msg)
    return found


def _samples(source: Path, dataset: xr.Dataset) -> Iterator[Recording]:
    name, rate = str(dataset.attrs.get("sensor", "sensor")), float(dataset.attrs["rate_hz"])
    sample = dataset["sample"].values
    begins = np.flatnonzero(np.diff(sample, prepend=sample[:1] - 1))
    ends = [*begins[1:], len(sample)]
    spans = zip(begins, ends, strict=True)
    for _, several in groupby(spans, key=lambda span: int(span[0]) // FRAMES_AT_ONCE):
        together = list(several)
        first = together[0][0]
        read = dataset.isel(frame=slice(first, together[-1][1])).load()
        for begin, end in together:
            part = read.isel(frame=slice(begin - first, end - first))
            label = f"{source}: sample {sample[begin]}"
            series = dict(tactile_series(name.replace(" ", "_"), part))
            yield Recording(label, series, rate, end / len(sample))


def _rate(dataset: xr.Dataset) -> float:
    """Frames per second, by the median of the steps; 0 for a single frame."""
    steps = np.diff(dataset["stamp_ns"].values)
    steps = steps[steps > 0]
    return NS_PER_S / float(np.median(steps)) if len(steps) else 0.0


def tactile_series(name: str, dataset: xr.Dataset) -> Iterator[tuple[str, Series]]:
    """The features of a sensor, as far as the dataset has what they are made of."""
    stamps, tactile = dataset["stamp_ns"].values, f"observation.tactile.{name}"
    count = dataset.sizes["frame"]
    if "displacement" in dataset:
        shape = (dataset.sizes["row"], dataset.sizes["col"], 6)
        weights = _marker_weights(dataset) if "node_force" in dataset else None
        points = partial(_points, dataset, weights)
        yield f"{tactile}.points", Series(Feature("float32", shape, POINTS), stamps, points)
    if "wrench" in dataset:
        wrench = dataset["wrench"].values.astype(np.float32)
        yield f"{tactile}.wrench", _plain(wrench, stamps, WRENCH_COMPONENTS)
    if "slip_state" in dataset:
        slip = np.stack([dataset[item].values.astype(np.float32) for item in SLIP], axis=1)
        yield f"{tactile}.slip", _plain(slip, stamps, SLIP)
    if "image" in dataset:
        there = np.arange(count)
        if "has_image" in dataset:
            there = np.flatnonzero(dataset["has_image"].values)
        image, image_stamps = dataset["image"], stamps[there]
        values = partial(_images, image, there)
        feature = image_feature(image.shape)
        yield f"observation.images.{name}", Series(feature, image_stamps, values)
    # Not below `observation.`, which LeRobot gives to a policy as input.
    if "wrench" in dataset:
        usable = dataset["usable"].values if "usable" in dataset else np.ones(count)
        flags = dataset["flags"].values if "flags" in dataset else np.zeros(count)
        yield f"tactile.{name}.usable", _plain(usable.astype(np.bool_)[:, None], stamps)
        yield f"tactile.{name}.flags", _plain(flags.astype(np.int64)[:, None], stamps)
    yield f"tactile.{name}.stamp_ns", _plain(stamps[:, None], stamps)


def _plain(values: Array, stamps: Stamps, names: tuple[str, ...] | None = None) -> Series:
    feature = Feature(str(values.dtype), values.shape[1:], names)
    return Series(feature, stamps, values.__getitem__)


def _images(images: xr.DataArray, there: NDArray[np.intp], numbers: NDArray[np.intp]) -> Array:
    return np.asarray(images[there[numbers]].values)


def _points(
    dataset: xr.Dataset, weights: tuple[Array, Array] | None, numbers: NDArray[np.intp]
) -> Array:
    displacement = dataset["displacement"][numbers].values
    force = np.full_like(displacement, np.nan)
    if weights is not None:
        nodes = dataset["node_force"][numbers].values
        force = np.einsum("rn,cm,fnmk->frck", *weights, nodes, optimize=True)
    return np.concatenate([displacement, force], axis=-1).astype(np.float32)


def _marker_weights(dataset: xr.Dataset) -> tuple[Array, Array]:
    """Shares of the force of each node that the markers get: (rows, node rows), (cols, node cols).

    A node between four markers is shared among them bilinearly, one beyond the outermost markers
    goes to these: the forces at the markers have the sum of those at the nodes.
    """
    first = dataset.isel(frame=slice(FRAMES_AT_ONCE))
    markers = (first["position"] - first["displacement"]).values.reshape(
        -1, dataset.sizes["row"], dataset.sizes["col"], 3
    )
    nodes = dataset["node_position"].values
    nodes = nodes.reshape(-1, *nodes.shape[-3:])[0]
    return (
        _line_weights(markers[..., 1].transpose(1, 0, 2), nodes[:, 0, 1]),
        _line_weights(markers[..., 0].transpose(2, 0, 1), nodes[0, :, 0]),
    )


def _line_weights(markers: Array, nodes: Array) -> Array:
    """(lines, nodes), of the places of all markers of each line, (lines, ...), NaN where unseen."""
    number = np.arange(len(markers))
    seen = np.array([np.isfinite(line).any() for line in markers])
    if np.count_nonzero(seen) < 2:
        return np.full((len(markers), len(nodes)), np.nan)
    middle = [np.nanmedian(line) for line in markers[seen]]
    # The lines are evenly spaced, also those of which no marker was seen.
    slope, start = np.polyfit(number[seen], middle, 1)
    lines = start + slope * number
    return np.stack([np.interp(nodes, lines, row) for row in np.eye(len(lines))])


def episodes(
    sources: Sequence[Path],
    mapping: tuple[YamlFile, FeatureMap] | None,
    fps: int | None,
    most_error_s: float | None,
    recorded: Path | None = None,
) -> Iterator[tuple[Episode, float]]:
    """All samples and bags on clocks of one rate, with the same features, and the share until then.

    fps: of the clock, Hz; None for the rate of the first.  most_error_s: see `on_clock`.
    recorded: see `recordings`.
    Raises CmpTactileError for a source that cannot be exported, or not with the first one.
    """
    first: Episode | None = None
    every = (
        (number, item)
        for number, source in enumerate(sources)
        for item in recordings(source, mapping, recorded)
    )
    for number, recording in every:
        rate = fps or (max(1, round(recording.rate_hz)) if recording.rate_hz else 0)
        if not rate:
            msg = f"{recording.label}: found a single frame, expected --fps"
            raise InputError(msg)
        if first is not None and rate != first.fps:
            expected = f"{first.fps} Hz as {first.label}; --fps gives all one clock"
            msg = f"{recording.label}: found {rate} Hz, expected {expected}"
            raise InputError(msg)
        episode = on_clock(recording, rate, most_error_s)
        first = first or episode
        _check_same(episode.features, first.features, (episode.label, first.label))
        yield episode, (number + recording.share) / len(sources)


def _check_same(
    found: Mapping[str, Feature], expected: Mapping[str, Feature], labels: tuple[str, str]
) -> None:
    for name in [*expected, *found]:
        if found.get(name) != expected.get(name):
            shown = [
                f"{name} of {'x'.join(map(str, one[name].shape))}" if name in one else f"no {name}"
                for one in (found, expected)
            ]
            hint = "different sensors need an export each"
            msg = f"{labels[0]}: found {shown[0]}, expected {shown[1]} as {labels[1]}; {hint}"
            raise InputError(msg)


def on_clock(recording: Recording, fps: int, most_error_s: float | None) -> Episode:
    """The recording on the ticks of a clock.

    most_error_s: s; None for one and a half periods of the clock.
    Raises InputError where a series is farther from a tick, and where nothing is left.
    """
    series = recording.series
    frames = next(iter(series.values())).stamp_ns
    begin = max((s.stamp_ns[0] for s in series.values() if s.is_latest), default=frames[0])
    clock = frames[frames >= begin]
    if not clock.size:
        msg = f"{recording.label}: found no frame after the first message of each mapped topic"
        raise InputError(msg + ", expected topics that were recorded together")
    limit = DEFAULT_ERROR_PERIODS / fps if most_error_s is None else most_error_s
    # Before ticks are made for all of a gap.
    _check_error(recording, next(iter(series)), np.diff(clock).max(initial=0) / 2, fps, limit)
    count = int((clock[-1] - clock[0]) * fps / NS_PER_S + 0.5) + 1
    ticks = clock[0] + np.round(np.arange(count) * (NS_PER_S / fps)).astype(np.int64)
    at = clock[_nearest(clock, ticks)]
    numbers, error_s = {}, {}
    for name, item in series.items():
        if item.is_latest:
            numbers[name] = np.searchsorted(item.stamp_ns, at, "right") - 1
            errors = at - item.stamp_ns[numbers[name]]
        else:
            numbers[name] = _nearest(item.stamp_ns, ticks)
            errors = np.abs(ticks - item.stamp_ns[numbers[name]])
        error_s[name] = _check_error(recording, name, errors.max(), fps, limit)
    left_out = len(frames) - len(clock)
    return Episode(recording.label, series, numbers, error_s, limit, left_out, fps)


def _check_error(
    recording: Recording, name: str, error_ns: float, fps: int, limit_s: float
) -> float:
    """The error in s; InputError where it exceeds the limit."""
    error_s = float(error_ns) / NS_PER_S
    if error_s > limit_s:
        what = "the latest message" if recording.series[name].is_latest else "the nearest frame"
        msg = (
            f"{recording.label}: {name}: found {what} {error_s:.3g} s from a tick of the clock of "
            f"{fps} Hz, expected at most {limit_s:.3g} s; --fps sets the clock, "
            "--max-error the limit"
        )
        raise InputError(msg)
    return error_s


def _nearest(stamps: Stamps, ticks: Stamps) -> NDArray[np.intp]:
    after = np.clip(np.searchsorted(stamps, ticks), 1, max(1, len(stamps) - 1))
    before = after - 1
    if len(stamps) == 1:
        return np.zeros(len(ticks), np.intp)
    return np.where(ticks - stamps[before] <= stamps[after] - ticks, before, after)
