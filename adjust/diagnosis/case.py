"""The survey that does not fit, with the data from which hypotheses are formed; everything costly is found once."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import field, replace
from functools import cached_property

import numpy as np

from adjust.adjustment import AdjustOptions
from adjust.diagnosis.alone import completed, own_lenses, single_views
from adjust.diagnosis.budget import REST, SCORES, START, STEP, Budget
from adjust.diagnosis.memory import own_start
from adjust.diagnosis.prediction import Altered, Linear, adjusted_values, started_values
from adjust.diagnosis.units.conventions import UNKNOWN, Written
from adjust.graph.assembly import StartValues, values_of
from adjust.graph.solver import SolveOptions
from adjust.model.errors import IndeterminateError, NotConvergedError, SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey
from adjust.start.given import given_starts
from adjust.start.views import View

CAP = 50.0
"""The most that one component of an observation counts: what is left out, or cannot be predicted, counts so."""
_LEFT_OUT = 4
_FAR = 25.0
"""Variance factor from which a solution may be another one than that of the observations without their mistake."""
_LOST_ROUNDS = 3
_NEAR = AdjustOptions(reject_blocks=False, solve=SolveOptions(max_step=1e-3, max_iterations=20, settled=1e-4))
_OWN = replace(_NEAR, solve=replace(_NEAR.solve, max_iterations=8))
"""From near values and from own start values: a survey that is right converges soon, and is only compared."""
_LOST = 1e4
"""v'Pv over that of observations none of which is explained, from which values that are on their way say nothing."""


@frozen(eq=False)
class Case:
    """A survey, and what became of it: its adjustment, or the error instead; what its diagnosis may still adjust.

    written: how its project writes it.
    """

    survey: Survey
    result: Adjustment | None = None
    error: SurveyError | None = None
    budget: Budget = field(default_factory=Budget)
    passed_over: list[str] = field(default_factory=list)
    """Kinds of causes that are not looked for in a survey of this size; families add theirs."""
    written: Written = UNKNOWN

    def few(self, name: str, number: int, most: int) -> bool:
        """Whether a kind of cause is looked for, whose cost grows with a number faster than that of adjusting."""
        if number > most and name not in self.passed_over:
            self.passed_over.append(name)
        return number <= most

    def run(self, survey: Survey) -> Adjustment:
        """A survey like this one, or a part of it, adjusted from its own start. SurveyError where that fails."""
        n, whole = len(survey.image_blocks), len(self.survey.image_blocks)
        share, start = n / whole if n and whole else 1.0, None if n or survey.pairs else own_start(survey)
        lost = _LOST * _nothing(survey)
        return self.budget.adjusted(survey, start, _OWN, (START + REST) * share, STEP * share, lost=lost)

    def _near(self, survey: Survey, result: Adjustment, most: float, options: AdjustOptions) -> Adjustment:
        """From the values of another adjustment. most: v'Pv that it has to come below."""
        rest, start = REST if survey.image_blocks else START + REST, completed(survey, values_of(result, survey))
        lost = _LOST * _nothing(survey) if options is _OWN else np.inf
        return self.budget.adjusted(survey, start, options, rest, most=most, lost=lost)

    def warm(self, survey: Survey) -> Adjustment:
        """A survey that is much like this one, with all images, adjusted from the values of this one.

        SurveyError where that fails.
        """
        known = next((result for of, result in self._last if of is survey), None)
        if known is not None:
            return known
        if self.linear is None:
            raise SurveyError("there are no values to begin with")
        result = self._near(survey, self.linear.result, self.linear.result.omega, _NEAR)
        self._last[:] = [*self._last[-1:], (survey, result)]
        return result

    def reweighted(self, by: FloatArray) -> Adjustment | None:
        """The same with the sigmas of its pairs (n, 6) multiplied, as far as a misfit says of it.

        None where it takes a graph of its own. SurveyError where that fails.
        """
        if not self.survey.pairs or self.linear is None:
            return None
        from adjust.diagnosis.weights.reweighted import reweighted  # here: most surveys have no pairs

        result = self.linear.result
        return reweighted(result, by, _NEAR.solve.settled, lambda: self.budget.paying(START + REST, most=result.omega))

    @cached_property
    def _last(self) -> list[tuple[Survey, Adjustment]]:
        """The two surveys that were adjusted last, and how."""
        return []

    @cached_property
    def values(self) -> Altered | None:
        """Adjusted values of all unknowns, start values where there is no adjustment; None where nothing is found."""
        return adjusted_values(self.result) if self.result is not None else self.rough(self.survey)

    def rough(self, survey: Survey) -> Altered | None:
        """Start values of a survey: closed forms and robust means of what agrees; None where these find none."""
        for _ in range(_LOST_ROUNDS):
            try:
                return started_values(self.start if survey is self.survey else self._started(survey))
            except IndeterminateError as error:
                lost = {n.removeprefix("point ") for n in error.parameters}
                if not lost & {p.point_id for p in survey.points}:
                    return None
                survey = without_points(survey, lost)
            except (SurveyError, RuntimeError):
                return None
        return None

    @cached_property
    def start(self) -> StartValues:
        """Start values of the survey as it stands. Raises SurveyError where there are none, each time."""
        return self._started(self.survey)

    def _started(self, survey: Survey) -> StartValues:
        self.budget.spend(START if survey.image_blocks else 0.1)
        return own_start(survey)

    @cached_property
    def views(self) -> Mapping[int, View]:
        """Every block of a target with enough points, as rays and poses ``camera_from_target``, each by itself."""
        return {v.block_idx: v for v in single_views(self.survey, self.lenses)}

    @cached_property
    def lenses(self) -> Mapping[str, FloatArray]:
        """The lens (n,) of each camera, from its own images alone; a camera without any is not there."""
        return own_lenses(self.survey, {} if self.result is None else values_of(self.result).lenses)

    @cached_property
    def views_of(self) -> Mapping[tuple[str, str], Mapping[str, View]]:
        """The same that have a pose, by camera and target, of each by epoch."""
        out: dict[tuple[str, str], dict[str, View]] = {}
        for i, view in sorted(self.views.items()):
            block = self.survey.image_blocks[i]
            if len(view.poses):
                out.setdefault((block.camera_id, str(block.target_id)), {})[block.epoch_id] = view
        return out

    def without_each(self, field_name: str) -> Iterator[tuple[str, Altered]]:
        """(id, start values of the survey without its images), where there are any; field_name: target_id, camera_id.

        Of the few targets or cameras with the largest misfit, or with most images where nothing is adjusted. Each is
        started when it is asked for, as long as there is time to try what that shows.
        """
        share = dict[str, float]()
        for block, squares in zip(self.survey.image_blocks, block_squares(self.survey, self.result), strict=True):
            if (owner := getattr(block, field_name)) is not None:
                share[owner] = share.get(owner, 0.0) + float(np.minimum(squares, 2.0 * CAP).sum())
        for owner in sorted(share, key=lambda o: -share[o])[: _LEFT_OUT * (len(share) > 1)]:
            key = field_name, owner
            if key not in self._without:
                if not self.budget.lasts:
                    self.budget.refused = True
                    return
                self._without[key] = self.rough(without(self.survey, field_name, owner))
            if (values := self._without[key]) is not None:
                yield owner, values

    @cached_property
    def _without(self) -> dict[tuple[str, str], Altered | None]:
        return {}

    @cached_property
    def linear(self) -> Linear | None:
        """The adjustment with all images in use, as a linear system; None where there is none.

        One that did not converge may have settled: what it still changes is nothing to v'Pv. Where the search for gross
        errors left out what others need, all observations together may still determine everything.
        """
        if self.result is None and not isinstance(self.error, NotConvergedError | IndeterminateError):
            return None
        if self.result is not None and not self.result.redundancy > 0:
            return None
        try:
            result = self.result
            if result is None:
                survey = self.survey
                start = None if survey.pairs or (given_starts(survey) and survey.image_blocks) else self.start
                most = _LOST * _nothing(survey)
                result = self.budget.adjusted(survey, start, _NEAR, START * (start is None) + REST, most=most)
            elif not self.is_whole:
                result = self._near(self.survey, result, np.inf, _OWN)
            self.budget.spend(SCORES)
            return Linear(result)
        except SurveyError:
            return None

    @property
    def starts_afresh(self) -> bool:
        """Whether what is tried has its own start: from no values, or where these are lost and a start costs little."""
        return (self.result is None and not self.survey.image_blocks) or self.linear is None

    @property
    def is_near(self) -> bool:
        """Whether all observations take part in its adjustment, and leave its values near to where they belong."""
        return self.result is not None and self.linear is not None and not self.is_spoilt

    @property
    def is_lost(self) -> bool:
        """Whether its images leave no values, or such as are far from where they belong."""
        return bool(self.survey.image_blocks) and (self.linear is None or self.is_spoilt)

    @property
    def is_spoilt(self) -> bool:
        """Whether its values are far from where they belong, as far as there are any."""
        return self.linear is not None and self.linear.scale >= _FAR

    @cached_property
    def is_whole(self) -> bool:
        """Whether every image point and observation in use takes part in the adjustment."""
        if self.result is None:
            return False
        given = sum(int(b.mask.sum()) for b in self.survey.image_blocks)
        images = given == int(self.result.image_residuals.used.sum())
        return images and self.survey.n_others_used == self.result.survey.n_others_used


def _nothing(survey: Survey) -> float:
    """v'Pv, bounded, of observations none of which is explained."""
    return CAP * (2 * sum(b.n_used for b in survey.image_blocks) + survey.n_others_used)


def without(survey: Survey, field_name: str, owner: str) -> Survey:
    """The survey less the images of one camera, or those of one target."""
    blocks = tuple(b for b in survey.image_blocks if getattr(b, field_name) != owner)
    cameras = tuple(c for c in survey.cameras if field_name != "camera_id" or c.camera_id != owner)
    return replace(survey, image_blocks=blocks, cameras=cameras)


def without_points(survey: Survey, ids: Collection[str]) -> Survey:
    """The survey less the image points of some points of the world."""
    lost = [i for i, p in enumerate(survey.points) if p.point_id in ids]
    kept = [b.mask & (True if b.target_id is not None else ~np.isin(b.point_idx, lost)) for b in survey.image_blocks]
    blocks = (replace(b, used=k) for b, k in zip(survey.image_blocks, kept, strict=True))
    return replace(survey, image_blocks=tuple(b for b in blocks if b.n_used))


def block_squares(survey: Survey, result: Adjustment | None) -> list[FloatArray]:
    """Squares over sigmas (n,) of the points of each image block; infinite for what is not adjusted or predicted."""
    out = [np.full(len(b.uv), np.inf) for b in survey.image_blocks]
    if result is None:
        return out
    ptr, residuals = result.image_residuals.block_ptr, result.image_residuals.residuals
    place = {b.place: i for i, b in enumerate(survey.image_blocks)}
    for k, block in enumerate(result.survey.image_blocks):
        r = residuals[ptr[k] : ptr[k + 1]]
        squares = np.einsum("ni,nij,nj->n", r, np.linalg.inv(block.cov), r)
        i = place.get(block.place)
        if i is not None:
            out[i] = np.where(np.isfinite(squares), squares, np.inf)
    return out
