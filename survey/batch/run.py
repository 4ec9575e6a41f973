"""The batch: what need not be done again is taken over, the rest is adjusted side by side, everything is noted."""

import contextlib
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.native.parallel import cores
from survey.batch.cache import fingerprint, unchanged_solution
from survey.batch.cluster import on_cluster
from survey.batch.journal import Journal, entry_of, read_journal
from survey.batch.record import DONE, FAILED, MAY_PASS, TEST_FAILED, Record, record_from, solved_record
from survey.batch.worker import Worker, attempts
from survey.folder.text import NOT_OURS

Told = Callable[[Record], None]


@frozen
class BatchOptions:
    """How a batch is run.

    jobs: folders at a time; None for one per core. scheduler: address of a Dask scheduler, which then does the work.
    report: folder of the journal and of the overview. resume: take over what the journal there says, failures too.
    fresh: adjust also where the results are those of the inputs. redetect: look for targets again. retries: how often
    a folder is tried again whose process ended or whose files could not be reached. progress: a bar on stderr.
    """

    jobs: int | None = None
    scheduler: str | None = None
    report: Path | None = None
    resume: bool = False
    fresh: bool = False
    redetect: bool = False
    retries: int = 1
    progress: bool = True


def run_batch(folders: Sequence[Path], options: BatchOptions, told: Told = lambda record: None) -> tuple[Record, ...]:
    """Records of all folders, in their order; ``told`` is called with each as soon as it is known.

    Raises SurveyError for a folder named twice, and where there is no Dask or no scheduler at the address.
    """
    paths = [Path(f).absolute() for f in folders]
    if len({p.resolve() for p in paths}) < len(paths):
        raise SurveyError("a folder is named twice; name each once")
    records: dict[int, Record] = {}
    before = read_journal(options.report) if options.resume and options.report is not None else {}
    for i, path in enumerate(paths):
        known = _known(str(folders[i]), path, options, before)
        if known is not None:
            records[i] = known
            told(known)
    kept = [entry_of(paths[i], fingerprint(paths[i]), record) for i, record in records.items()]
    left = [i for i in range(len(paths)) if i not in records]
    with contextlib.ExitStack() as stack:
        journal = stack.enter_context(Journal(options.report, kept)) if options.report is not None else None
        bar = stack.enter_context(_bar(len(paths), len(records), options))
        tasks = {i: {"folder": str(folders[i]), "path": str(paths[i]), "redetect": options.redetect} for i in left}
        for i, record in _run(tasks, options):
            records[i] = record
            if journal is not None:
                journal.add(paths[i], fingerprint(paths[i]), record)
            told(record)
            bar.set_postfix_str(_counts(records.values()))
            bar.update()
    return tuple(records[i] for i in range(len(paths)))


def _known(folder: str, path: Path, options: BatchOptions, before: Mapping[str, tuple[str, Record]]) -> Record | None:
    """The record of a folder that need not be adjusted (again)."""
    if options.fresh or options.redetect:
        # a run that is resumed had the same options: what it finished is fresh
        finished = before.get(str(path))
        if finished is None or finished[0] != fingerprint(path):
            return None
    solution = unchanged_solution(path)
    if solution is not None:
        written = {p.name: str(p) for p in sorted((path / "results").iterdir()) if not p.name.startswith(".")}
        with contextlib.suppress(*NOT_OURS):  # not ours: adjust anew
            return record_from(solved_record(folder, solution, written, origin="unchanged").plain())
    found = before.get(str(path))
    if found is None or found[1].state != FAILED or found[1].cause in MAY_PASS:
        return None
    same = found[0] and found[0] == fingerprint(path)
    return replace(found[1], folder=folder, origin="resumed") if same else None


def _bar(total: int, done: int, options: BatchOptions) -> Any:
    return tqdm(total=total, initial=done, desc="adjusting", unit="folder", disable=not options.progress,
                file=sys.stderr, leave=False)  # fmt: skip


def _counts(records: Iterable[Record]) -> str:
    states = [r.state for r in records]
    words = ((states.count(FAILED), "failed"), (states.count(TEST_FAILED), "test failed"))
    return ", ".join(f"{n} {word}" for n, word in words if n)


def _run(tasks: Mapping[int, Mapping[str, object]], options: BatchOptions) -> Iterator[tuple[int, Record]]:
    if options.scheduler:
        return on_cluster(tasks, options.scheduler, options.retries)
    return _here(tasks, options)


def _here(tasks: Mapping[int, Mapping[str, object]], options: BatchOptions) -> Iterator[tuple[int, Record]]:
    """Each of ``jobs`` threads owns a worker process and waits for it."""
    jobs = max(1, min(options.jobs or cores(), len(tasks)))
    own, workers = threading.local(), []

    def prepare() -> None:
        own.worker = Worker(max(1, cores() // jobs))
        workers.append(own.worker)

    pool = ThreadPoolExecutor(jobs, "batch", initializer=prepare)
    try:

        def run(task: Mapping[str, object]) -> Record:
            return attempts(own.worker, task, options.retries)

        futures = {pool.submit(run, task): i for i, task in tasks.items()}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.stop()
        pool.shutdown()


def exit_code(records: Sequence[Record]) -> int:
    """That of the worst: 1 before 3 before 0."""
    codes = {record.exit_code for record in records}
    return next((code for code in (1, 3) if code in codes), 0)


def counts(records: Sequence[Record]) -> dict[str, int]:
    """How many folders ended how."""
    states = [r.state for r in records]
    return {
        "folders": len(records), "done": states.count(DONE), "test_failed": states.count(TEST_FAILED),
        "failed": states.count(FAILED), "not_adjusted_again": sum(r.origin != "adjusted" for r in records),
    }  # fmt: skip
