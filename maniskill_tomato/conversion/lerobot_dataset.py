"""Writes LeRobotDataset v3.0, the format of LeRobot's recorders and learners, without LeRobot.

    meta/info.json            what the features are
    meta/tasks.parquet        the tasks in words
    meta/stats.json           statistics of every feature
    meta/episodes/...parquet  length, place and statistics of every episode
    data/...parquet           the frames: one row group for each episode

Colours are PNG, depth is TIFF of 16 bits in [mm]: both come back bit by bit.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.conversion.episodes import FLAG, Episode, Feature
from maniskill_tomato.conversion.feature_statistics import (
    PixelStatistics,
    Statistics,
    joined_statistics,
    number_statistics,
)
from maniskill_tomato.errors import InvalidInputError, MissingPackageError

VERSION: Final = "v3.0"

FILES_OF_A_FOLDER: Final = 1000
LARGEST_FILE_MB: Final = 100
LARGEST_VIDEO_MB: Final = 200

DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_FILE: Final = "meta/episodes/chunk-000/file-000.parquet"

COUNTED: Final[dict[str, Feature]] = {
    "timestamp": Feature(dtype="float32", shape=FLAG),
    "frame_index": Feature(dtype="int64", shape=FLAG),
    "episode_index": Feature(dtype="int64", shape=FLAG),
    "index": Feature(dtype="int64", shape=FLAG),
    "task_index": Feature(dtype="int64", shape=FLAG),
}
"""The features that every data set has, which the writer counts itself."""


class LeRobotWriter:
    """Writes episodes one after the other; `finish` makes the folder a data set."""

    def __init__(self, folder: Path, features: Mapping[str, Feature], fps: int, robot: str) -> None:
        """Begins.

        Args:
            folder: Exists and is empty.
            features: Of every frame.
            fps: Frames a second, by which they get their time stamps.
            robot: Type of the robot.

        Raises:
            MissingPackageError: pyarrow is not installed.
            InvalidInputError: A feature has a name that the format does not allow.
        """
        _check_installed()
        for name in features:
            if "/" in name or name in COUNTED:
                raise InvalidInputError(
                    f"a feature must not be called {name!r}: {', '.join(COUNTED)} are counted, and names have no slash"
                )
        self._folder = folder
        self._features = dict(features)
        self._fps = fps
        self._robot = robot
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._statistics: list[dict[str, Statistics]] = []
        self._frames = 0
        self._file: Any = None
        self._file_number = -1
        self._file_bytes = 0

    def add(self, episode: Episode) -> int:
        """Writes an episode.

        Returns:
            Its number of frames.

        Raises:
            InvalidInputError: It has none, or one that is not as its feature says.
        """
        images = {name: feature for name, feature in self._features.items() if feature.dtype == "image"}
        pixels = {
            name: PixelStatistics(1, 65536, 1.0) if feature.is_depth else PixelStatistics(3, 256, 255.0)
            for name, feature in images.items()
        }
        columns: dict[str, list[Any]] = {name: [] for name in self._features}
        length = 0
        for frame in episode.frames:
            where = f"{episode.source}, frame {length}"
            for name, feature in self._features.items():
                if name not in frame:
                    raise InvalidInputError(f"{where} has no {name}; frames of one data set are alike")
                value = frame[name]
                feature.check(name, value, where)
                if feature.dtype == "image":
                    pixels[name].add(value)
                    columns[name].append(_packed(value, length))
                else:
                    columns[name].append(value)
            length += 1
        if not length:
            raise InvalidInputError(f"{episode.source} has no frame that could be written")
        arrays = {name: np.stack(values) for name, values in columns.items() if name not in images}
        arrays |= self._counted(length, episode.task)
        statistics = {name: number_statistics(values.reshape(length, -1)) for name, values in arrays.items()}
        statistics |= {name: counts.result() for name, counts in pixels.items()}
        self._write(columns, arrays)
        self._episodes.append(self._episode_row(length, episode.task, statistics))
        self._statistics.append(statistics)
        self._frames += length
        return length

    def finish(self) -> None:
        """Writes what stands in `meta`.

        Raises:
            InvalidInputError: There is no episode.
        """
        import pyarrow as pa
        from pyarrow import parquet

        if not self._episodes:
            raise InvalidInputError("there is no episode to be written")
        self.close()
        meta = self._folder / "meta"
        (self._folder / EPISODES_FILE).parent.mkdir(parents=True)
        parquet.write_table(pa.Table.from_pylist(self._episodes), self._folder / EPISODES_FILE)
        parquet.write_table(_task_table(self._tasks), meta / "tasks.parquet")
        names = self._statistics[0]
        joined = {name: joined_statistics([one[name] for one in self._statistics]) for name in names}
        _write_json(meta / "stats.json", {name: _plain(one) for name, one in joined.items()})
        _write_json(meta / "info.json", self._info())

    def close(self) -> None:
        """Closes the file under way."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _counted(self, length: int, task: str) -> dict[str, NDArray[Any]]:
        frame_index = np.arange(length, dtype=np.int64)
        number = self._tasks.setdefault(task, len(self._tasks))
        return {
            "timestamp": (frame_index / self._fps).astype(np.float32),
            "frame_index": frame_index,
            "episode_index": np.full(length, len(self._episodes), dtype=np.int64),
            "index": self._frames + frame_index,
            "task_index": np.full(length, number, dtype=np.int64),
        }

    def _write(self, columns: Mapping[str, list[Any]], arrays: Mapping[str, NDArray[Any]]) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        parts = {}
        for name, feature in (self._features | COUNTED).items():
            if feature.dtype == "image":
                kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
                parts[name] = pa.array(columns[name], type=kind)
            elif feature.shape == FLAG:
                parts[name] = pa.array(arrays[name].reshape(-1))
            else:
                parts[name] = pa.FixedSizeListArray.from_arrays(
                    pa.array(arrays[name].reshape(-1)), feature.shape[0]
                )
        table = pa.table(parts)
        if self._file is None or self._file_bytes + table.nbytes > LARGEST_FILE_MB * 2**20:
            self.close()
            self._file_number, self._file_bytes = self._file_number + 1, 0
            path = self._folder / DATA_PATH.format(**self._place())
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = parquet.ParquetWriter(path, table.schema)
        # As LeRobot has it, a row group holds an episode, so that one can be read alone.
        self._file.write_table(table, row_group_size=len(table))
        self._file_bytes += table.nbytes

    def _place(self) -> dict[str, int]:
        chunk, file = divmod(self._file_number, FILES_OF_A_FOLDER)
        return {"chunk_index": chunk, "file_index": file}

    def _episode_row(self, length: int, task: str, statistics: Mapping[str, Statistics]) -> dict[str, Any]:
        place = self._place()
        row: dict[str, Any] = {
            "episode_index": len(self._episodes),
            "tasks": [task],
            "length": length,
            "data/chunk_index": place["chunk_index"],
            "data/file_index": place["file_index"],
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + length,
        }
        for name, one in statistics.items():
            row |= {f"stats/{name}/{key}": values for key, values in _plain(one).items()}
        return row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": VERSION,
            "fps": self._fps,
            "features": {name: _described(one) for name, one in (self._features | COUNTED).items()},
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_OF_A_FOLDER,
            "data_files_size_in_mb": LARGEST_FILE_MB,
            "video_files_size_in_mb": LARGEST_VIDEO_MB,
            "data_path": DATA_PATH,
            "video_path": None,
            "robot_type": self._robot,
            "splits": {"train": f"0:{len(self._episodes)}"},
        }


def _check_installed() -> None:
    try:
        import pyarrow as _  # noqa: F401
    except ImportError as error:
        raise MissingPackageError.extra("pyarrow", "lerobot") from error


def _packed(image: NDArray[Any], number: int) -> dict[str, Any]:
    """An image as a file in a cell of the table."""
    if image.shape[2] == 1:
        ending, (ok, content) = "tiff", cv2.imencode(".tiff", image[..., 0])
    else:
        ending, (ok, content) = "png", cv2.imencode(".png", image[..., ::-1])
    if not ok:
        raise InvalidInputError(f"an image of shape {image.shape} cannot be packed as {ending.upper()}")
    return {"bytes": content.tobytes(), "path": f"frame-{number:06d}.{ending}"}


def _task_table(tasks: Mapping[str, int]) -> Any:
    """Tasks and their numbers; pandas, which LeRobot reads them with, makes the tasks the index."""
    import pyarrow as pa

    def column(name: str, kind: str, dtype: str) -> dict[str, Any]:
        return {
            "name": name,
            "field_name": name,
            "pandas_type": kind,
            "numpy_type": dtype,
            "metadata": None,
        }

    described = {
        "index_columns": ["task"],
        "column_indexes": [
            {**column("", "unicode", "object"), "name": None, "field_name": None}
            | {"metadata": {"encoding": "UTF-8"}}
        ],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    table = pa.table(
        {"task_index": pa.array(tasks.values(), pa.int64()), "task": pa.array(tasks, pa.string())}
    )
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def _described(feature: Feature) -> dict[str, Any]:
    names = None if feature.names is None else list(feature.names)
    described: dict[str, Any] = {"dtype": feature.dtype, "shape": list(feature.shape), "names": names}
    info = dict(feature.info)
    if feature.is_depth:
        info |= {"is_depth_map": True, "depth_unit": "mm"}
    return described | ({"info": info} if info else {})


def _plain(statistics: Statistics) -> dict[str, Any]:
    return {name: values.tolist() for name, values in statistics.items()}


def _write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=4, allow_nan=False) + "\n", encoding="utf-8")
