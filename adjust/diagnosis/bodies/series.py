"""What every single image says about one pose of a survey, when all the others are as an adjustment has them."""


import numpy as np

from adjust.diagnosis.alone import view_covariance
from adjust.diagnosis.case import Case
from adjust.diagnosis.prediction import Altered, Prediction
from adjust.model.frozen import frozen
from adjust.model.names import grouped
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, IntArray
from adjust.spatial.rigid import adjoint, inverse, rotation_log
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2

_CAP = 60.0  # of one comparison of two images, chi-square with six degrees of freedom
_MEDIAN_6 = 5.348
_MOST = 240  # images of one owner that are compared with each other
_LEAST = 2  # images on either side of a step


@frozen(eq=False)
class Series:
    """The values (n, 4, 4) that n images give one link of their chains.

    blocks: (n,) positions in ``Survey.image_blocks``, in their order. cov: (n, 6, 6) of a small motion on the left.
    """

    name: ParameterName
    blocks: IntArray
    links: FloatArray
    cov: FloatArray


@frozen(eq=False)
class Step:
    """A series with another value from block ``first`` on. gain: drop of the bounded sum of squares; cuts: compared.

    motion: (4, 4) the later value of the link over the earlier one, where both are known.
    """

    name: ParameterName
    first: int
    gain: float
    cuts: int
    motion: FloatArray | None = None


def series_of(case: Case, values: Altered) -> list[Series]:
    """For every pose of a camera or a target that is the same for several images: what each of them says about it."""
    prediction, blocks = Prediction(case.survey, values), case.survey.image_blocks
    users = grouped((name, i) for i, block in enumerate(blocks) for name, _ in prediction.links(block))
    alone = {name for name, of in users.items() if name[0] != "table_motion" and len(of) < 2}
    out = []
    for name, of in users.items():
        if name[0] not in ("station_from_camera", "carrier_from_target") or len(name) > 2:
            continue
        found = [(i, *x) for i in of if i in case.views and (x := _implied(case, prediction, i, name, alone))]
        if len(found) >= 2 * _LEAST:
            rows, links, cov = zip(*found, strict=True)
            out.append(Series(name, np.array(rows), np.array(links), np.array(cov)))
    return out


def _implied(
    case: Case, prediction: Prediction, i: int, name: ParameterName, alone: set[ParameterName]
) -> tuple[FloatArray, FloatArray] | None:
    """Link and covariance of a block; None where a pose that it alone determines takes up what it says."""
    block, view = case.survey.image_blocks[i], case.views[i]
    found = prediction.implied(block, view.poses[0], name, alone)
    if found is None:
        return None
    A = adjoint(found[1][None])[0]
    return found[0], A @ view_covariance(block, view) @ A.T


def placed_views(case: Case, values: Altered, target_id: str) -> tuple[FloatArray, FloatArray]:
    """Places (n, 3) m of the cameras that see a target that stands still, and (n, 3) m from each to its origin.

    Both in the frame that carries the target, by values of a survey without it; the second from single images.
    """
    prediction, places, offsets = Prediction(case.survey, values), [], []
    for i, view in sorted(case.views.items()):
        block = case.survey.image_blocks[i]
        if block.target_id != target_id:
            continue
        found = prediction.implied(block, view.poses[0], ("carrier_from_target", target_id))
        if found is not None:
            c = (found[0] @ inverse(view.poses[0]))[:3, 3]
            places.append(c)
            offsets.append(found[0][:3, 3] - c)
    return np.array(places).reshape(-1, 3), np.array(offsets).reshape(-1, 3)


def step_of(series: Series) -> Step | None:
    """The best place for a step in a series; None where two values explain it no better than one.

    Every value is that of one of the images (a medoid): images that are wrong by themselves do not spoil it.
    """
    rows = np.arange(len(series.blocks))[:: max(1, len(series.blocks) // _MOST)]
    L, cov = series.links[rows], series.cov[rows]
    between = L[:, None] @ inverse(L)[None]
    turns, n = rotation_log(between[..., :3, :3].reshape(-1, 3, 3)), len(rows)
    d = np.concatenate([turns, between[..., :3, 3].reshape(-1, 3)], axis=1)
    info = np.linalg.inv((cov[:, None] + cov[None]).reshape(-1, 6, 6))
    squares = np.einsum("ni,nij,nj->n", d, info, d).reshape(n, n)
    near = np.diag(squares, 1)
    capped = np.minimum(squares / max(1.0, float(np.median(near)) / _MEDIAN_6), _CAP)
    before = np.cumsum(capped, axis=1)
    whole = float(before[:, -1].min())
    costs = [
        float(before[:k, k - 1].min() + (before[k:, -1] - before[k:, k - 1]).min())
        for k in range(_LEAST, n - _LEAST + 1)
    ]
    if not costs:
        return None
    best = int(np.argmin(costs))
    gain = whole - costs[best]
    if gain < float(chi2.isf(sidak(1e-4, len(costs)), 6)):
        return None
    k = best + _LEAST
    early, late = int(np.argmin(before[:k, k - 1])), k + int(np.argmin(before[k:, -1] - before[k:, k - 1]))
    return Step(series.name, int(series.blocks[rows[k]]), gain, len(costs), L[late] @ inverse(L[early]))
