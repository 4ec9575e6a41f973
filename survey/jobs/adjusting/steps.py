"""How a project that was read is adjusted: a list of steps, run in order, each handing on what the next one takes."""

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from types import MappingProxyType

from adjust.adjustment import AdjustOptions, adjust
from adjust.graph.assembly import StartValues
from adjust.model.errors import IndeterminateError, SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.memory import remembering
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import Survey
from adjust.observations.copies import copied_observations
from adjust.statistics.outliers.supported import lost_notes, supported, without_lost_points
from adjust.statistics.screened_adjustment import CleanOptions
from survey.jobs.adjusting.astray import cleaned
from survey.jobs.adjusting.probable_causes import adjusted_or_explained, explaining, with_probable_causes
from survey.jobs.adjusting.symmetric_boards import consistent_turns
from survey.jobs.detecting.image_defects import blurred, defect_warnings
from survey.jobs.identify import identified, identify_spots, spot_views, without_points
from survey.project import Project
from survey.project.detected import DetectedImage
from survey.project.project import DEFINITION_FILE

Begin = Callable[[Survey], StartValues | None]
Progress = Callable[[int, float], None]


@frozen(eq=False)
class Work:
    """What one step hands on to the next: the project with its survey as it is now, and what was noticed.

    lost: unknowns that went because nothing in use observes them. adjustment: once there is one.
    """

    project: Project
    begin: Begin
    progress: Progress
    notes: tuple[str, ...] = ()
    lost: tuple[ParameterName, ...] = ()
    adjustment: Adjustment | None = None

    @property
    def survey(self) -> Survey:
        """As it is now."""
        return self.project.survey

    def of(self, survey: Survey, notes: tuple[str, ...] = ()) -> "Work":
        """The same with another survey, and more notes."""
        return replace(self, project=replace(self.project, survey=survey), notes=self.notes + notes)


@frozen
class Step:
    """One step: its name in the log, which projects it concerns, and what it makes of them. Raises SurveyError."""

    name: str
    concerns: Callable[[Work], bool]
    run: Callable[[Work], Work]


def _options(project: Project) -> CleanOptions:
    said = project.options
    how = AdjustOptions(said.alpha, said.reject_blocks, said.reject_points)
    return CleanOptions(said.reject_pairs, how, said.variance_components)


def with_loops_closed(project: Project) -> Project:
    """With the loops of its pairs to be closed, where it asks for that. Raises SurveyError."""
    if project.options.pairs != "closed" or not project.survey.pairs:
        return project
    from adjust.relay.closed import closed  # here: a survey without pairs starts without it

    try:
        return replace(project, survey=closed(project.survey, project.options.closures))
    except SurveyError as error:
        raise SurveyError(f"{project.folder}/{DEFINITION_FILE}: {error}") from error


def _loops_closed(work: Work) -> Work:
    return work.of(with_loops_closed(work.project).survey)


def _boards_turned(work: Work) -> Work:
    return work.of(*consistent_turns(work.survey, work.project.target_kinds))


def _spots_identified(work: Work) -> Work:
    project = work.project
    gate = project.spots_request.gate_px if project.spots_request is not None else 15.0
    how = _options(project).adjust
    part = supported(without_points(project.survey, project.spots))[0]
    try:
        with explaining(part, project):
            first = adjust(part, work.begin(part), how, work.progress)
    except IndeterminateError as error:
        raise SurveyError(
            f"{project.folder}/observations: the spots cannot be identified, because cameras and stations are not "
            f"determined without them; name the spots' beacons in image_points.csv, or hold a board\n({error})"
        ) from error
    found = identify_spots(project.survey, spot_views(project.survey, first, project.spots), gate)
    if found.unidentified > found.identified:
        from survey.jobs.adjusting.unnamed_spots import require_names  # here: spots mostly have names

        require_names(project, first, found, gate)
    notes = found.notes
    if found.unidentified:
        notes += (f"{found.unidentified} of {found.identified + found.unidentified} spots are no known beacon",)
    return work.of(identified(project.survey, found), notes)


def _unobserved_left_out(work: Work) -> Work:
    survey, lost = supported(work.survey)
    return replace(work.of(survey), lost=lost)


def _adjusted(work: Work) -> Work:
    """Least squares without gross errors, with variance components where they are asked for."""

    def run(how: CleanOptions) -> Adjustment:
        return without_lost_points(work.survey, lambda part: cleaned(part, how, work.progress, work.begin(part)))

    return replace(work, adjustment=adjusted_or_explained(work.survey, work.project, _options(work.project), run))


def _causes_named(work: Work) -> Work:
    return replace(work, adjustment=with_probable_causes(work.survey, _result(work), work.project))


STEPS = (
    Step("loops", lambda w: w.project.options.pairs == "closed", _loops_closed),
    Step("symmetric boards", lambda w: bool(w.survey.image_blocks), _boards_turned),
    Step("spots", lambda w: bool(w.project.spots), _spots_identified),
    Step("unobserved", lambda _: True, _unobserved_left_out),
    Step("adjust", lambda _: True, _adjusted),
    Step("causes", lambda _: True, _causes_named),
)


def _unwatched(_iteration: int, _omega: float) -> None:
    """Nobody looks."""


def _untimed(_name: str) -> AbstractContextManager[None]:
    return nullcontext()


def adjust_project(
    project: Project, progress: bool, begin: Begin = lambda _: None,
    timed: Callable[[str], AbstractContextManager[None]] = _untimed, watch: Progress = _unwatched,
) -> Adjustment:  # fmt: skip
    """Adjust what was read. Raises SurveyError.

    begin: start values of a survey, found where it gives None. timed: what each step is run in, by its name. watch:
    called with (iteration, v'Pv); what it raises ends the adjustment.
    """
    if project.is_empty:
        remedy = (f"no target is known in its {len(project.images)} images: labsurvey detect {project.folder}"
                  if project.images else
                  "put images at images/<camera_id>/<epoch_id>.png or tables into observations/")  # fmt: skip
        raise SurveyError(f"{project.folder}: there is nothing to adjust; {remedy}")
    with _watched(progress, watch) as told_bar, remembering():
        work = Work(project, begin, told_bar)
        for step in STEPS:
            if step.concerns(work):
                with timed(step.name):
                    work = step.run(work)
    result = _result(work)
    tried = 0 if result.diagnosis is None else len(result.diagnosis.lines)
    said = result.warnings[:tried] + work.notes + result.warnings[tried:] + lost_notes(work.lost)
    return told(project, work.survey, replace(result, warnings=said))


@contextmanager
def _watched(bar: bool, watch: Progress) -> Iterator[Progress]:
    """What is called with every iteration: ``watch``, after a bar on stderr where one is wanted."""
    if not bar:
        yield watch
        return
    from tqdm import tqdm  # here: a command that is quiet starts without it

    with tqdm(desc="adjusting", unit=" steps", file=sys.stderr, leave=False) as shown:

        def told(iteration: int, omega: float) -> None:
            shown.set_postfix_str(f"v'Pv = {omega:.6g}")
            shown.update()
            watch(iteration, omega)

        yield told


def _result(work: Work) -> Adjustment:
    if work.adjustment is None:
        raise ValueError("no step before this one has adjusted the survey")
    return work.adjustment


def told(project: Project, given: Survey, adjustment: Adjustment) -> Adjustment:
    """An adjustment that says what was noticed when its project was read, and how much of ``given`` it left out."""
    named = 0 if adjustment.diagnosis is None else len(adjustment.diagnosis.told())
    offered = {h.place.ids[0]: n for n, h in enumerate(blurred(project.survey, project.detected), start=named + 1)}
    noticed = _copies(project) + project.notes + project.image_notes + image_warnings(project.detected, offered)
    warnings = adjustment.warnings + noticed
    images = sum(b.n_used for b in given.image_blocks)
    images -= int(adjustment.image_residuals.used.sum())
    others = given.n_others_used - adjustment.survey.n_others_used
    return replace(adjustment, warnings=warnings, n_screened=images + others)


def _copies(project: Project) -> tuple[str, ...]:
    """Observations that were copied rather than made again."""
    tables = {"images": "image", "readings": "terrestrial"}
    return tuple(
        f"{len(same)} {kind} have the very values of others of the same ({listed([' = '.join(x) for x in same], 3)}): "
        "what was copied counts twice, and sigmas come out too small; leave the copies out "
        f"(labsurvey exclude {project.folder} {tables.get(kind, kind)}:{same[0][1]} ...)"
        for kind, same in copied_observations(project.survey).items()
    )


def image_warnings(
    images: Mapping[tuple[str, str], DetectedImage], offered: Mapping[str, int] = MappingProxyType({})
) -> tuple[str, ...]:
    """Boards of a wrong size, once each; images that are wrong as such, by camera; those without targets, or not read.

    At every adjustment, not only at the first. offered: see :func:`defect_warnings`.
    """
    sizes = dict.fromkeys(entry.wrong_size for entry in images.values() if entry.wrong_size)
    wrong = defect_warnings({key: entry.defect for key, entry in images.items()}, offered)
    return tuple(f"detection: {text}" for text in (*sizes, *wrong)) + tuple(
        f"detection: {entry.file}: {entry.status}{': ' + entry.message if entry.message else ''}"
        for entry in images.values()
        if entry.status == "failed" or (entry.status == "nothing" and not entry.wrong_size)
    )  # fmt: skip
