"""Sigmas that the residuals contradict. More variance always lowers v'Pv: its logarithm counts against it.

A group with r redundancy and v'Pv Omega whose sigmas are all wrong by the same factor k has Omega / r near k^2, and no
residual stands out from the others: what stands out is a gross error, not a wrong sigma.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, ScaleKey
from adjust.model.errors import listed
from adjust.model.names import grouped
from adjust.model.observations import Distance, Level, OnSurface, Reading
from adjust.model.result import Adjustment, names_of
from adjust.model.rewriting import Fields
from adjust.model.survey import FloatArray, Survey
from adjust.statistics.group_sums import scaled_survey
from adjust.testing.distributions import chi2

_ALPHA = 1e-4
_FEWEST = 8.0
"""Redundancy from which a factor says anything."""
ODD = 100.0
"""Ratio of a sigma to the usual one of its kind that nobody means: a sigma of zero, or of a metre.

No instrument is a hundred times as good as another in one survey; units of lengths and angles differ by that.
"""
_TAILS = 3.0
"""How much heavier than normal the residuals' largest fifth may be for one factor to explain all of them."""
_LAST = 2.0
"""Evidence at most: sigmas that are large enough fit anything, so what else there is to try is tried first."""
_One = Distance | Level | OnSurface | Reading
_KINDS = ("readings", "distances", "levels", "on_surfaces")


def wrong_factors(case: Case) -> Iterator[Hypothesis]:
    """One factor for the sigmas of each group that its residuals contradict, throughout."""
    result = case.result
    if result is None:
        return
    tested = [g for g in result.groups if g.redundancy >= _FEWEST and np.isfinite(g.factor)]
    for group in tested:
        low, high = (float(chi2.ppf(p, group.redundancy)) for p in (_ALPHA, 1.0 - _ALPHA))
        evenly = _evenly(_standardized(result, group.group))
        if low <= group.omega <= high or not evenly or group.factor <= 0.0:
            continue
        factor = float(group.factor)
        k = float(np.sqrt(factor))
        least, most = (np.sqrt(group.omega / float(chi2.ppf(p, group.redundancy))) for p in (0.975, 0.025))
        bounds = (least, most) if k > 1 else (1.0 / most, 1.0 / least)
        between = f"{bounds[0]:.2g} to {bounds[1]:.2g} at 95 %"
        yield Hypothesis(
            "sigmas of a group", f"the sigmas of group {group.group} are {k if k > 1 else 1 / k:.2g} times too "
            f"{'small' if k > 1 else 'large'} ({between}): its residuals are evenly {'larger' if k > 1 else 'smaller'} "
            "than they say",
            f"multiply them by {k:.3g}: {group.group} = {k:.3g} below [sigmas.scale] in survey.toml, or give the "
            "sigmas that the instrument has", Place("group", (group.group,), "sigmas.scale"),
            scaled_survey(case.survey, {group.group: factor}), (ScaleKey(("sigmas", "scale", group.group), k),),
            min(max(factor, 1.0 / factor), _LAST), 1, len(tested), penalty=group.n_observations * float(np.log(factor)),
            of_variances=True, pair_sigmas=_of_every_pair(case.survey, group.group, k),
        )  # fmt: skip


def _of_every_pair(survey: Survey, group: str, k: float) -> FloatArray | None:
    """``k`` for the sigmas of all pairs (n, 6), None where they are not all of the group."""
    alone = bool(survey.pairs) and all(p.group == group for p in survey.pairs)
    return np.full((len(survey.pairs), 6), k) if alone else None


def _standardized(result: Adjustment, group: str) -> FloatArray:
    """All residuals of a group over their own sigmas."""
    images = result.image_residuals
    of_block = np.array([b.group == group for b in result.survey.image_blocks], dtype=bool)
    rows = np.repeat(of_block, np.diff(images.block_ptr)) & images.used
    others = result.other_arrays
    mine = others.used & np.array([of == group for _, of, *_ in names_of(result.other_residuals)], dtype=np.bool_)
    every = np.concatenate([images.standardized[rows].ravel(), others.standardized[mine[others.observation]]])
    return np.asarray(every[np.isfinite(every)])


def _evenly(w: FloatArray) -> bool:
    """Whether the residuals (n,) are of one normal distribution, but for its width: of its middle and of its tails."""
    if len(w) < _FEWEST:
        return False
    size = np.sort(np.abs(w))
    middle = float(np.median(size)) / 0.6745
    tail = float(np.quantile(size, 0.95)) / 1.96
    return middle > 0.0 and tail < _TAILS * middle


def odd_sigmas(case: Case) -> Iterator[Hypothesis]:
    """Observations whose sigma is a hundred times another's of the same kind and group, or a hundredth."""
    for field in _KINDS:
        observed: list[_One] = [o for o in getattr(case.survey, field) if o.used]
        for (kind, group), members in grouped(((getattr(o, "kind", field), o.group), o) for o in observed).items():
            usual, odd = odd_among(members)
            if odd and len(members) > 2 * len(odd) + 1:
                yield _with_usual(case, field, kind, group, odd, usual)


def odd_among(members: Sequence[_One]) -> tuple[float, list[_One]]:
    """The usual sigma of observations of a kind, and those whose sigma is a hundred times that, or a hundredth."""
    usual = float(np.median([o.sigma for o in members]))
    return usual, [o for o in members if not usual / ODD < o.sigma < usual * ODD]


def _with_usual(case: Case, field: str, kind: str, group: str, odd: list[_One], usual: float) -> Hypothesis:
    ids = [id_of(o) for o in odd]
    chosen = {id(o) for o in odd}
    every = getattr(case.survey, field)
    changed: Fields = {field: tuple(replace(o, sigma=usual) if id(o) in chosen else o for o in every)}
    ratio = max(max(o.sigma / usual, usual / max(o.sigma, 1e-300)) for o in odd)
    return Hypothesis(
        "odd sigma", f"{kind} {listed(ids, 5)}: the sigma "
        f"is {ratio:.0f} times off the usual one of group {group}", "give the sigma that was meant, or none",
        Place("reading", tuple(ids), "sigma"), replace(case.survey, **changed), (),
        min(ratio, 10.0), len(odd),  # if the sigma were right, doing nearly without it would be worth chi-square
        of_variances=True,
    )  # fmt: skip


def kind_of(o: Reading | Distance) -> str:
    """Of a reading; "distance" of all other lengths."""
    return o.kind if isinstance(o, Reading) else "distance"


def id_of(o: _One) -> str:
    """Of an observation."""
    names = ("reading_id", "distance_id", "level_id", "surface_id")
    return str(next(getattr(o, n) for n in names if hasattr(o, n)))
