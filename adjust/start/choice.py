"""Which start values an adjustment begins with: those given, and where they lead nowhere those found without them."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.graph.assembly import StartValues, values_of
from adjust.model.errors import GivenUpError, NotConvergedError, SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey
from adjust.start.given import GivenStarts, given_starts, without_starts
from adjust.start.reflection import Apart, apart, mirrored

_LOST_PX = 20.0
"""Median misfit of the images from which a start is tried only after others; good ones are near 1 px."""
_NO_FIT = 10.0
"""sigma0 above which a solution is compared with those from other starts."""
_AS_WELL = 9.0
"""By how much v'Pv of a mirror image may be larger, and the image fit as well: three sigmas."""
_TURNED = np.deg2rad(20.0)
_SHOWN = 8


@frozen(eq=False)
class Begun:
    """A survey without what its search for start values does not trust, the values, and notes on what was left out.

    misfit_px: median over the images, zero where there are none.
    """

    survey: Survey
    start: StartValues
    notes: tuple[str, ...] = ()
    misfit_px: float = 0.0


def adjusted_from_own_start(
    survey: Survey, find: Callable[[Survey, GivenStarts], Begun], run: Callable[[Begun], Adjustment]
) -> Adjustment:
    """An adjustment from start values that are found where they are not given, near those given if that fits as well.

    As :func:`_that_leads` and :func:`_near_given` say.
    """
    return _near_given(survey, _that_leads(survey, find, run), run)


def _that_leads(
    survey: Survey, find: Callable[[Survey, GivenStarts], Begun], run: Callable[[Begun], Adjustment]
) -> Adjustment:
    """``run(find(survey))``; where that fails or fits badly, from starts found without the values given for them.

    find: start values of a survey; the given ones tell where a free datum belongs. Of several solutions that do not fit
    the best is taken; a start other than the given one is told in the warnings. Raises what the first one raised,
    where that did not converge what was given up.
    """
    given = given_starts(survey)
    first: SurveyError | None = None
    best: tuple[float, Adjustment] | None = None
    for number, what, begun in _starts(survey, given, find):
        if isinstance(begun, SurveyError):
            first = begun if number == 0 else first
            continue
        try:
            result = run(begun)
        except SurveyError as error:
            given_up = isinstance(error, GivenUpError) and type(first) is NotConvergedError
            first = error if number == 0 or first is None or given_up else first
            continue
        # a start that was put off, since the images did not fit it well, is mentioned where it was wrong indeed
        if number > 0 and (first is not None or best is not None or _turned_away(given, result)):
            note = _said(given, what, first if best is None else None)
            result = replace(result, warnings=(*result.warnings, note))
        fit = result.sigma0 if np.isfinite(result.sigma0) else 0.0
        if best is None or fit < 0.5 * best[0]:
            best = fit, result
        if fit < _NO_FIT:
            break
    if best is not None:
        return best[1]
    raise first if first is not None else SurveyError("no start values were found")


def _starts(
    survey: Survey, given: GivenStarts, find: Callable[[Survey, GivenStarts], Begun]
) -> Iterator[tuple[int, str, Begun | SurveyError]]:
    """Number (0: as given), what was found anew, and the start or why there is none; lost ones come last."""
    lost: list[tuple[float, int, str, Begun]] = []
    for number, (what, trial) in enumerate(_trials(survey, given)):
        try:
            begun = find(trial, given)
        except SurveyError as error:
            yield number, what, error
            continue
        if begun.misfit_px > _LOST_PX and given:
            lost.append((begun.misfit_px, number, what, begun))
        else:
            yield number, what, begun
    for _, number, what, begun in sorted(lost, key=lambda item: item[:2]):
        yield number, what, begun


def _trials(survey: Survey, given: GivenStarts) -> Iterator[tuple[str, Survey]]:
    """The survey as it is, then without given start values: those of points, of poses, all."""
    yield "", survey
    if given.points:
        yield "points", without_starts(survey, points=True, poses=False)
    if given.poses:
        yield "poses", without_starts(survey, points=False, poses=True)
    if given.points and given.poses:
        yield "points and poses", without_starts(survey, points=True, poses=True)


def _turned_away(given: GivenStarts, result: Adjustment) -> bool:
    """Whether a pose was adjusted to something else than the start value given for it."""
    found = {n: e.value for n, e in result.estimates.items() if n in given.poses}
    turns = (given.poses[n].rotation().between(p.rotation()) for n, p in found.items() if isinstance(p, Pose3))
    return any(float(np.linalg.norm(Rot3.Logmap(turn))) > _TURNED for turn in turns)


def _said(given: GivenStarts, what: str, error: SurveyError | None) -> str:
    names = list(given.points) if "points" in what else []
    names += [" ".join(n) for n in given.poses] if "poses" in what else []
    why = f": {str(error).splitlines()[0]}" if error is not None else ""
    return (
        f"start values: those given for {what} ({listed(names, _SHOWN)}) lead to no solution that fits{why}; "
        "they were found anew from the observations: check what was given"
    )


def _near_given(survey: Survey, result: Adjustment, run: Callable[[Begun], Adjustment]) -> Adjustment:
    """The result, or its mirror image where that fits as well and lies nearer to the start values; what is far is told.

    Only what no image sees can be mirrored: a ray tells in front from behind.
    """
    found = apart(survey, result)
    if not found.far.any():
        return result
    for places in mirrored(survey, result, found) if not survey.image_blocks else ():
        try:
            other = run(Begun(result.survey, _from_places(result, places)))
        except SurveyError:
            continue
        now = apart(survey, other)
        if other.omega <= result.omega + _AS_WELL * max(1.0, result.sigma0**2) and now.rms < 0.5 * found.rms:
            said = (
                f"start values: the observations fit two mirror images equally well (v'Pv {result.omega:.4g} and "
                f"{other.omega:.4g}); the one near the start values is kept: {_some(found)}"
            )
            kept = tuple(w for w in result.warnings if w.startswith("start values"))
            return _with_far(replace(other, warnings=(*other.warnings, *kept, said)), now)
    return _with_far(result, found)


def _from_places(result: Adjustment, places: Mapping[str, FloatArray]) -> StartValues:
    """The adjusted values with other places of points; what is turned there is found anew."""
    start = values_of(result)
    vectors = {n: v for n, v in start.vectors.items() if n[0] not in ("orientation", "centring")}
    return replace(start, points={**start.points, **places}, vectors=vectors)


def _with_far(result: Adjustment, found: Apart) -> Adjustment:
    if not found.far.any():
        return result
    note = (
        f"start values: {int(found.far.sum())} of {len(found.ids)} points lie far from the start values given for "
        f"them: {_some(found)}; check names and coordinates, and whether the network came out mirrored"
    )
    return replace(result, warnings=(*result.warnings, note))


def _some(found: Apart) -> str:
    order = [int(i) for i in np.argsort(-found.distances) if found.far[i]]
    return listed([f"{found.ids[i]} ({found.distances[i]:.4g} m)" for i in order], _SHOWN)
