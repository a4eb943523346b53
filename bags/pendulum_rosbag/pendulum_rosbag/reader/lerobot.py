"""Bags as a learning dataset in LeRobot's format v3.0: a frame is a state with the effort commanded in reply.

Format: https://huggingface.co/docs/lerobot/lerobot-dataset-v3; read back with lerobot 0.4.4.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.atomic_write import writing
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import BagError, DataError, ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_rosbag.reader.bag import Bag
from pendulum_rosbag.reader.joint_table import JointTable

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["DEFAULT_TASK", "Episode", "episodes_of", "export_lerobot"]

DEFAULT_TASK = "keep the pendulum upright"
_STATE, _EFFORT, _ACTION = "observation.state", "observation.effort", "action"
_LONGEST_HOLE = 5
"""Frames for which a hole in the states is bridged by the nearest state; a longer one ends the episode."""
_LEAST_FRAMES = 2
_ROWS_PER_FILE = 1_000_000
_CHUNK = 1000
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Episode:
    """Frames at a constant rate, without holes.

    Attributes:
        joints: Names of the joints, in the order of the columns.
        driven: Names of the commanded joints.
        state: Positions, then velocities; shape (k, 2 n) [rad or m, rad/s or m/s].
        effort: Measured, shape (k, n) [N m or N]; NaN if not measured.
        action: Commanded in reply to each state, shape (k, m) [N m or N].
    """

    source: str
    topic: str
    joints: tuple[str, ...]
    driven: tuple[str, ...]
    state: Array
    effort: Array
    action: Array


def episodes_of(bag: Bag, fps: int) -> list[Episode]:
    """Return the parts of a bag in which the states of a plant were answered with commands, at ``fps`` [Hz].

    Frame k is the state nearest to k / fps with the command of its stamp, or else the previous command, which the plant
    held. A DataError if there is no plant with commands for at least two frames.
    """
    found: list[Episode] = []
    for topic, commanded in _commanded(bag):
        if bag.topics[topic].count and bag.topics[commanded].count:
            found += _stretches(bag, topic, bag.joints(topic), bag.joints(commanded), fps)
    if not found:
        raise DataError(
            f"bag {bag.path} has no episode; expected {names.JOINT_STATES} and an {names.EFFORT_COMMAND} beside it "
            f"that answered them for at least {_LEAST_FRAMES / fps:g} s "
            f"(its topics: {', '.join(sorted(bag.topics)) or 'none'})"
        )
    return found


def _commanded(bag: Bag) -> Iterator[tuple[str, str]]:
    """Yield the topics of states that have a topic of commands alongside, with it."""
    for topic in sorted(bag.topics):
        space = topic.removesuffix(names.JOINT_STATES)
        commanded = f"{space}{names.drive_topics(bag.topics, space.rstrip('/')).command}"
        if topic.rpartition("/")[2] == names.JOINT_STATES and commanded in bag.topics:
            yield topic, commanded


def _stretches(bag: Bag, topic: str, states: JointTable, commands: JointTable, fps: int) -> Iterator[Episode]:
    order = np.argsort(states.stamp_ns, kind="stable")
    stamps = states.stamp_ns[order]
    newest = np.argsort(commands.stamp_ns, kind="stable")
    answered = commands.stamp_ns[newest]
    # From the first state with a command to the last.
    first, last = np.searchsorted(stamps, (answered[0], answered[-1]))
    last = min(int(last), len(stamps) - 1)
    if first > last:
        return
    grid = np.arange(stamps[first], stamps[last] + 1, 1e9 / fps).astype(np.int64)
    nearest = first + _nearest(stamps[first : last + 1], grid)
    distance = np.abs(stamps[nearest] - grid)
    held = np.searchsorted(answered, stamps[nearest], side="right") - 1
    usable = (distance <= _LONGEST_HOLE * 1e9 / fps) & (held >= 0)
    picked, action = order[nearest], commands.effort[newest[np.maximum(held, 0)]]
    for values in (action, states.position[picked], states.velocity[picked]):
        usable &= np.isfinite(values).all(axis=1)
    ends = np.flatnonzero(np.diff(np.concatenate(([0], usable.astype(np.int8), [0]))))
    for start, stop in zip(ends[::2], ends[1::2], strict=True):
        if stop - start < _LEAST_FRAMES:
            continue
        rows = picked[start:stop]
        yield Episode(
            str(bag.path),
            topic,
            states.names,
            commands.names,
            np.hstack((states.position[rows], states.velocity[rows])).astype(np.float32),
            states.effort[rows].astype(np.float32),
            action[start:stop].astype(np.float32),
        )


def _nearest(sorted_times: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.intp]:
    right = np.clip(np.searchsorted(sorted_times, wanted), 1, max(1, len(sorted_times) - 1))
    right = np.minimum(right, len(sorted_times) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(wanted - sorted_times[left] <= sorted_times[right] - wanted, left, right)


def _rate(bags: Sequence[Bag]) -> int:
    """Return the state rate of the slowest commanded plant, in whole frames per second [Hz]."""
    rates = []
    for bag in bags:
        for topic, _ in _commanded(bag):
            stamps = np.sort(bag.joints(topic).stamp_ns) if bag.topics[topic].count > 1 else np.zeros(0)
            periods = np.diff(stamps)
            if (periods > 0).any():
                rates.append(1e9 / float(np.median(periods[periods > 0])))
    return max(1, round(min(rates))) if rates else 1


def export_lerobot(
    bags: Sequence[Bag], folder: Path, *, fps: int | None = None, task: str = DEFAULT_TASK
) -> list[Path]:
    """Write bags of plants with the same joints as one LeRobot v3.0 dataset; return the files.

    ``fps`` [Hz] is by default the state rate of the slowest plant; ``task`` is the task in words.

    Raises:
        BagError: The folder exists or cannot be written.
        DataError: A bag has no commands, or the joints differ.
        ParameterError: The rate is below 1 Hz or the task is empty.
    """
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet

    if folder.exists():
        raise BagError(f"{folder} exists already; expected a new folder")
    if fps is not None and fps < 1:
        raise ParameterError(f"fps is {fps} Hz; expected >= 1")
    if not task.strip():
        raise ParameterError("task is empty; expected what was to be done, in words")
    rate = fps or _rate(bags)
    episodes = [episode for bag in bags for episode in episodes_of(bag, rate)]
    features = _features(episodes)

    files: list[Path] = []
    rows: list[dict[str, Any]] = []
    written: list[pa.Table] = []
    total, file_index = 0, 0
    everything: dict[str, list[NDArray[Any]]] = {name: [] for name in features}
    with writing(f"folder {folder}", BagError):
        (folder / "meta").mkdir(parents=True)

        def flush() -> None:
            nonlocal file_index
            path = folder / "data" / _FILE.format(chunk_index=file_index // _CHUNK, file_index=file_index % _CHUNK)
            path.parent.mkdir(parents=True, exist_ok=True)
            pyarrow.parquet.write_table(pa.concat_tables(written), path)
            files.append(path)
            written.clear()
            file_index += 1

        for index, episode in enumerate(episodes):
            columns = _columns(episode, index, total, rate)
            columns = {name: columns[name] for name in features}
            written.append(_table(columns, features))
            count = len(episode.state)
            rows.append(
                {
                    "episode_index": index,
                    "tasks": [task],
                    "length": count,
                    "dataset_from_index": total,
                    "dataset_to_index": total + count,
                    "data/chunk_index": file_index // _CHUNK,
                    "data/file_index": file_index % _CHUNK,
                    "meta/episodes/chunk_index": 0,
                    "meta/episodes/file_index": 0,
                    "source": f"{episode.source}{episode.topic}",
                    **{
                        f"stats/{name}/{key}": value
                        for name, values in columns.items()
                        for key, value in _statistics(values).items()
                    },
                }
            )
            for name, values in columns.items():
                everything[name].append(values)
            total += count
            if sum(len(table) for table in written) >= _ROWS_PER_FILE:
                flush()
        if written:
            flush()
        path = folder / "meta" / "episodes" / _FILE.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True)
        pyarrow.parquet.write_table(pa.Table.from_pylist(rows), path)
        tasks = folder / "meta" / "tasks.parquet"
        pd.DataFrame({"task_index": [0]}, index=pd.Index([task], name="task")).to_parquet(tasks)
        statistics = {name: _statistics(np.concatenate(values)) for name, values in everything.items()}
        info = {
            "codebase_version": "v3.0",
            "robot_type": "pendulum",
            "total_episodes": len(episodes),
            "total_frames": total,
            "total_tasks": 1,
            "chunks_size": _CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": rate,
            "splits": {"train": f"0:{len(episodes)}"},
            "data_path": f"data/{_FILE}",
            "video_path": None,
            "features": features,
        }
        files += [path, tasks]
        for name, content in (("info.json", info), ("stats.json", statistics)):
            files.append(folder / "meta" / name)
            files[-1].write_text(json_text(content) + "\n", encoding="utf-8")
    return files


def _features(episodes: Sequence[Episode]) -> dict[str, dict[str, Any]]:
    joints, driven = episodes[0].joints, episodes[0].driven
    for episode in episodes[1:]:
        if (episode.joints, episode.driven) != (joints, driven):
            raise DataError(
                f"{episode.source} has the joints {', '.join(episode.joints)}, commanded {', '.join(episode.driven)}, "
                f"and {episodes[0].source} {', '.join(joints)}, commanded {', '.join(driven)}; expected the same in "
                "one dataset"
            )
    vectors = {
        _STATE: [*(f"{joint}.position" for joint in joints), *(f"{joint}.velocity" for joint in joints)],
        _EFFORT: [f"{joint}.effort" for joint in joints],
        _ACTION: [f"{joint}.effort" for joint in driven],
    }
    if not all(np.isfinite(episode.effort).all() for episode in episodes):
        del vectors[_EFFORT]  # not measured
    numbers = {"timestamp": "float32"} | dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
    return {
        **{name: {"dtype": "float32", "shape": [len(words)], "names": words} for name, words in vectors.items()},
        **{name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in numbers.items()},
    }


def _columns(episode: Episode, index: int, before: int, rate: int) -> dict[str, NDArray[Any]]:
    frames = np.arange(len(episode.state), dtype=np.int64)
    return {
        _STATE: episode.state,
        _EFFORT: episode.effort,
        _ACTION: episode.action,
        "timestamp": (frames / rate).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full_like(frames, index),
        "index": before + frames,
        "task_index": np.zeros_like(frames),
    }


def _table(columns: Mapping[str, NDArray[Any]], features: Mapping[str, Mapping[str, Any]]) -> pa.Table:
    """Return frames in Arrow's form: a fixed-size list for a vector, a plain column for one entry."""
    import pyarrow as pa

    arrays = []
    for name, values in columns.items():
        size = features[name]["shape"][0]
        flat = pa.array(values.reshape(-1))
        arrays.append(flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size))
    return pa.table(dict(zip(columns, arrays, strict=True)))


def _statistics(values: NDArray[Any]) -> dict[str, list[float] | list[int]]:
    """Return the statistics that policies are normalised with, for each entry of a column."""
    table = values.reshape(len(values), -1).astype(np.float64)
    found: dict[str, Any] = {
        "min": table.min(axis=0),
        "max": table.max(axis=0),
        "mean": table.mean(axis=0),
        "std": table.std(axis=0),
    }
    found |= {f"q{round(100 * q):02d}": np.quantile(table, q, axis=0) for q in _QUANTILES}
    return {**{key: value.tolist() for key, value in found.items()}, "count": [len(table)]}
