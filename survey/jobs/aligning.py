"""The job of the command ``align``: adjust the readings, write the working sheet, keep the rounds."""

import csv
import io
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import decode, read_bytes
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.working_sheet import ARCSEC, Sheet, working_sheets
from survey.project import atomic_write, read
from survey.project.project import RESULTS
from survey.report.working_sheet import ROUND_COLUMNS, sheet_html, sheet_text, steps

PAGE, ROUNDS = "alignment.html", "alignment_rounds.csv"


@dataclass(frozen=True, eq=False)
class AlignOutcome:
    """The sheets, and where they were written."""

    adjustment: Adjustment
    sheets: tuple[Sheet, ...]
    page: Path

    @property
    def aligned(self) -> bool:
        """Whether nothing is left to do."""
        return all(sheet.state == "aligned" for sheet in self.sheets)

    def text(self) -> str:
        """For the terminal."""
        return f"{sheet_text(self.sheets)}\nWorking sheet: {self.page}"

    def summary(self) -> dict[str, Any]:
        """For ``--json``."""
        tasks = {
            sheet.task.task_id: {
                "state": sheet.state,
                "axes": {
                    a.axis: {"off_arcsec": a.angle / ARCSEC, "sigma_arcsec": a.sigma / ARCSEC, "state": a.state}
                    for a in sheet.axes
                },
                "feet": {
                    f.name: {"move_mm": 1e3 * f.move, "sigma_mm": 1e3 * f.sigma, "turns": f.turns, "stays": f.stays}
                    for f in sheet.feet
                },
                "steps": steps(sheet),
            }
            for sheet in self.sheets
        }
        return {"aligned": self.aligned, "tasks": tasks, "page": str(self.page)}


def align_job(folder: Path, *, out: Path | None = None, progress: bool = True) -> AlignOutcome:
    """Adjust a project and say how its bodies are to be turned; a new round where its inputs have changed."""
    target = Path(out if out is not None else folder)
    with changing(target) as place:
        adjustment, sheets = _made(Path(folder), target, place, progress)
        replace_parts(target)
    return AlignOutcome(adjustment, sheets, target / RESULTS / PAGE)


def _made(folder: Path, target: Path, place: Path, progress: bool) -> tuple[Adjustment, tuple[Sheet, ...]]:
    """The sheets, with their files in ``place``."""
    project = read(folder)
    if not project.alignment_tasks:
        raise SurveyError(
            f"{folder}/survey.toml: it does not say what is to be aligned; add for instance\n"
            '[align.board]\nbody = "target:board"\nonto = "table:turntable"\ntolerance_arcsec = 60'
        )
    adjustment = adjust_project(project, progress)
    sheets = working_sheets(adjustment, project.alignment_tasks, project.options.alpha, project.options.sigmas)
    date = datetime.now(UTC).isoformat(timespec="seconds")
    rounds = _with_round(_rounds(target / RESULTS / ROUNDS), sheets, date)
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerows([ROUND_COLUMNS, *rounds])
    atomic_write(place / RESULTS / ROUNDS, stream.getvalue())
    page = sheet_html(sheets, project.title or folder.resolve().name, date, rounds)
    atomic_write(place / RESULTS / PAGE, page)
    return adjustment, sheets


def _rounds(path: Path) -> list[list[str]]:
    if not path.is_file():
        return []
    try:
        rows = list(csv.reader(io.StringIO(decode(path, read_bytes(path)[0]), newline=""), strict=True))
    except csv.Error as error:
        raise SurveyError(f"{path}: this is no list of rounds ({error}); remove the file") from error
    if not rows or tuple(rows[0]) != ROUND_COLUMNS or any(len(row) != len(ROUND_COLUMNS) for row in rows):
        raise SurveyError(f"{path}:1: this is no list of rounds; remove the file")
    return rows[1:]


def _with_round(rounds: list[list[str]], sheets: tuple[Sheet, ...], date: str) -> list[list[str]]:
    """A row per sheet, unless its last round found the same."""
    out = list(rounds)
    for sheet in sheets:
        numbers = [f"{x / ARCSEC:.2f}" for x in (*sheet.off, *(axis.sigma for axis in sheet.axes))]
        row = [date, sheet.task.task_id, sheet.state, *numbers]
        before = [r for r in rounds if r[1] == sheet.task.task_id]
        if not before or before[-1][2:] != row[2:]:
            out.append(row)
    return out
