"""The main job: read, detect, adjust, write."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from adjust.model.errors import SurveyError
from survey.folder.replacing import changing, replace_parts
from survey.project import read
from survey.project.project import RESULTS
from survey.project.tables.files import Begun
from survey.report.language import ENGLISH_PAGE, ReportOptions
from survey.solution.earlier.runs import Clock, command_line, remove_empty

if TYPE_CHECKING:
    from survey.jobs.adjusting.outcome import AdjustOutcome


def adjust_job(
    folder: Path,
    *,
    out: Path | None = None,
    progress: bool = True,
    redetect: bool = False,
    report: ReportOptions = ENGLISH_PAGE,
    method: str = "joint",
    said: str = "",
    ahead: dict[Path, Begun] | None = None,
) -> "AdjustOutcome":
    """The main job: detect where that has not been done, adjust everything, write the results. Raises SurveyError.

    method: "published" runs the published step-by-step methods too and sets them beside the adjustment. said: the
    command that asked for it, where it is not ``adjust``. ahead: tables that are being read already; what comes after
    them is loaded meanwhile.
    """
    clock, folder = Clock(), Path(folder)
    target = folder if out is None else Path(out)
    chosen = None if method == "joint" else method
    said = said or command_line("adjust", folder, redetect=redetect, parquet=report.parquet, method=chosen, out=out)
    with changing(target) as place:

        def detected() -> None:
            from survey.jobs.detecting.job import detect_job  # here: a survey without images starts without it

            with clock.step("detect"):
                here = place if out is None else None
                detect_job(folder, progress=progress, everything=redetect, place=here)

        with clock.step("read"):
            if ahead:
                _load()
            project = read(folder, ahead)
        nothing_yet = bool(project.images) and not (project.survey.image_blocks or project.spots)
        if redetect or project.to_detect or (nothing_yet and not project.detected):
            detected()
            with clock.step("read"):
                project = read(folder)
        elif project.images and out is None:
            from survey.jobs.detecting.job import remember_images  # here: as above

            project = replace(project, detected=remember_images(project, place))
        from survey.jobs.adjusting import outcome as results
        from survey.jobs.adjusting.steps import adjust_project

        try:
            adjustment = adjust_project(project, progress, timed=clock.step)
        except SurveyError as error:
            results.keep_failure(error, results.run_info(project, clock.seconds, said), target, place, report.language)
            raise
        outcome = results.made(project, adjustment, place, clock, report, said, published=method == "published")
        gone = () if out is not None else results.kept_run(folder, place, project, outcome)
        replace_parts(target, gone=gone)
        for name in results.UNSOLVED:  # of a failure before
            (target / RESULTS / name).unlink(missing_ok=True)
    remove_empty(target, gone)
    return outcome.at(target)


def _load() -> None:
    """What a project is adjusted, tested and reported with."""
    for name in ("scipy.special", "survey.jobs.adjusting.outcome", "survey.jobs.adjusting.steps"):
        import_module(name)
