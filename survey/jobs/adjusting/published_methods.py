"""The published step-by-step methods on a project, beside its joint adjustment, number by number with both sigmas.

Two methods: the calibration of a camera head on a two-axis table, and the iteration of corrections of Euler angles over
the loops of measured pairs (``adjust.published``). Those that a project has the observations for
are run; of the others it is said what is missing.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gtsam import Rot3

from adjust.model.errors import NotConvergedError, SurveyError
from adjust.model.result import Adjustment
from adjust.published import ComparedPose, compare_head
from adjust.published.relay import PaperOptions, PaperSolution, adjusted_covariances, euler_covariances, paper_iteration
from adjust.relay.network import network_from_pairs
from survey.folder.plain import plain
from survey.solution.network.pairs import pairs_dict
from survey.solution.quantities import ARCSEC_PER_RAD, Scale, sigmas_in

MOST_PAIRS = 400  # its equations are dense: 3 corrections a pair, 9 equations a loop


def published_dict(adjustment: Adjustment, scale: Scale) -> dict[str, object]:
    """``head`` and ``pairs`` of what was run, ``not_run`` with the reason for the others; plain values.

    Sigmas are scaled as those of the joint adjustment. Raises SurveyError naming what is missing where neither method
    can be run.
    """
    out: dict[str, object] = {}
    reasons: dict[str, str] = {}
    for name, run in (("head", _head), ("pairs", _pairs)):
        try:
            out[name] = run(adjustment, scale)
        except (SurveyError, NotConvergedError) as error:
            reasons[name] = str(error)
    if not out:
        raise SurveyError(
            "the published methods cannot be run on this project.\n"
            f"Steps for a head on a table: {reasons['head']}\nIteration on measured pairs: {reasons['pairs']}\n"
            "Adjust without --method published, or add what is missing"
        )
    found: dict[str, object] = plain(out | {"not_run": reasons})
    return found


def _head(adjustment: Adjustment, scale: Scale) -> dict[str, object]:
    found = compare_head(adjustment)
    entries = {"/".join(pose.name): _components(pose, scale.factor) for pose in found.poses}
    return {"main_camera": found.main_camera, "notes": list(found.notes), "poses": entries}


def _components(pose: ComparedPose, factor: float) -> dict[str, Any]:
    """By component: turns about the axes on the right in arcsec, their values as Euler angles in deg; mm."""
    angles = [np.degrees(p.rotation().xyz()) for p in (pose.published, pose.joint)]
    places = [1e3 * p.translation() for p in (pose.published, pose.joint)]
    out = {}
    for i, name in enumerate(("rx", "ry", "rz", "tx", "ty", "tz")):
        unit, scale = ("arcsec", ARCSEC_PER_RAD) if i < 3 else ("mm", 1e3)
        values = [a[i] for a in angles] if i < 3 else [p[i - 3] for p in places]
        sigma, joint = factor * pose.sigma[i], factor * pose.joint_sigma[i]
        value_unit = "deg" if i < 3 else "mm"
        out[name] = {
            f"published_{value_unit}": values[0],
            f"joint_{value_unit}": values[1],
            f"difference_{unit}": scale * pose.difference[i],
            f"claimed_sigma_{unit}": scale * factor * pose.claimed[i],
            f"published_sigma_{unit}": scale * sigma,
            f"joint_sigma_{unit}": scale * joint,
            "sigma_ratio": sigma / joint if joint > 0.0 else float("nan"),
        }
    return out


def _pairs(adjustment: Adjustment, scale: Scale) -> dict[str, object]:
    used = [p for p in adjustment.survey.pairs if p.used]
    if not used:
        raise SurveyError("they need measured pairs in use: observations/pairs.csv")
    if len(used) > MOST_PAIRS:
        raise SurveyError(f"their equations are dense; {len(used)} pairs are more than {MOST_PAIRS}")
    network = network_from_pairs(used, rotations_only=True)
    weights = euler_covariances(network)
    runs = {"weighted": PaperOptions(euler_cov=weights), "equal_weights": PaperOptions()}
    found = {name: paper_iteration(network, options) for name, options in runs.items()}
    if not len(found["weighted"].basis):
        raise SurveyError("no loop of measured pairs; a pair that closes none has nothing to be adjusted to")
    covs = {name: adjusted_covariances(found[name], runs[name], network.cov) for name in runs}
    joint = pairs_dict(adjustment, scale)
    entries = {
        pair.pair_id: _pair_entry(e, found, covs, joint[pair.pair_id].get("adjusted", {}), scale.factor)
        for e, pair in enumerate(used)
    }
    steps = {name: {"iterations": x.iterations, "misclosure_left_arcsec": ARCSEC_PER_RAD * x.misclosure}
             for name, x in found.items()}  # fmt: skip
    notes = []
    if any(hasattr(p.b_from_a, "translation") for p in used):
        notes.append("the published iteration adjusts the rotations alone; the joint adjustment takes whole poses")
    return {"n_loops": len(found["weighted"].basis), "steps": steps, "notes": notes, "pairs": entries}


def _pair_entry(
    e: int, found: Mapping[str, PaperSolution], covs: Mapping[str, Any], joint: Mapping[str, Any], factor: float
) -> dict[str, Any]:
    q = joint.get("rotation_quaternion_wxyz")
    adjusted = None if q is None else Rot3.Quaternion(*q)
    out: dict[str, Any] = {}
    for name, solution in found.items():
        rotation = Rot3(solution.b_from_a.rotation[e])
        sigma = ARCSEC_PER_RAD * factor * sigmas_in(covs[name][e])
        out[name] = {"rotation_euler_xyz_deg": np.degrees(rotation.xyz()), "sigma_rotation_arcsec": sigma}
        if adjusted is not None:
            out[name]["difference_arcsec"] = ARCSEC_PER_RAD * Rot3.Logmap(adjusted.between(rotation))
    out["joint"] = {k: joint.get(k) for k in ("rotation_euler_xyz_deg", "sigma_rotation_arcsec")}
    return out
