"""What a worker does for one folder: plain values in, plain values out."""

import time
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from adjust.model.errors import SurveyError
from survey.batch.causes import cause_of
from survey.batch.record import FAILED, Record, solved_record
from survey.folder.kept import require_project
from survey.folder.messages import message


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
