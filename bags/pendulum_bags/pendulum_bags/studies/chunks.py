"""Work in numbered pieces, pure functions of job and number: here or on a Dask cluster, stored, resumed."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeVar

from numpy.typing import NDArray

from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.errors import BagError, FaultError, ParameterError
from pendulum_msgs_py.programs.extras import how_to_install

__all__ = [
    "Connect",
    "carry_out",
    "chunk_path",
    "cluster_client",
    "open_results",
    "read_columns",
    "run_chunks",
    "stored_settings",
    "write_columns",
    "write_results_marker",
]

Job = TypeVar("Job")
Result = TypeVar("Result")
Connect = Callable[[], AbstractContextManager[Any]]
"""Connects to a Dask cluster when there is something to do: gives its client, or None for this process."""

_CONNECT_TIMEOUT = 15.0
_MARKER = "settings.json"


def carry_out(
    task: Callable[[Job, int, int | None], Result],
    job: Job,
    missing: Iterable[int],
    connect: Connect = nullcontext,
) -> Iterator[tuple[int, Result]]:
    """Yield number and result of each piece as it finishes.

    Args:
        task: Function of a module (a worker imports it) of the job, the number, and the threads to use, None for all.
        job: What all pieces have in common; it is sent to the workers.
        connect: To a Dask cluster (`cluster_client`), not called if nothing is missing; by default, this process.

    Raises:
        FaultError: The scheduler cannot be reached, or its workers keep dying.
    """
    numbers = list(missing)
    if not numbers:
        return
    with connect() as client:
        if client is not None:
            yield from _on_cluster(client, task, job, numbers)
            return
        for number in numbers:
            yield number, task(job, number, None)


def run_chunks(
    folder: Path,
    task: Callable[[Job, int, int | None], Mapping[str, NDArray[Any]]],
    job: Job,
    chunks: int,
    *,
    connect: Connect = nullcontext,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write the columns that ``task`` returns for each chunk not on disk to a file of its own; see ``carry_out``."""
    missing = [index for index in range(chunks) if not chunk_path(folder, index).is_file()]
    done = chunks - len(missing)
    on_progress(done, chunks)
    for index, columns in carry_out(task, job, missing, connect):
        write_columns(chunk_path(folder, index), columns)
        done += 1
        on_progress(done, chunks)


def chunk_path(folder: Path, index: int) -> Path:
    """Return the file of a chunk."""
    return folder / f"runs_{index:05}.parquet"


@contextmanager
def cluster_client(scheduler: str = "", workers: int = 0) -> Iterator[Any]:
    """Connect to a Dask scheduler, or start a local cluster of single-threaded processes.

    Args:
        scheduler: Its address, ``tcp://HOST:PORT``; empty for none.
        workers: Processes of a local cluster; 0 for none. With neither, None is yielded: this process.

    Raises:
        ParameterError: Dask cannot be imported.
        FaultError: The scheduler cannot be reached.
    """
    if not scheduler and not workers:
        yield None
        return
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ParameterError(
            how_to_install(error) or f"workers and schedulers need dask.distributed: {error}"
        ) from error
    if scheduler:
        try:
            client = Client(scheduler, timeout=_CONNECT_TIMEOUT)
        except (OSError, ValueError, TypeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise FaultError(
                f"no Dask scheduler responds at {scheduler!r} within {_CONNECT_TIMEOUT:g} s ({reason}); "
                "expected tcp://HOST:PORT of a running dask scheduler"
            ) from error
        with closing(client):
            yield client
        return
    # Its log of workers that died and were replaced is for administrators of clusters, not for users; its
    # status page takes any free port of this machine alone, so that two clusters do not meet on the usual one.
    local = LocalCluster(
        n_workers=workers, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL
    )
    with closing(local) as cluster, closing(Client(cluster)) as client:
        yield client


def _on_cluster(
    client: Any, task: Callable[[Job, int, int | None], Result], job: Job, numbers: list[int]
) -> Iterator[tuple[int, Result]]:
    from distributed import KilledWorker, as_completed

    # The cores are shared by the cluster's workers.
    jobs = {client.submit(task, job, number, 1, pure=True): number for number in numbers}
    try:
        for future, result in as_completed(jobs, with_results=True):
            yield jobs[future], result
            future.release()
    except KilledWorker as error:
        raise FaultError(
            f"workers keep dying: {str(error).splitlines()[0]}; finished pieces remain, and the same command resumes"
        ) from error
    finally:
        for future in jobs:
            future.release()


def open_results(folder: Path, what: str, fingerprint: str, settings: Mapping[str, Any]) -> None:
    """Make the folder of results; a BagError if it exists with results of other settings."""
    marker = folder / _MARKER
    if marker.is_file():
        try:
            found = json.loads(marker.read_text(encoding="utf-8")).get("fingerprint")
        except (ValueError, AttributeError):
            found = None
        if found != fingerprint:
            raise BagError(f"folder {folder} holds a {what} of other settings; expected a new folder")
        return
    if folder.exists() and any(folder.iterdir()):
        raise BagError(f"folder {folder} is not empty and holds no {what}; expected a new one")
    folder.mkdir(parents=True, exist_ok=True)
    write_results_marker(folder, fingerprint, settings)


def stored_settings(folder: Path, fingerprint: str) -> dict[str, Any]:
    """Return the settings that a folder of results was made with; none where it has another fingerprint, or none."""
    try:
        found = json.loads((folder / _MARKER).read_text(encoding="utf-8"))
        return dict(found["settings"]) if found["fingerprint"] == fingerprint else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def write_results_marker(folder: Path, fingerprint: str, settings: Mapping[str, Any]) -> None:
    """Write into the folder what its results are of."""
    write_json(folder / _MARKER, {"fingerprint": fingerprint, "settings": settings})


def write_columns(path: Path, columns: Mapping[str, Any]) -> None:
    """Write columns to a Parquet file, which is there whole or not at all."""
    arrow, parquet = _arrow()
    partial = path.with_suffix(".part")
    parquet.write_table(arrow.table(dict(columns)), partial, compression="zstd")
    partial.replace(path)


def read_columns(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Return columns of a Parquet file."""
    _, parquet = _arrow()
    try:
        table = parquet.read_table(path, columns=list(names))
    except (OSError, ValueError) as error:
        raise BagError(f"{path} cannot be read ({error}); remove it, and the same command computes it again") from error
    return {name: table[name].to_numpy() for name in names}


def _arrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        reason = str(error).splitlines()[0]
        text = how_to_install(error) or f"Parquet needs pyarrow, which cannot be imported: {reason}"
        raise ParameterError(text) from error
    return pyarrow, pyarrow.parquet
