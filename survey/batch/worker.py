"""Worker processes: each adjusts one folder after the other, with one thread for linear algebra.

A worker is a program that reads tasks as lines of JSON and answers with records as lines of JSON. So it is the same
process whoever started it: the command line, a notebook, or a worker of a Dask cluster (which may not have children of
multiprocessing's making). It ends when its owner has gone, also where that was killed.
"""

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
import traceback
import weakref
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from adjust.model.errors import SurveyError
from survey.batch.record import FAILED, MAY_PASS, Record, cause_of, record_from, solved_record
from survey.folder.kept import require_project
from survey.folder.messages import message

_START = "import sys; sys.path[:] = sys.argv[1:]; from survey.batch.worker import main; main()"
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")


class WorkerDiedError(Exception):
    """A worker ended before it answered."""


class Worker:
    """One worker process; started when it gets its first task, and again after it died.

    threads: for the compiled kernels. Libraries of linear algebra get one, so that results do not depend on it.
    """

    def __init__(self, threads: int = 1) -> None:
        self.threads = threads
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = self._busy = False

    @property
    def pid(self) -> int | None:
        """Of the running process."""
        return self._process.pid if self._process is not None else None

    def run(self, task: Mapping[str, object]) -> Record:
        """The record of a task. Raises WorkerDiedError where the process ended without one."""
        self._busy = True
        try:
            return self._answer(self._running(), task)
        finally:
            self._busy = False

    def _answer(self, process: "subprocess.Popen[bytes]", task: Mapping[str, object]) -> Record:
        if process.stdin is None or process.stdout is None:
            raise WorkerDiedError("it has no pipes")
        try:
            process.stdin.write(json.dumps(dict(task)).encode() + b"\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except OSError:
            line = b""
        if line.endswith(b"\n"):
            return record_from(json.loads(line))
        self._process = None
        raise WorkerDiedError(_ending(_waited(process)))

    def _running(self) -> subprocess.Popen[bytes]:
        if self._closed:
            raise WorkerDiedError("it was stopped")
        if self._process is None:
            environment = os.environ | dict.fromkeys(_ONE_THREAD, "1") | {"LABSURVEY_THREADS": str(self.threads)}
            self._process = subprocess.Popen(
                [sys.executable, "-c", _START, *sys.path], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                env=environment,
            )  # fmt: skip
            # a thread of a cluster goes without a word; its worker goes with it
            weakref.finalize(self, _ended, self._process)
        return self._process

    def stop(self) -> None:
        """End the process now, whatever it does; it takes no more tasks."""
        self._closed = True
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            if not self._busy:  # else the thread that waits for an answer sees the end of it
                _waited(process)


def attempts(worker: Worker, task: Mapping[str, Any], retries: int) -> Record:
    """Run a task, again where a second try may mend it; the record counts the tries."""
    tries = 0
    while True:
        tries += 1
        try:
            record = worker.run(task)
        except WorkerDiedError as error:
            text = f"{task['path']}: the process that adjusted it ended abruptly, {error}; where that was memory, "
            record = Record(task["folder"], FAILED, cause="process", error=text + "run with fewer jobs")
        if record.cause not in MAY_PASS or tries > retries:
            return replace(record, tries=tries)


def _ended(process: "subprocess.Popen[bytes]") -> None:
    process.kill()
    _waited(process)


def _waited(process: "subprocess.Popen[bytes]") -> int:
    """Exit code of a process that has ended or will, its pipes closed."""
    code = process.wait()
    for pipe in (process.stdin, process.stdout):
        with contextlib.suppress(OSError):  # what was not written any more has no reader
            if pipe is not None:
                pipe.close()
    return code


def _ending(code: int) -> str:
    if code >= 0:
        return f"it exited with code {code}"
    try:
        return f"it was ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"it was ended by signal {-code}"


def main() -> None:
    """The program of a worker: tasks from stdin, records to stdout."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not get between the answers
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the owner says when to stop
    tasks: queue.Queue[dict[str, object]] = queue.Queue()
    threading.Thread(target=_listen, args=(tasks,), daemon=True).start()
    while True:
        record = adjust_task(tasks.get())
        answers.write(json.dumps(record.plain()).encode() + b"\n")
        answers.flush()


def adjust_task(task: Mapping[str, Any]) -> Record:
    """Adjust ``task["path"]`` and write its results; whatever goes wrong is in the record.

    ``folder``: as the user named it. ``redetect``: look for targets again.
    """
    begin, folder = time.perf_counter(), Path(task["path"])
    try:
        require_project(folder)
        from survey.jobs.adjusting.job import adjust_job

        outcome = adjust_job(folder, progress=False, redetect=task["redetect"])
        written = {name: str(path) for name, path in outcome.paths.items()}
        return solved_record(task["folder"], outcome.solution, written, time.perf_counter() - begin)
    except (SurveyError, OSError) as error:
        known = isinstance(error, SurveyError) or error.filename is not None
        text = message(error) if known else f"{folder}: {error}"
        return Record(
            task["folder"], FAILED, cause=cause_of(error), error=text, seconds=time.perf_counter() - begin
        )
    except Exception as error:  # a bug in one project must not cost the night's other results
        text = f"{folder}: internal error, {type(error).__name__}: {error}"
        if isinstance(error, MemoryError):
            text = f"{folder}: not enough memory; run with fewer jobs"
        return Record(
            task["folder"], FAILED, cause=cause_of(error), error=text, traceback=traceback.format_exc(),
            seconds=time.perf_counter() - begin,
        )  # fmt: skip


def _listen(tasks: "queue.Queue[dict[str, object]]") -> None:
    """Take tasks in; when the owner is gone nobody wants the answer."""
    for line in sys.stdin.buffer:
        tasks.put(json.loads(line))
    os._exit(0)
