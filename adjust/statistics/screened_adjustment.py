"""The whole adjustment of a survey: without its gross errors, and with estimated variances where that is asked for."""

from collections.abc import Callable, Sequence
from dataclasses import field, replace

import numpy as np

from adjust.adjustment import AdjustOptions, adjust
from adjust.graph.assembly import StartValues, values_of
from adjust.model.errors import IndeterminateError, NotConvergedError, SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, Component, VarianceComponents
from adjust.model.subsets import positions_of
from adjust.model.survey import Survey
from adjust.statistics.group_sums import scaled_survey
from adjust.statistics.outliers.outcome import OutlierSearch, SearchOptions
from adjust.statistics.outliers.search import disagreeing_pairs, distances_in_the_way, search_outliers
from adjust.statistics.outliers.watched import watchable
from adjust.statistics.variance_components import Scaled, estimate_variance_components
from adjust.testing.criteria import limits

_LARGEST, _ROOM = 6000, 1e8
"""Unknowns up to which gross errors are always searched; above, numbers that the search may need for its columns."""
_PASSES = 3
_FEW_STEPS = 30
"""From which on it is asked what is in the way of a solution; what has one has it in ten or so."""
_CONTROLLED = 1e-4
"""Redundancy number below which nothing controls an observation."""
_SCREENED = "left out as gross errors"
_OTHERS = (
    "table", "pair", "distance", "coordinates", "coordinate_difference", "level", "alignment", "laser", "surface",
    "direction", "angle", "zenith", "azimuth", "slope_distance", "horizontal_distance", "height_difference",
)  # fmt: skip


@frozen
class CleanOptions:
    """reject_pairs: leave out what contradicts the rest: pairs, and observations of all kinds but image points.

    adjust: the adjustment itself. variance_components: the variances of all groups are estimated.
    """

    reject_pairs: bool = True
    adjust: AdjustOptions = field(default_factory=AdjustOptions)
    variance_components: bool = False


def adjust_cleaned(
    survey: Survey, options: CleanOptions = CleanOptions(), progress: Callable[[int, float], None] | None = None,
    start: StartValues | None = None,
) -> Adjustment:  # fmt: skip
    """Adjust; what was left out and which variances were estimated is part of the result and its warnings.

    Raises as :func:`adjust.adjustment.adjust`.
    """
    found = _cleaned(survey, options, progress, start)
    if options.reject_pairs and _blamed_on_rays(survey, found):
        # a wrong tape reading to a beacon that few images see is explained as well by leaving out its rays: the
        # explanation that needs fewer observations left out is the likelier one
        other = _others_first(survey, options, progress, start)
        if other is not None and _left_out(survey, other) < _left_out(survey, found):
            return other
    if found.survey.pair_form == "poses":
        return found
    from adjust.relay.closed import in_condition_form  # here: most surveys go without it

    return in_condition_form(found)


def _cleaned(
    survey: Survey, options: CleanOptions, progress: Callable[[int, float], None] | None, start: StartValues | None
) -> Adjustment:
    """Image points are screened before all others."""
    first, search = _first(survey, options, progress, start)
    now, scaled, factors = first, None, dict[str, float]()
    rejected: set[tuple[str, ...]] | None = None
    for _ in range(_PASSES):
        if factors:  # what was left out before is tried again with the variances of now
            given = scaled_survey(first.survey, factors)
            now = adjust(given, values_of(now), options.adjust, progress)
        if search is None or now is not first:
            search = _searched(survey, now, options, progress)
        now = search.adjustment if search is not None else now
        found = {(d.kind, *d.ids) for d in search.rejected} if search is not None else set[tuple[str, ...]]()
        if not options.variance_components or found == rejected:
            break
        rejected = found
        scaled = estimate_variance_components(now.survey, None, options.adjust, progress, now)
        now = scaled.adjustment
        factors = {c.group: factors.get(c.group, 1.0) * c.factor for c in scaled.components.components}
    return _told(now, first, search, scaled, factors, _unsearched(now, options))


def _first(
    survey: Survey, options: CleanOptions, progress: Callable[[int, float], None] | None, start: StartValues | None
) -> tuple[Adjustment, OutlierSearch | None]:
    """The first adjustment; without what is in the way of one, where something is, and then the search it began."""
    wrong = disagreeing_pairs(survey, only_large=True) if options.reject_pairs and start is None else None
    try:
        if wrong is None:
            return adjust(survey, start, _soon(survey, options), progress), None
    except NotConvergedError:
        wrong = disagreeing_pairs(survey) or distances_in_the_way(survey) if options.reject_pairs else None
        if wrong is None and _soon(survey, options) is options.adjust:
            raise
    if wrong is not None:
        try:
            search = search_outliers(survey, None, _how(options), progress, wrong=wrong)
            return search.adjustment, search
        except (IndeterminateError, NotConvergedError):
            if wrong.field != "distances":
                raise
    return adjust(survey, start, options.adjust, progress), None


def _soon(survey: Survey, options: CleanOptions) -> AdjustOptions:
    """With few steps, where distances may be in the way of more."""
    if not survey.distances or not options.reject_pairs:
        return options.adjust
    solve = options.adjust.solve
    return replace(options.adjust, solve=replace(solve, max_iterations=min(_FEW_STEPS, solve.max_iterations)))


def _unsearched(now: Adjustment, options: CleanOptions) -> tuple[str, ...]:
    """That nothing was searched although something fails, in one line."""
    n = _failing(now) if options.reject_pairs else 0
    if not n or _searchable(now, n):
        return ()
    return (
        f"{n} observations fail their tests, but gross errors were not searched for: these are too many among "
        f"{now.n_unknowns} unknowns; check the sigmas, or leave out what the list of tests shows, worst first",
    )


def _searchable(now: Adjustment, n: int) -> bool:
    """Whether ``n`` observations that fail can be left out one after the other."""
    few = now.n_unknowns <= _LARGEST or n * len(now.other_residuals) <= _ROOM
    return few or watchable(now)


def _blamed_on_rays(survey: Survey, found: Adjustment) -> bool:
    """Whether rays to points, or images from stations, were left out that observations of another kind touch."""
    others = (o for kind in survey.others.values() for o in kind if o.used)
    touched = {r.point_id for o in others for r in positions_of(o) if r.frame is None}
    names = [p.point_id for p in found.survey.points]
    paired = {r.frame_id for p in survey.pairs if p.used for r in (p.a, p.b) if r.kind == "station"}
    carrying = {c.camera_id for c in survey.cameras if c.station_id in paired}
    if not touched and not carrying:
        return False
    kept = {(b.camera_id, b.epoch_id) for b in found.survey.image_blocks if b.n_used}
    lost = {b.camera_id for b in survey.image_blocks if (b.camera_id, b.epoch_id) not in kept and b.n_used}
    return bool(lost & carrying) or any(
        b.camera_id in carrying or names[int(i)] in touched
        for b in found.survey.image_blocks
        if b.target_id is None and b.used is not None
        for i in b.point_idx[~b.used]
    )


def _others_first(
    survey: Survey, options: CleanOptions, progress: Callable[[int, float], None] | None, start: StartValues | None
) -> Adjustment | None:
    """The other order: all other kinds before the image points; None where that leads nowhere."""
    unscreened = replace(options, adjust=replace(options.adjust, reject_points=False, reject_blocks=False))
    try:
        first = adjust(survey, start, unscreened.adjust, progress)
        search = _searched(survey, first, unscreened, progress)
        now = first if search is None else search.adjustment
        if search is None or not search.rejected:
            return None
        found = _cleaned(now.survey, options, progress, values_of(now))
    except SurveyError:
        return None
    notes = tuple(n for n in search.notes if n not in found.warnings)
    return replace(found, decisions=(*search.log, *found.decisions), warnings=found.warnings + notes)


def _left_out(given: Survey, found: Adjustment) -> int:
    """Number of observed components in use that take no part any more; a whole image counts like each of its points."""
    before = sum(2 * b.n_used for b in given.image_blocks)
    after = 2 * int(found.image_residuals.used.sum())
    out = sum(len(o.components) for o in found.other_residuals if not o.used)
    return before - after + out - sum(not o.used for kind in given.others.values() for o in kind)


def _searched(
    given: Survey, now: Adjustment, options: CleanOptions, progress: Callable[[int, float], None] | None
) -> OutlierSearch | None:
    """The search for gross errors; None where nothing fails, or nothing can be searched."""
    n = _failing(now) if options.reject_pairs else 0
    if not n or not _searchable(now, n):
        return None
    return search_outliers(given, options=_how(options), progress=progress, first=now)


def _how(options: CleanOptions) -> SearchOptions:
    return SearchOptions(kinds=_OTHERS, adjust=options.adjust)


def _failing(now: Adjustment) -> int:
    """How many observations that are no image points fail their tests."""
    others = now.other_arrays
    tested = others.used & (others.redundancy > 1e-6)
    n = int(tested.sum()) + int(now.image_residuals.used.sum())
    limit = limits(SearchOptions().family_alpha, others.n_components[tested], n)
    return int(np.count_nonzero(others.test[tested] > limit))


def _told(
    now: Adjustment, first: Adjustment, search: OutlierSearch | None, scaled: Scaled | None, factors: dict[str, float],
    unsearched: tuple[str, ...] = (),
) -> Adjustment:  # fmt: skip
    """With its history, and the warnings of the first adjustment that are not about the solution itself."""
    known = set(now.warnings)
    about_first = ("left out", "camera")
    screened = search.adjustment if search is not None and search.rejected else first  # image points, anew
    about = [w for w in first.warnings if w.startswith(about_first) and _SCREENED not in w]
    kept = tuple(w for w in (*about, *(w for w in screened.warnings if _SCREENED in w)) if w not in known)
    notes = search.notes if search is not None else unsearched
    components = None
    if scaled is not None:
        components = replace(scaled.components, components=_total(scaled.components.components, factors))
        notes += component_notes(components)
    return replace(
        now, warnings=now.warnings + notes + kept + uncontrolled_pairs(now), variance_components=components,
        decisions=search.log if search is not None else (),
    )  # fmt: skip


def _total(components: Sequence[Component], factors: dict[str, float]) -> tuple[Component, ...]:
    """Over the a priori variances, of all passes."""
    out = []
    for c in components:
        ratio = factors.get(c.group, c.factor) / c.factor
        values = {name: getattr(c, name) * ratio for name in ("factor", "sigma", "lower", "upper")}
        out.append(replace(c, **values))
    return tuple(out)


def component_notes(components: VarianceComponents) -> tuple[str, ...]:
    """What the reader of variance components should know."""
    out = []
    for c in components.components:
        if c.status == "vanished":
            out.append(
                f"variance component of group {c.group}: its residuals are smaller than any variance explains; check "
                "whether its observations are independent of the others"
            )
        elif c.status == "no redundancy":
            out.append(f"variance component of group {c.group}: too few checked observations; its sigmas are as given")
        elif c.status == "estimated" and c.p < 0.01:
            out.append(
                f"variance component of group {c.group}: sigmas were {np.sqrt(c.factor):.2f} times those given "
                f"(factor {c.factor:.3g} +- {c.sigma:.2g}, p {c.p:.2g})"
            )
    for groups in components.unseparable:
        out.append(f"variance components of groups {', '.join(groups)}: only a mixture shows; they share one factor")
    if not components.converged:
        out.append("the variance components did not settle; look for gross errors or groups with too few observations")
    return tuple(out)


def uncontrolled_pairs(result: Adjustment) -> tuple[str, ...]:
    """Warning of pairs in use that nothing checks."""
    arrays, single = result.other_arrays, result.single_residuals
    weak = np.flatnonzero((arrays.used & (arrays.redundancy < _CONTROLLED))[: len(single)])
    ids = [single[i].ids[0] for i in weak.tolist() if single[i].kind == "pair"]
    if not ids:
        return ()
    what = "pair {} closes no loop: nobody would notice an error in it" if len(ids) == 1 else (
        "pairs {} close no loop: nobody would notice an error in them"
    )  # fmt: skip
    return (what.format(listed(ids, 12)) + "; measure a second way to what it leads to",)
