"""Measured pairs after the adjustment: adjusted value, sigma, residual and test of each."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.model.observations import frame_text
from adjust.model.result import Adjustment, ObservationResidual
from adjust.model.survey import FloatArray
from adjust.precision.precision import Precision
from adjust.testing.distributions import chi2
from survey.solution.frames import AdjustedFrames
from survey.solution.quantities import ARCSEC_PER_RAD, Scale, pose_dict

UNCONTROLLED = 1e-4
"""Redundancy number below which nothing controls an observation."""


def pairs_dict(adjustment: Adjustment, scale: Scale) -> dict[str, Any]:
    """Measured and adjusted ``b_from_a`` of every pair with its statistics; a rotation keeps no translation.

    Sigmas of the adjusted translation are along the axes of b, those of its rotation and the residuals about and along
    the axes of a. ``misfit``: lengths of the residuals.
    """
    frames, out = AdjustedFrames(adjustment), dict[str, Any]()
    precision = adjustment.precision
    covs = precision.pair_covariances() if isinstance(precision, Precision) else {}
    found = {o.ids[0]: o for o in adjustment.other_residuals if o.kind == "pair"}
    tests = _tests([found[p.pair_id] for p in adjustment.survey.pairs if p.pair_id in found])
    refs = dict.fromkeys(r for p in adjustment.survey.pairs for r in (p.a, p.b))
    place, text = {r: frames.world_from(r) for r in refs}, {r: frame_text(r) for r in refs}
    for pair in adjustment.survey.pairs:
        a, b = place[pair.a], place[pair.b]
        is_pose = isinstance(pair.b_from_a, Pose3)
        measured = pair.b_from_a if isinstance(pair.b_from_a, Pose3) else Pose3(pair.b_from_a, np.zeros(3))
        entry: dict[str, Any] = {"a": text[pair.a], "b": text[pair.b], "used": pair.used}
        entry["measured"] = pose_dict(measured)
        if a is not None and b is not None:
            adjusted = b.between(a)
            entry["adjusted"] = pose_dict(adjusted) | pair_sigmas(adjusted, covs.get(pair.pair_id), scale.factor)
        if not is_pose:
            for form in ("measured", "adjusted"):
                entry.get(form, {}).pop("translation_mm", None)
        out[pair.pair_id] = entry | tests.get(pair.pair_id, {})
    return out


def pair_sigmas(adjusted: Pose3, cov: FloatArray | None, factor: float = 1.0) -> dict[str, Any]:
    """Sigmas of ``b_from_a`` times factor: rotation about the axes of a, translation along the axes of b.

    cov: (6, 6) or (3, 3) in the tangent in frame a; without it there are none.
    """
    if cov is None:
        return {}
    sigma = factor * np.sqrt(np.clip(np.diag(cov), 0.0, None))
    out = {"sigma_rotation_arcsec": (ARCSEC_PER_RAD * sigma[:3]).tolist()}
    if len(cov) == 6:
        R = adjusted.rotation().matrix()
        along = np.sqrt(np.clip(np.diag(R @ cov[3:, 3:] @ R.T), 0.0, None))
        out["sigma_translation_mm"] = (1e3 * factor * along).tolist()
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
