"""The batch on a Dask cluster: the same worker processes, started by the cluster's workers."""

import threading
from collections.abc import Iterator, Mapping
from typing import Any

from adjust.model.errors import SurveyError
from survey.batch.record import FAILED, Record, record_from
from survey.batch.worker import Worker, attempts

_own = threading.local()
_WAIT_SECONDS = 20


def run_on_worker(task: Mapping[str, object], retries: int) -> dict[str, object]:
    """What a worker of the cluster does: every thread of it has a process of ours, which stays for the next folder."""
    if not hasattr(_own, "worker"):
        _own.worker = Worker()
    return attempts(_own.worker, task, retries).plain()


def on_cluster(
    tasks: Mapping[int, Mapping[str, Any]], address: str, retries: int
) -> Iterator[tuple[int, Record]]:
    """Positions and records, as the cluster finishes them. The folders must have the same path on all its machines.

    Raises SurveyError where Dask is not installed or no scheduler answers.
    """
    try:
        import distributed
    except ImportError as error:
        raise SurveyError("--scheduler needs Dask; install it: pip install 'labsurvey[dask]'") from error
    library: Any = distributed  # has no types
    try:
        client = library.Client(address, timeout=_WAIT_SECONDS, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise SurveyError(
            f"no Dask scheduler at {address!r} ({type(error).__name__}); start one with 'dask scheduler' and 'dask "
            "worker', and give the address that it prints, such as tcp://127.0.0.1:8786"
        ) from error
    with client:
        # never pure: the same folder asked for again is adjusted again; workers that were lost count as tries
        futures = {
            client.submit(run_on_worker, dict(task), retries, pure=False, retries=retries): i
            for i, task in tasks.items()
        }
        for future in library.as_completed(list(futures), loop=client.loop):
            i = futures[future]
            if future.status == "finished":
                yield i, record_from(future.result())
            else:
                lost = future.exception()
                text = f"{tasks[i]['path']}: lost on the cluster, {type(lost).__name__}: {lost}; look at its logs"
                yield i, Record(tasks[i]["folder"], FAILED, cause="cluster", error=text)
            future.release()
