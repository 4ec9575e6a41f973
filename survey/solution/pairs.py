"""Measured pairs after the adjustment: adjusted value, sigma, residual and test of each."""

from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.distributions import chi2
from adjust.model.observations import FrameRef
from adjust.model.result import Adjustment, ObservationResidual
from adjust.model.survey import FloatArray
from adjust.precision.precision import Precision
from survey.solution.frames import AdjustedFrames
from survey.solution.quantities import ARCSEC_PER_RAD, Scale, pose_dict

UNCONTROLLED = 1e-4
"""Redundancy number below which nothing controls an observation."""


def pairs_dict(adjustment: Adjustment, scale: Scale) -> dict[str, Any]:
    """Measured and adjusted ``b_from_a`` of every pair with its statistics; a rotation keeps no translation.

    Sigmas of the adjusted translation are along the axes of b, those of its rotation and the residuals about and along
    the axes of a. ``misfit``: lengths of the residuals.
    """
    frames, out = AdjustedFrames(adjustment), {}
    precision = adjustment.precision
    covs = precision.pair_covariances() if isinstance(precision, Precision) else {}
    found = {o.ids[0]: o for o in adjustment.other_residuals if o.kind == "pair"}
    for pair in adjustment.survey.pairs:
        a, b = frames.world_from(pair.a), frames.world_from(pair.b)
        is_pose = isinstance(pair.b_from_a, Pose3)
        measured = pair.b_from_a if isinstance(pair.b_from_a, Pose3) else Pose3(pair.b_from_a, np.zeros(3))
        entry: dict[str, Any] = {"a": _frame_text(pair.a), "b": _frame_text(pair.b), "used": pair.used}
        entry["measured"] = pose_dict(measured)
        if a is not None and b is not None:
            adjusted = b.between(a)
            entry["adjusted"] = pose_dict(adjusted) | pair_sigmas(adjusted, covs.get(pair.pair_id), scale.factor)
        if not is_pose:
            for form in ("measured", "adjusted"):
                entry.get(form, {}).pop("translation_mm", None)
        if pair.pair_id in found:
            entry |= _statistics(found[pair.pair_id])
        out[pair.pair_id] = entry
    return out


def _frame_text(frame: FrameRef) -> str:
    text = frame.kind + (f":{frame.frame_id}" if frame.frame_id else "")
    return f"{text}@{frame.epoch_id}" if frame.epoch_id else text


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


def _statistics(o: ObservationResidual) -> dict[str, Any]:
    v, k = np.asarray(o.residual), len(o.residual)
    out: dict[str, Any] = {
        "residual_rotation_arcsec": (ARCSEC_PER_RAD * v[:3]).tolist(),
        "misfit_arcsec": float(ARCSEC_PER_RAD * np.linalg.norm(v[:3])),
    }
    if k == 6:
        out |= {"residual_translation_mm": (1e3 * v[3:]).tolist(), "misfit_mm": float(1e3 * np.linalg.norm(v[3:]))}
    controlled = not o.used or float(np.max(o.redundancy)) > UNCONTROLLED
    return out | {
        "redundancy": np.asarray(o.redundancy).tolist(),
        "standardized": np.asarray(o.standardized).tolist(),
        "controlled": controlled,
        "test": float(o.test) if controlled else float("nan"),
        "p_value": float(chi2.sf(o.test, k)) if controlled else float("nan"),
    }
