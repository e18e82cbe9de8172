"""Episodes as a LeRobot dataset v3.0: parquet files, images as PNG in them or MP4 beside them."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.export.episodes import RULE, Episode
from cmp_tactile_bringup.export.topics import INDEX_FEATURES, Feature
from cmp_tactile_processing.cache.files import partial_folder
from cmp_tactile_processing.errors import CmpTactileError, OutputError

Array = NDArray[Any]
Stats = dict[str, Array]

VERSION = "v3.0"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
FILES_PER_CHUNK, DATA_FILE_MB, VIDEO_FILE_MB = 1000, 100, 200
FRAMES_PER_GROUP = 64
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
# Statistics of images are those of every n-th pixel, so that so many of a side are left.
PIXELS_OF_A_SIDE = 128
# Of a frame of 1024 x 768 px half the bytes of OpenCV's own choice, in twice the time.
PNG_OPTIONS = (cv2.IMWRITE_PNG_COMPRESSION, 3)
# What decodes fast frame by frame, and looks like the original.
VIDEO_CODEC, VIDEO_OPTIONS = "libx264", {"crf": "18", "g": "2", "preset": "fast"}


@contextmanager
def new_folder(output: Path) -> Iterator[Path]:
    """A folder that takes its place as `output` when it is whole; after an error nothing is left.

    Raises OutputError where output exists, and as `partial_folder` does.
    """
    with partial_folder(output) as beside:
        if output.exists():
            msg = f"{output}: exists already, expected a new folder"
            raise OutputError(msg)
        yield beside
        beside.replace(output)


def require_video() -> None:
    """Raise OutputError where videos cannot be written."""
    try:
        import_module("av")
    except ImportError as error:
        msg = f"--images video: found no PyAV ({error}), expected the package: pip install av"
        raise OutputError(msg) from None


class LeRobotWriter:
    """Writes a folder, episode after episode; `close` writes what is said of all of them."""

    def __init__(
        self, folder: Path, first: Episode, task: str, *, video: bool, facts: Mapping[str, Any]
    ) -> None:
        """first: gives clock and features.  facts: of the export, for info.json."""
        import pyarrow as pa

        self._folder, self._fps, self._task, self._facts = folder, first.fps, task, facts
        self._limit_s = first.limit_s
        self._features = {
            name: Feature("video", item.shape, item.names)
            if video and item.dtype == "image"
            else item
            for name, item in {**first.features, **INDEX_FEATURES}.items()
        }
        stored = {name: item for name, item in self._features.items() if item.dtype != "video"}
        known = json.dumps({"info": {"features": {k: _hub_type(v) for k, v in stored.items()}}})
        self._schema = pa.schema(
            [pa.field(name, _arrow_type(item)) for name, item in stored.items()],
            metadata={"huggingface": known},
        )
        self._data = _Files(folder, DATA, DATA_FILE_MB, self._new_table)
        self._videos = {
            name: _Files(folder, VIDEO.replace("{video_key}", name), VIDEO_FILE_MB, self._new_video)
            for name, item in self._features.items()
            if item.dtype == "video"
        }
        self._episodes: list[dict[str, Any]] = []
        self._stats: list[dict[str, Stats]] = []
        self._error_s: dict[str, float] = {}
        self.frames = self.left_out = 0

    @property
    def episodes(self) -> int:
        """How many were written."""
        return len(self._episodes)

    @property
    def error_s(self) -> dict[str, float]:
        """The largest time between a series and the clock, by feature."""
        return self._error_s

    def add(self, episode: Episode) -> None:
        """Write all frames of an episode."""
        number, first = len(self._episodes), self.frames
        table, place = self._data.next_file()
        videos = {name: files.next_file() for name, files in self._videos.items()}
        begins = {name: video.seconds for name, (video, _) in videos.items()}
        sampled: dict[str, list[Array]] = {name: [] for name in self._features}
        for start in range(0, episode.length, FRAMES_PER_GROUP):
            part = slice(start, min(start + FRAMES_PER_GROUP, episode.length))
            columns = {**episode.read(part), **self._indices(part, number)}
            for name, item in self._features.items():
                values = columns[name]
                if len(item.shape) == 3 and item.dtype in {"image", "video"}:
                    step = max(1, max(values.shape[1:3]) // PIXELS_OF_A_SIDE)
                    values = _rgb(values[:, ::step, ::step])
                sampled[name].append(values)
            for name, (video, _) in videos.items():
                video.add(_rgb(columns[name]))
            arrays = [
                _arrow_array(columns[field.name], self._features[field.name], field.type)
                for field in self._schema
            ]
            table.add(arrays)
        self.frames += episode.length
        self.left_out += episode.left_out
        for name, error in episode.error_s.items():
            self._error_s[name] = max(error, self._error_s.get(name, 0.0))
        stats = {
            name: _stats(np.concatenate(parts), self._features[name])
            for name, parts in sampled.items()
        }
        self._stats.append(stats)
        row = {
            "episode_index": number,
            "tasks": [self._task],
            "length": episode.length,
            "source": episode.label,
            **place.columns("data"),
            "dataset_from_index": first,
            "dataset_to_index": self.frames,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for name, (video, where) in videos.items():
            times = {"from_timestamp": begins[name], "to_timestamp": video.seconds}
            row |= where.columns(f"videos/{name}")
            row |= {f"videos/{name}/{key}": value for key, value in times.items()}
        for name, figures in _listed(stats).items():
            row |= {f"stats/{name}/{key}": value for key, value in figures.items()}
        self._episodes.append(row)

    def close(self) -> None:
        """Close the files, and write `meta/`."""
        import pandas as pd
        import pyarrow as pa
        import pyarrow.parquet as pq

        for files in (self._data, *self._videos.values()):
            files.close()
        path = self._folder / EPISODES
        path.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(self._episodes), path)
        tasks = pd.DataFrame({"task_index": [0]}, index=[self._task])
        tasks.to_parquet(self._folder / "meta" / "tasks.parquet")
        self._write_json("stats", _listed(_joined(self._stats)))
        self._write_json("info", self._info())

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": VERSION,
            "robot_type": "cmp_tactile",
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": 1,
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": DATA_FILE_MB,
            "video_files_size_in_mb": VIDEO_FILE_MB,
            "fps": self._fps,
            "splits": {"train": f"0:{self.episodes}"},
            "data_path": DATA,
            "video_path": VIDEO if self._videos else None,
            "features": {name: self._described(item) for name, item in self._features.items()},
            "cmp_tactile": {
                **self._facts,
                "synchronisation": {
                    "rule": RULE,
                    "limit_s": self._limit_s,
                    "largest_error_s": self._error_s,
                },
                "frames_left_out": self.left_out,
            },
        }

    def _described(self, item: Feature) -> dict[str, Any]:
        names = None if item.names is None else list(item.names)
        found: dict[str, Any] = {"dtype": item.dtype, "shape": list(item.shape), "names": names}
        if item.dtype == "video":
            height, width, channels = item.shape
            facts = {"height": height, "width": width, "channels": channels, "fps": self._fps}
            kind = {"codec": "h264", "pix_fmt": _pixel_format(item.shape), "is_depth_map": False}
            found["info"] = {f"video.{key}": value for key, value in {**facts, **kind}.items()}
            found["info"]["has_audio"] = False
        return found

    def _indices(self, part: slice, episode: int) -> dict[str, Array]:
        numbers = np.arange(part.start, part.stop)
        found = {
            "timestamp": (numbers / self._fps).astype(np.float32),
            "frame_index": numbers,
            "episode_index": np.full_like(numbers, episode),
            "index": numbers + self.frames,
            "task_index": np.zeros_like(numbers),
        }
        return {name: values[:, None] for name, values in found.items()}

    def _new_table(self, path: Path) -> _Table:
        return _Table(path, self._schema)

    def _new_video(self, path: Path) -> _Video:
        return _Video(path, self._fps)

    def _write_json(self, name: str, content: Any) -> None:
        text = json.dumps(content, indent=4, ensure_ascii=False, allow_nan=False)
        (self._folder / "meta" / f"{name}.json").write_text(text, encoding="utf-8")


class _Place:
    """Chunk and number of a file."""

    def __init__(self, number: int) -> None:
        self.chunk, self.file = divmod(number, FILES_PER_CHUNK)

    def columns(self, prefix: str) -> dict[str, int]:
        return {f"{prefix}/chunk_index": self.chunk, f"{prefix}/file_index": self.file}


class _Files:
    """Files that are written one after the other; an episode lies in one of them."""

    def __init__(self, folder: Path, form: str, most_mb: int, new: Any) -> None:
        """new: makes one that has `add` and `close` of its path."""
        self._folder, self._form, self._most_bytes, self._new = folder, form, most_mb << 20, new
        self._path, self._current, self._number = Path(), None, -1

    def next_file(self) -> tuple[Any, _Place]:
        """That of the next episode, and where it is."""
        if self._current is None or self._path.stat().st_size > self._most_bytes:
            self.close()
            self._number += 1
            place = _Place(self._number)
            named = self._form.format(chunk_index=place.chunk, file_index=place.file)
            self._path = self._folder / named
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._current = self._new(self._path)
        return self._current, _Place(self._number)

    def close(self) -> None:
        if self._current is not None:
            self._current.close()


class _Table:
    """A parquet file of frames."""

    def __init__(self, path: Path, schema: Any) -> None:
        import pyarrow.parquet as pq

        self._schema, self._file = schema, pq.ParquetWriter(path, schema, compression="snappy")

    def add(self, arrays: Sequence[Any]) -> None:
        import pyarrow as pa

        self._file.write_table(pa.Table.from_arrays(arrays, schema=self._schema))

    def close(self) -> None:
        self._file.close()


class _Video:
    """An MP4 file of frames at the rate of the clock."""

    def __init__(self, path: Path, fps: int) -> None:
        # Whoever writes no video does not need it.
        self._av: Any = import_module("av")
        self._container: Any = self._av.open(str(path), "w")
        self._fps, self._count = fps, 0
        self._stream: Any = None

    @property
    def seconds(self) -> float:
        """How long it is."""
        return self._count / self._fps

    def add(self, images: NDArray[np.uint8]) -> None:
        """images: (frames, height, width, 3) RGB."""
        if self._stream is None:
            self._stream = self._container.add_stream(VIDEO_CODEC, rate=self._fps)
            self._stream.height, self._stream.width = images.shape[1:3]
            self._stream.pix_fmt = _pixel_format(images.shape[1:])
            self._stream.options = VIDEO_OPTIONS
        for image in images:
            frame = self._av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts = self._count
            self._container.mux(self._stream.encode(frame))
            self._count += 1

    def close(self) -> None:
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()


def _pixel_format(shape: Sequence[int]) -> str:
    """Colours are halved in size only where that leaves whole pixels."""
    return "yuv444p" if shape[0] % 2 or shape[1] % 2 else "yuv420p"


def _rgb(images: Array) -> NDArray[np.uint8]:
    """Of grey or BGR images (frames, height, width[, 3])."""
    if images.ndim == 3:
        return np.repeat(images[..., None], 3, axis=-1)
    return np.ascontiguousarray(images[..., ::-1])


def _arrow_type(item: Feature) -> Any:
    import pyarrow as pa

    if item.dtype == "image":
        return pa.struct({"bytes": pa.binary(), "path": pa.string()})
    kind = pa.bool_() if item.dtype == "bool" else pa.type_for_alias(item.dtype)
    if item.shape == (1,):
        return kind
    if len(item.shape) == 1:
        return pa.list_(kind, item.shape[0])
    for _ in item.shape:
        kind = pa.list_(kind)
    return kind


def _arrow_array(values: Array, item: Feature, kind: Any) -> Any:
    import pyarrow as pa

    if item.dtype == "image":
        # OpenCV leaves other threads the interpreter.
        with ThreadPoolExecutor() as pool:
            encoded = [{"bytes": data, "path": None} for data in pool.map(_png, values)]
        return pa.array(encoded, kind)
    flat = pa.array(values.ravel())
    if item.shape == (1,):
        return flat
    if len(item.shape) == 1:
        return pa.FixedSizeListArray.from_arrays(flat, item.shape[0])
    for size in reversed(item.shape):
        offsets = np.arange(len(flat) // size + 1, dtype=np.int32) * size
        flat = pa.ListArray.from_arrays(pa.array(offsets), flat)
    return flat


def _png(image: Array) -> bytes:
    """A grey picture as one of three equal colours, which LeRobot expects."""
    colours = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    done, data = cv2.imencode(".png", colours, PNG_OPTIONS)
    if not done:
        msg = f"found an image of {image.shape}, expected one that PNG can hold"
        raise CmpTactileError(msg)
    return data.tobytes()


def _hub_type(item: Feature) -> dict[str, Any]:
    """As the library `datasets` writes it into the file."""
    if item.dtype == "image":
        return {"_type": "Image"}
    value = {"dtype": item.dtype, "_type": "Value"}
    if item.shape == (1,):
        return value
    if len(item.shape) == 1:
        return {"feature": value, "length": item.shape[0], "_type": "List"}
    return {"shape": item.shape, "dtype": item.dtype, "_type": f"Array{len(item.shape)}D"}


def _stats(values: Array, item: Feature) -> Stats:
    """Of the known values of an episode: one of each component, or colour; `known` is their number.

    Of arrays with several axes, all markers count together: a marker that nothing touches has no
    spread of its own.
    """
    over = tuple(range(values.ndim - 1))
    numbers = values.astype(np.float64)
    shape: tuple[int, ...] = (1,) * (len(item.shape) - 1) + (values.shape[-1],)
    if item.dtype in {"image", "video"}:
        numbers /= 255
        shape = (3, 1, 1)
    with warnings.catch_warnings(), np.errstate(invalid="ignore"):
        # A component that is never known has NaN.
        warnings.simplefilter("ignore", RuntimeWarning)
        found = {
            "min": np.nanmin(numbers, over),
            "max": np.nanmax(numbers, over),
            "mean": np.nanmean(numbers, over),
            "std": np.nanstd(numbers, over),
            **dict(
                zip(QUANTILES, np.nanquantile(numbers, [*QUANTILES.values()], over), strict=True)
            ),
            "known": np.isfinite(numbers).sum(over).astype(np.float64),
        }
    shaped = {name: array.reshape(shape) for name, array in found.items()}
    return {**shaped, "count": np.array([len(values)])}


def _joined(episodes: Sequence[dict[str, Stats]]) -> dict[str, Stats]:
    """Of all episodes, as LeRobot joins them: quantiles are weighted means of theirs."""
    joined = {}
    for feature in episodes[0]:
        each = {
            key: np.stack([item[feature][key] for item in episodes]) for key in episodes[0][feature]
        }
        known = each["known"]
        total = np.maximum(known.sum(axis=0), 1)

        def mean(values: Array, known: Array = known, total: Array = total) -> Array:
            return np.asarray((np.nan_to_num(values) * known).sum(axis=0) / total)

        middle = mean(each["mean"])
        joined[feature] = {
            "min": np.fmin.reduce(each["min"]),
            "max": np.fmax.reduce(each["max"]),
            "mean": middle,
            "std": np.sqrt(mean(each["std"] ** 2 + (each["mean"] - middle) ** 2)),
            **{name: mean(each[name]) for name in QUANTILES},
            "count": each["count"].sum(axis=0),
        }
    return joined


def _listed(stats: Mapping[str, Stats]) -> dict[str, dict[str, Any]]:
    """For a file: JSON knows no NaN, so what is never known is 0."""
    return {
        feature: {key: np.nan_to_num(v).tolist() for key, v in item.items() if key != "known"}
        for feature, item in stats.items()
    }
