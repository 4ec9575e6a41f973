"""Why an adjustment failed, or what contradicts in it, where the images can tell. Nothing is repaired."""

import itertools
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING

from adjust.model.errors import DiagnosedError, GivenUpError, IndeterminateError, NotConvergedError, SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import Survey
from adjust.statistics.screened_adjustment import CleanOptions
from adjust.testing.criteria import CAUTIOUS
from adjust.testing.distributions import chi2
from survey.project import Project

if TYPE_CHECKING:
    from adjust.diagnosis.diagnosis import Diagnosis


_LARGE = 1.15
"""sigma0 of all or a group from which mistakes are looked for by trial; below, small sigmas explain as much."""
_LEVEL = 1e-4
"""Error probability of a group's test here: that of one among some hundred parts, which are tested together later."""

_PART = 0.8
"""Variance factor of a group below which a part of it may be far smaller."""
_SEVERAL = 2
"""Observations that were left out from which on they may have one cause."""
_HOPELESS = 1e5
"""v'Pv of a component of a survey of images that no start of a right one leaves after many steps: 300 sigmas."""
NOT_LOOKED_FOR = ("two mistakes at once", "bodies that bend or never rest", "refraction")
"""Told where nothing is named; the documentation says more."""


def adjusted_or_explained(
    survey: Survey, project: Project, how: CleanOptions, run: Callable[[CleanOptions], Adjustment]
) -> Adjustment:
    """``run(how)``, as :func:`explaining` has it; of what leads nowhere the causes are asked after a part of the steps.

    Only what nothing explains is gone through to the end.
    """
    if survey.image_blocks:
        components = 2 * sum(b.n_used for b in survey.image_blocks) + survey.n_others_used
        solve = replace(how.adjust.solve, hopeless=_HOPELESS * components)
        try:
            with explaining(survey, project):
                return run(replace(how, adjust=replace(how.adjust, solve=solve)))
        except GivenUpError:
            pass
    with explaining(survey, project):
        return run(how)


@contextmanager
def explaining(survey: Survey, project: Project) -> Iterator[None]:
    """What is raised inside with the probable causes in front, if any."""
    try:
        yield
    except SurveyError as error:
        said = explained(survey, error, project)
        if said is error:
            raise
        raise said from error


def explained(survey: Survey, error: SurveyError, project: Project) -> SurveyError:
    """What an adjustment of the ``survey`` of a project raised, with the probable causes in front, if any."""
    apart = separate_epochs(survey)
    diagnosis, note = _named(_diagnosis(survey, None, error, project), project)
    if isinstance(error, IndeterminateError):
        note = ()  # what is not observed contradicts nothing
    if diagnosis is not None and project.origins:  # of a project that has not grown there is nothing to try
        done = (replace(c, hypothesis=replace(c.hypothesis, edits=())) for c in diagnosis.candidates)
        diagnosis = replace(diagnosis, candidates=tuple(done))
    tried = diagnosis.lines if diagnosis is not None else _disagreeing_tables(survey)
    if not apart and not tried:
        said = copy(error)
        said.args = ("\n  - ".join([str(error), *note]),)
        return said if note else error
    message = causes_first((*apart, *tried, *note), _consequence(error) if tried else f"without that: {error}")
    return SurveyError(message) if diagnosis is None else DiagnosedError(message, diagnosis)


def causes_first(causes: Iterable[str], then: str) -> str:
    """The message of an error: its causes, then what is to be done, or what was raised."""
    return "\n".join(["\n  - ".join(["probable cause:", *causes]), then])


def with_probable_causes(survey: Survey, result: Adjustment, project: Project) -> Adjustment:
    """The adjustment of the ``survey`` of a project; its first warnings are the probable causes of what contradicts."""
    warnings: tuple[str, ...] = ()
    note: tuple[str, ...] = ()
    alone: tuple[str, ...] = ()
    doubtful: tuple[str, ...] = ()
    diagnosis: Diagnosis | None = None
    if survey.tables:
        from adjust.diagnosis.table.signs import wrong_signs  # here: most surveys start without a table
        from adjust.diagnosis.table.unseen import unseen_readings

        warnings = tuple(f"{h.cause}; {h.change}" for h in wrong_signs(survey, result))
        alone = tuple(f"{f.found}; {f.remedy}" for f in unseen_readings(survey, misspelt=True))
    if _contradicted(survey, result) and not warnings:
        diagnosis, note = _named(_diagnosis(survey, result, None, project), project)
        warnings = diagnosis.lines if diagnosis is not None else _disagreeing_tables(survey)
    if diagnosis is None and not warnings:
        diagnosis, _ = _named(_left_out(survey, result, project), project)
        warnings = diagnosis.lines if diagnosis is not None else ()
    lines = tuple(f"probable cause: {c}" for c in warnings)
    if diagnosis is None and not warnings:
        diagnosis, _ = _named(_too_cautious(survey, result), project)
        head = "probable cause" if diagnosis is not None and diagnosis.spoils else "too good"
        lines = tuple(f"{head}: {c}" for c in diagnosis.lines) if diagnosis is not None else ()
    if diagnosis is None or diagnosis.candidates[0].hypothesis.place.key not in ("sigma", "instrument_height"):
        meant = survey if diagnosis is None else diagnosis.candidates[0].hypothesis.survey
        doubtful = doubtful_values(survey if callable(meant) else meant, project)  # a size is not looked for again
    if diagnosis is None or diagnosis.candidates[0].hypothesis.name != "images mirrored":
        certain, possible = _mirrored(project, result)
        lines, doubtful = (*(f"probable cause: {c}" for c in certain), *lines), doubtful + possible
    warnings = (*lines, *doubtful, *alone, *result.warnings, *note)
    return replace(result, warnings=warnings, diagnosis=diagnosis, doubtful=doubtful)


def _mirrored(project: Project, result: Adjustment) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if not project.target_kinds:
        return (), ()
    from survey.jobs.adjusting.mirrored_survey import mirrored_warnings  # here: as above

    return mirrored_warnings(project, result)


def doubtful_values(survey: Survey, project: Project) -> tuple[str, ...]:
    """What cannot be right by its value alone; not heights of targets, which may be as thin as a millimetre."""
    if not (survey.readings or survey.distances or survey.pairs or survey.table_readings):
        return ()
    from adjust.diagnosis.units.heights import doubtful_heights  # here: as above
    from adjust.diagnosis.weights.impossible import doubtful_sigmas

    sigmas = tuple(doubtful_sigmas(survey))
    if sigmas:
        from survey.jobs.adjusting.written import written_of

        sigmas = tuple(doubtful_sigmas(survey, written_of(project)))
    found = (*doubtful_heights(survey), *sigmas)
    return tuple(f"{h.cause}; {h.change}" for h in found if h.place.kind != "point")


def _diagnosis(
    survey: Survey, result: Adjustment | None, error: SurveyError | None, project: Project
) -> "Diagnosis | None":
    """What explains the misfit by trial; None where none of that is asked.

    Of what stops an adjustment otherwise, as a lack of start values, tables alone.
    """
    refused = error is not None and not isinstance(error, IndeterminateError | NotConvergedError)
    fits = result is not None and result.sigma0 < _LARGE and not _part_contradicted(survey, result)
    if fits or (refused and not survey.tables):
        return None
    from adjust.diagnosis.case import Case  # here: a survey that fits starts without them
    from adjust.diagnosis.diagnosis import diagnose
    from adjust.diagnosis.table.misread import misread_tables
    from survey.jobs.adjusting.written import written_of

    case = Case(survey, result, error, written=written_of(project))
    return diagnose(case, [misread_tables] if refused else None)


def _too_cautious(survey: Survey, result: Adjustment) -> "Diagnosis | None":
    """Groups whose sigmas are far too large, which no test of what contradicts shows; None where there are none.

    Of pairs also the rotations or the shifts alone: where these are in another unit, the survey is so too.
    """
    if not any(g.factor < (_PART if survey.pairs else CAUTIOUS**2) for g in result.groups):
        return None
    from adjust.diagnosis.case import Case  # here: as above
    from adjust.diagnosis.diagnosis import diagnose
    from adjust.diagnosis.weights.parts import UNIT_OF_SHIFTS, units_of_parts
    from adjust.diagnosis.weights.sigmas import wrong_factors

    found = diagnose(Case(survey, result), [units_of_parts])
    if found.candidates:
        return replace(found, spoils=found.candidates[0].hypothesis.name == UNIT_OF_SHIFTS)
    small = any(g.factor < CAUTIOUS**2 for g in result.groups)
    return diagnose(Case(survey, result), [wrong_factors]) if small else None


def _left_out(survey: Survey, result: Adjustment, project: Project) -> "Diagnosis | None":
    """What was left out by the search for gross errors, and fits as it was meant; None where nothing does.

    Of several first what they may have in common.
    """
    left_out = survey.n_others_used - result.survey.n_others_used
    if left_out <= 0:
        return None
    from adjust.diagnosis.diagnosis import Diagnosis, diagnose  # here: as above
    from adjust.diagnosis.trial import misfit_of
    from adjust.diagnosis.units.singles import far_off, misread_singles
    from survey.jobs.adjusting.written import written_of

    written = written_of(project)
    if left_out >= _SEVERAL:
        from adjust.diagnosis.case import Case
        from adjust.diagnosis.families import IN_COMMON

        common = diagnose(Case(survey, result, written=written), IN_COMMON)
        if common.candidates:
            return replace(common, spoils=True)
    found = misread_singles(survey, result, written) or far_off(survey, result)
    names = tuple(dict.fromkeys(c.hypothesis.name for c in found))
    return Diagnosis(found, names, misfit_of(result, survey)) if found else None


def _named(found: "Diagnosis | None", project: Project) -> "tuple[Diagnosis | None, tuple[str, ...]]":
    """The diagnosis with the lines of its project, where it names anything; else what it was not able to look for."""
    if found is None or not found.candidates:
        if found is None:
            return None, ()
        note = "; ".join(t for t in (found.note, f"never looked for: {', '.join(NOT_LOOKED_FOR)}") if t)
        return None, (f"causes of what contradicts: nothing that was tried explains it; {note}",)
    from survey.jobs.adjusting.places import located  # here: as above

    return located(found, project), ()


def _consequence(error: SurveyError) -> str:
    """What failed. Directions and steps are those of a survey that contradicts itself: they would mislead."""
    if isinstance(error, IndeterminateError | NotConvergedError):
        return "mend that first: as it is, the observations lead to no solution"
    return f"without that: {error}"


def _disagreeing_tables(survey: Survey) -> tuple[str, ...]:
    if not survey.tables:
        return ()
    from adjust.diagnosis.table.misread import disagreeing_tables  # here: as above

    return tuple(f"{f.found}; {f.remedy}" for f in disagreeing_tables(survey))


def _contradicted(survey: Survey, result: Adjustment) -> bool:
    """Whether residuals are too large, of all or of a part, or whole images take no part."""
    test = result.global_test
    if test is not None and test.omega > test.upper:
        return True
    return _part_contradicted(survey, result)


def _part_contradicted(survey: Survey, result: Adjustment) -> bool:
    """Whether whole images take no part, or the residuals of a group are far too large, which many others dilute."""
    taking_part = sum(1 for b in result.survey.image_blocks if b.n_used)
    return taking_part < sum(1 for b in survey.image_blocks if b.n_used) or any(
        g.factor > _LARGE**2 and g.omega > float(chi2.isf(_LEVEL, g.redundancy)) for g in result.groups
    )


def separate_epochs(survey: Survey) -> tuple[str, ...]:
    """For people: pairs of cameras of one station that share no epoch although only moving targets join them."""
    moving = {t.target_id for t in survey.targets if t.motion == "epoch"}
    seen: dict[str, set[tuple[str, str]]] = {}
    joined = set()
    for block in survey.image_blocks:
        if block.target_id in moving:
            seen.setdefault(block.camera_id, set()).add((str(block.target_id), block.epoch_id))
        else:
            joined.add(block.camera_id)  # a fixed target or beacons join it to others at any epoch
    on = survey.cameras_by_id
    found = []
    for a, b in itertools.combinations((c for c in seen if c not in joined), 2):
        if on[a].station_id == on[b].station_id and not seen[a] & seen[b]:
            names = ", ".join(repr(sorted(epoch for _, epoch in seen[c])[0]) for c in (a, b))
            found.append(
                f"cameras {a} and {b} share no epoch (the first are {names}): give images of one moment the same "
                "name, images/<camera_id>/<epoch_id>.png, and detect again"
            )
    return tuple(found)
