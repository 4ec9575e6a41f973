"""What every single image says about one pose of a survey, when all the others are as an adjustment has them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.prediction import adjusted_pose, chains_of
from adjust.diagnosis.table.views import view_covariance
from adjust.frames.unknowns import Chain
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray, IntArray
from adjust.spatial.rigid import adjoint, inverse, rotation_log
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2

_CAP = 60.0  # of one comparison of two images, chi-square with six degrees of freedom
_MEDIAN_6 = 5.348
_MOST = 240  # images of one owner that are compared with each other
_LEAST = 2  # images on either side of a step


@dataclass(frozen=True, eq=False)
class Series:
    """The values (n, 4, 4) that n images give one link of their chains.

    blocks: (n,) positions in ``Survey.image_blocks``, in their order. cov: (n, 6, 6) of a small motion on the left.
    """

    name: ParameterName
    blocks: IntArray
    links: FloatArray
    cov: FloatArray


@dataclass(frozen=True, eq=False)
class Step:
    """A series with another value from block ``first`` on. gain: drop of the bounded sum of squares; cuts: compared.

    motion: (4, 4) the later value of the link over the earlier one, where both are known.
    """

    name: ParameterName
    first: int
    gain: float
    cuts: int
    motion: FloatArray | None = None


def series_of(case: Case, result: Adjustment) -> list[Series]:
    """For every pose of a camera or a target that is the same for several images: what each of them says about it."""
    names, chains = chains_of(case.survey)
    poses = {slot: adjusted_pose(case.survey, result, tuple(name)) for slot, name in names.items()}
    users: dict[int, list[int]] = {}
    for i, chain in enumerate(chains):
        for link in chain:
            users.setdefault(link.slot, []).append(i)
    alone = {s for s, name in names.items() if name[0] != "table_motion" and len(users.get(s, ())) < 2}
    out = []
    for slot, name in names.items():
        if name[0] not in ("station_from_camera", "carrier_from_target") or len(name) > 2:
            continue
        rows = [_implied(case, poses, chains[i], slot, i, alone) for i in users.get(slot, ())]
        found = [r for r in rows if r is not None]
        if len(found) >= 2 * _LEAST:
            blocks, links, cov = zip(*found, strict=True)
            out.append(Series(tuple(name), np.array(blocks), np.array(links), np.array(cov)))
    return out


def _implied(
    case: Case, poses: Mapping[int, FloatArray | None], chain: Chain, slot: int, i: int, alone: set[int]
) -> tuple[int, FloatArray, FloatArray] | None:
    """Position, link and covariance of a block; None where a pose that it alone determines takes up what it says."""
    if i not in case.views or case.survey.image_blocks[i].target_id is None:
        return None
    before, after, side = np.eye(4), np.eye(4), 0
    for link in chain:
        if link.slot == slot:
            side = 1
            continue
        value = poses[link.slot]
        if value is None or link.slot in alone:
            return None
        value = inverse(value) if link.inverse else value
        if side:
            after = after @ value
        else:
            before = before @ value
    view, back = case.views[i], inverse(before)
    A = adjoint(back[None])[0]
    return i, back @ view.poses[0] @ inverse(after), A @ view_covariance(case.survey.image_blocks[i], view) @ A.T


def placed_views(case: Case, result: Adjustment, target_id: str) -> tuple[FloatArray, FloatArray]:
    """Places (n, 3) m of the cameras that see a target that stands still, and (n, 3) m from each to its origin.

    Both in the frame that carries the target, by an adjustment without it; the second from single images.
    """
    names, chains = chains_of(case.survey)
    slot = next((s for s, name in names.items() if name == ("carrier_from_target", target_id)), None)
    poses = {s: adjusted_pose(case.survey, result, tuple(name)) for s, name in names.items()}
    places, offsets = [], []
    for i, chain in enumerate(chains):
        if slot is None or case.survey.image_blocks[i].target_id != target_id:
            continue
        found = _implied(case, poses, chain, slot, i, set())
        if found is not None:
            link, view = found[1], case.views[i].poses[0]
            c = (link @ inverse(view))[:3, 3]
            places.append(c)
            offsets.append(link[:3, 3] - c)
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
