"""Measured pairs after the adjustment: adjusted value, sigma, residual and test of each."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.model.observations import frame_text
from adjust.model.result import Adjustment, ObservationResidual
from adjust.model.survey import FloatArray
from adjust.observations.pairs import pair_arrays
from adjust.precision.precision import Precision
from adjust.spatial.rigid_motions import Motions
from adjust.testing.distributions import chi2
from survey.solution.frames import AdjustedFrames
from survey.solution.loops import motion_arrays
from survey.solution.quantities import ARCSEC_PER_RAD, Scale, pair_sigmas, pose_dicts

UNCONTROLLED = 1e-4
"""Redundancy number below which nothing controls an observation."""


def pairs_dict(adjustment: Adjustment, scale: Scale) -> dict[str, Any]:
    """Measured and adjusted ``b_from_a`` of every pair with its statistics; a rotation keeps no translation.

    Sigmas of the adjusted translation are along the axes of b, those of its rotation and the residuals about and along
    the axes of a. ``misfit``: lengths of the residuals.
    """
    frames, pairs, factor = AdjustedFrames(adjustment), adjustment.survey.pairs, scale.factor
    found = {o.ids[0]: o for o in adjustment.other_residuals if o.kind == "pair"}
    tests = _tests([found[p.pair_id] for p in pairs if p.pair_id in found])
    ends = [(frame_text(p.a), frame_text(p.b)) for p in pairs]
    ref = {name: r for p, names in zip(pairs, ends, strict=True) for name, r in zip(names, (p.a, p.b), strict=True)}
    number = {name: i for i, name in enumerate(ref)}
    a, b = np.array([(number[i], number[j]) for i, j in ends]).T
    place = [frames.world_from(r) for r in ref.values()]
    world = motion_arrays([Pose3() if p is None else p for p in place], 6)
    now = world[b].inverse() @ world[a]
    sigmas, adjusted = _sigmas(adjustment, now.rotation, factor), _dicts(now)
    measured, is_pose = pair_arrays(pairs), [isinstance(p.b_from_a, Pose3) for p in pairs]
    out: dict[str, Any] = {}
    known = np.array([p is not None for p in place])
    rows = zip(pairs, ends, (known[a] & known[b]).tolist(), is_pose, _dicts(measured.motions), adjusted, strict=True)
    for pair, names, there, whole, before, after in rows:
        entry: dict[str, Any] = {"a": names[0], "b": names[1], "used": pair.used, "measured": before}
        if there:
            entry["adjusted"] = after | sigmas.get(pair.pair_id, {})
        if not whole:
            for form in ("measured", "adjusted"):
                entry.get(form, {}).pop("translation_mm", None)
        out[pair.pair_id] = entry | tests.get(pair.pair_id, {})
    return out


def _dicts(of: Motions) -> list[dict[str, Any]]:
    return pose_dicts(of.rotation, np.zeros((len(of), 3)) if of.translation is None else of.translation)


def _sigmas(adjustment: Adjustment, rotations: FloatArray, factor: float) -> dict[str, dict[str, Any]]:
    """Of the adjusted pairs by id, where there are covariances. rotations: (E, 3, 3) of all."""
    precision, out = adjustment.precision, dict[str, dict[str, Any]]()
    covs = precision.pair_covariances() if isinstance(precision, Precision) else {}
    names = [p.pair_id for p in adjustment.survey.pairs]
    for dim in (3, 6):
        rows = [e for e, name in enumerate(names) if name in covs and len(covs[name]) == dim]
        of = np.array([covs[names[e]] for e in rows]).reshape(-1, dim, dim)
        out |= zip([names[e] for e in rows], pair_sigmas(rotations[rows], of, factor), strict=True)
    return out


def _tests(pairs: Sequence[ObservationResidual]) -> dict[str, dict[str, Any]]:
    """Residuals, redundancy numbers and tests by id."""
    size = np.array([len(o.residual) for o in pairs], dtype=np.int64)
    v, redundancy, w = np.zeros((len(pairs), 6)), np.zeros((len(pairs), 6)), np.zeros((len(pairs), 6))
    for dim in (3, 6):
        rows = np.flatnonzero(size == dim)
        for into, name in ((v, "residual"), (redundancy, "redundancy"), (w, "standardized")):
            into[rows, :dim] = np.array([getattr(pairs[i], name) for i in rows.tolist()]).reshape(-1, dim)
    test, used = np.array([o.test for o in pairs], dtype=float), np.array([o.used for o in pairs], dtype=np.bool_)
    controlled = ~used | (redundancy.max(axis=1, initial=-np.inf) > UNCONTROLLED)
    p = np.where(controlled, chi2.sf(test, np.maximum(size, 1)), np.nan).tolist()
    turn, shift = ARCSEC_PER_RAD * v[:, :3], 1e3 * v[:, 3:]
    misfit, apart = (f * np.linalg.norm(x, axis=1) for f, x in ((ARCSEC_PER_RAD, v[:, :3]), (1e3, v[:, 3:])))
    test, turns, shifts = np.where(controlled, test, np.nan).tolist(), turn.tolist(), shift.tolist()
    numbers, ws, known = redundancy.tolist(), w.tolist(), controlled.tolist()
    out = {}
    for i, (o, k) in enumerate(zip(pairs, size.tolist(), strict=True)):
        entry: dict[str, Any] = {"residual_rotation_arcsec": turns[i], "misfit_arcsec": float(misfit[i])}
        if k == 6:
            entry |= {"residual_translation_mm": shifts[i], "misfit_mm": float(apart[i])}
        out[o.ids[0]] = entry | {
            "redundancy": numbers[i][:k], "standardized": ws[i][:k], "controlled": known[i], "test": test[i],
            "p_value": p[i],
        }  # fmt: skip
    return out
