"""The job of the command ``align``: adjust the readings, write the working sheet, keep the rounds."""

from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import csv_rows, csv_text, read_text, time_text
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.working_sheet import ARCSEC, STATES, Sheet, angle_text, sheet_text, steps, working_sheets
from survey.project import atomic_write, read
from survey.project.project import RESULTS
from survey.report import drawing as d
from survey.report.markup import document, part

PAGE, ROUNDS = "alignment.html", "alignment_rounds.csv"
ROUND_COLUMNS = ("date", "task", "state", "x_arcsec", "y_arcsec", "z_arcsec", "sigma_x", "sigma_y", "sigma_z")


@frozen(eq=False)
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

    def summary(self) -> dict[str, object]:
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
    date = time_text()
    rounds = _with_round(_rounds(target / RESULTS / ROUNDS), sheets, date)
    atomic_write(place / RESULTS / ROUNDS, csv_text([ROUND_COLUMNS, *rounds]))
    page = sheet_html(sheets, project.title or folder.resolve().name, date, rounds)
    atomic_write(place / RESULTS / PAGE, page)
    return adjustment, sheets


def _rounds(path: Path) -> list[list[str]]:
    if not path.is_file():
        return []
    rows = list(csv_rows(path, read_text(path)))
    bad = [line for line, cells in rows if len(cells) != len(ROUND_COLUMNS)]
    if bad or not rows or tuple(rows[0][1]) != ROUND_COLUMNS:
        raise SurveyError(f"{path}:{bad[0] if bad else 1}: this is no list of rounds; remove the file")
    return [cells for _, cells in rows[1:]]


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


def sheet_html(sheets: Sequence[Sheet], title: str, date: str, rounds: Sequence[Sequence[str]] = ()) -> str:
    """One page that needs nothing but itself; ``rounds`` are rows of ``ROUND_COLUMNS``, oldest first."""
    shown = [
        part("sheet", s, STATES, angle_text, steps(s), drawing(s), [row for row in rounds if row[1] == s.task.task_id],
             of="working_sheet.html") for s in sheets
    ]  # fmt: skip
    head = f"{title}: alignment"
    return document(head, part("page", head, date, shown, of="working_sheet.html"))


def drawing(sheet: Sheet) -> Markup:
    """The body seen from its front with what each foot has to move, and the turn about z."""
    if not sheet.feet:
        return Markup()
    at = {foot.name: (foot.x, foot.y) for foot in sheet.task.feet}
    xs, ys = [x for x, _ in at.values()], [y for _, y in at.values()]
    size = max(max(xs) - min(xs), max(ys) - min(ys))
    scale, margin = 300.0 / size, 70.0

    def place(x: float, y: float) -> tuple[float, float]:
        return margin + (x - min(xs)) * scale, margin + (max(ys) - y) * scale

    width, height = 2 * margin + (max(xs) - min(xs)) * scale, 2 * margin + (max(ys) - min(ys)) * scale
    outline = " ".join(f"{u:.1f},{v:.1f}" for u, v in (place(*at[name]) for name in at))
    parts = [
        '<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" orient="auto">'
        f'<path d="M0 0L10 5L0 10z" fill="{d.RED}"/></marker></defs>'
        f'<polygon points="{outline}" fill="{d.EMPTY}" stroke="{d.GREY}"/>'
    ]
    for foot in sheet.feet:
        u, v = place(*at[foot.name])
        text_v = v + 26 if v > height / 2 else v - 16  # beside the body, not on it
        label = "stays" if foot.stays else f"{1e3 * foot.move:+.2f} mm"
        colour = d.GREY if foot.stays else d.RED
        parts.append(
            d.dot(u, v, 9, colour) + d.text(u, text_v, f"{foot.name}: {label}", "middle", 15, d.INK)
        )
    z = next(axis for axis in sheet.axes if axis.axis == "z")
    if z.state == "turn":
        u, v, r = width / 2, height / 2, 45.0
        ends = ((u - r, v), (u + r, v)) if z.angle > 0 else ((u + r, v), (u - r, v))
        sweep = 1 if z.angle > 0 else 0  # in the picture y points down: 1 is clockwise
        parts.append(
            f'<path d="M{ends[0][0]:.1f} {ends[0][1]:.1f}A{r} {r} 0 0 {sweep} {ends[1][0]:.1f} {ends[1][1]:.1f}" '
            f'fill="none" stroke="{d.RED}" stroke-width="3" marker-end="url(#tip)"/>'
            + d.text(u, v + 5, angle_text(abs(z.angle)), "middle", 15, d.INK)
        )
    return d.svg(width, height, parts, "feet and moves")
