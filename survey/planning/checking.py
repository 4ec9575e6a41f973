"""The job ``check``: what a survey cannot give, before it is adjusted, and what to measure next.

>>> outcome = check_job(Path("lab"))
>>> print(outcome.text())
"""

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from adjust.diagnosis.beforehand import Beforehand, Finding, coverage, look_beforehand
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import Survey
from survey.jobs.adjusting.steps import with_loops_closed
from survey.jobs.detecting.image_defects import defective
from survey.jobs.navigating.task import with_known_points
from survey.project import Project, read

if TYPE_CHECKING:
    from adjust.design import Selection

_MOST = 5
_LARGE = 1500
"""Unknowns up to which candidates are thought of where no plan.toml lists some: above that they take minutes."""


@frozen(eq=False)
class CheckOutcome:
    """What was found in a project. next_best: candidates of plan.toml, the most useful first."""

    project: Project
    beforehand: Beforehand
    next_best: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def n_problems(self) -> int:
        """Findings that spoil or stop the adjustment."""
        return sum(f.level == "problem" for f in self.beforehand.findings)

    def summary(self) -> dict[str, object]:
        """As plain values."""
        expected = self.beforehand.expected
        counts = {} if expected is None else {
            "observations": expected.n_observations, "unknowns": expected.n_unknowns,
            "redundancy": expected.redundancy, "datum_defect": expected.datum_defect,
        }  # fmt: skip
        return {
            "folder": str(self.project.folder),
            **counts,
            "problems": self.n_problems,
            "findings": [asdict(f) for f in self.beforehand.findings],
            "coverage": coverage(self.project.survey),
            "measure_next": list(self.next_best),
            "notes": list(self.notes),
        }

    def text(self) -> str:
        """For people: problems, then weak points, then what to measure next."""
        expected, findings = self.beforehand.expected, self.beforehand.findings
        lines = [f"{self.project.title or self.project.folder}: {self.n_problems} problems, "
                 f"{len(findings) - self.n_problems} weak points; nothing was adjusted"]  # fmt: skip
        if expected is not None:
            lines.append(f"{expected.n_observations} observations, {expected.n_unknowns} unknowns, "
                         f"redundancy {expected.redundancy}")  # fmt: skip
        for finding in findings:
            mark = "problem" if finding.level == "problem" else "weak"
            lines += [f"{mark}: {finding.found}", f"  -> {finding.remedy}"]
        if self.next_best:
            where = "" if (self.project.folder / "plan.toml").is_file() else " (where it can be seen)"
            lines.append(f"measure next{where}: " + "; ".join(self.next_best))
        return "\n".join([*lines, *self.notes])


def check_job(folder: Path) -> CheckOutcome:
    """Look at a project without adjusting it; writes nothing. Raises SurveyError where it cannot be read."""
    project = with_loops_closed(read(Path(folder)))
    notes = project.notes + project.image_notes
    waiting = len(project.images) and not project.survey.image_blocks
    if waiting:
        notes += (f"{len(project.images)} images are not detected yet: labsurvey detect {folder}",)
    survey = project.survey
    if project.spots:
        survey = _without_spots(project)
        notes += (f"{len(project.spots)} images show spots that are named by adjusting only: what only they show is "
                  "not looked at",)  # fmt: skip
    found = look_beforehand(survey)
    if project.spots:
        left = tuple(f for f in found.findings if (f.kind, f.level) != ("no redundancy", "weak"))
        found = replace(found, findings=left)
    bad = tuple(Finding("problem", d.kind, tuple("/".join(key) for key in d.images), d.found, d.remedy)
                for d in defective({k: e.defect for k, e in project.detected.items()}))  # fmt: skip
    found = replace(found, findings=bad + found.findings)
    best, said = _next_best(project, found)
    return CheckOutcome(project, found, best, notes + said)


def _without_spots(project: Project) -> Survey:
    """The survey without points and table readings of which only spots without names tell."""
    survey, seen = project.survey, {b.epoch_id for b in project.survey.image_blocks}
    dark = {s.epoch_id for s in project.spots} - seen
    readings = tuple(r for r in survey.table_readings if r.epoch_id not in dark)
    return with_known_points(replace(survey, table_readings=readings))


def _next_best(project: Project, found: Beforehand) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The candidates of plan.toml, or usual ones, that help most beside what is measured, and why there are none."""
    planned_by_people = (project.folder / "plan.toml").is_file()
    if found.expected is None or (not planned_by_people and found.expected.n_unknowns > _LARGE):
        return (), ("what to measure next: list candidates in plan.toml; labsurvey plan ranks them",)
    from adjust.design import expect, select
    from survey.planning.building import build_plan
    from survey.planning.plan_file import read_plan
    from survey.planning.usual import usual_plan, with_usual_sigmas_of
    from survey.planning.wanted import wanted_components

    try:
        plan = read_plan(project.folder, project.survey) if planned_by_people else usual_plan(project, found.expected)
        planned = build_plan(project if planned_by_people else with_usual_sigmas_of(project), plan, found.expected, [])
        if not planned.candidates:
            return (), ("what to measure next: plan.toml lists no candidates" if planned_by_people else
                        "what to measure next: list candidates in plan.toml; labsurvey plan ranks them",)  # fmt: skip
        expected = expect(planned.survey, planned.start)
        chosen: Selection = select(planned.survey, planned.start, planned.candidates,
                                   wanted_components(expected, plan.wanted), _MOST, "D", expected)  # fmt: skip
    except SurveyError as error:
        return (), (f"what to measure next cannot be told: {str(error).splitlines()[0]}",)
    return tuple(step.name for step in chosen.steps), ()
