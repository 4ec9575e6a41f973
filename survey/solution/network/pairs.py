"""Measured pairs after the adjustment: adjusted value, sigma, residual and test of each."""

import numpy as np
from gtsam import Pose3

from adjust.model.names import numbered
from adjust.model.observations import frame_text
from adjust.model.result import Adjustment, names_of
from adjust.model.survey import FloatArray, IntArray
from adjust.observations.pair_arrays import pair_arrays
from adjust.precision.precision import Precision
from adjust.spatial.rigid_motions import Motions
from adjust.testing.distributions import chi2
from survey.solution.frames import AdjustedFrames
from survey.solution.quantities import ARCSEC_PER_RAD, Scale, motion_columns, pair_sigmas
from survey.solution.records import Column, Form, Records, Tree

UNCONTROLLED = 1e-4
"""Redundancy number below which nothing controls an observation."""


def pairs_dict(adjustment: Adjustment, scale: Scale) -> Records:
    """Measured and adjusted ``b_from_a`` of every pair with its statistics; a rotation keeps no translation.

    Sigmas of the adjusted translation are along the axes of b, those of its rotation and the residuals about and along
    the axes of a. ``misfit``: lengths of the residuals.
    """
    pairs, (known, ends, now) = adjustment.survey.pairs, _adjusted(adjustment)
    covs, n_cov = _covariances(adjustment)
    tests, n_tested = _tests(adjustment)
    arrays = pair_arrays(pairs)
    measured, adjusted, used = _columns(arrays.motions), _columns(now), arrays.used

    def tree(rows: IntArray, is_pose: bool, there: bool, dim: int, size: int) -> Tree:
        kept = [key for key in measured if is_pose or key != "translation_mm"]
        out: dict[str, Column | Tree] = {end: [ends[k][i] for i in rows.tolist()] for k, end in enumerate("ab")}
        out |= {"used": used[rows], "measured": {key: measured[key][rows] for key in kept}}
        if there:
            sigmas = pair_sigmas(now.rotation[rows], covs[rows, :dim, :dim], scale.factor) if dim else {}
            out["adjusted"] = {key: adjusted[key][rows] for key in kept} | sigmas
        return out | _tested(tests, rows, size)

    alike = (arrays.is_pose, known, n_cov, n_tested)
    kinds, of_kind = numbered(zip(*(x.tolist() for x in alike), strict=True))
    rows = [np.flatnonzero(of_kind == k) for k in range(len(kinds))]
    forms = (Form(of, tree(of, *kind)) for of, kind in zip(rows, kinds, strict=True))
    return Records([p.pair_id for p in pairs], tuple(forms))


def _columns(of: Motions) -> dict[str, FloatArray]:
    return motion_columns(of.rotation, np.zeros((len(of), 3)) if of.translation is None else of.translation)


def _adjusted(adjustment: Adjustment) -> tuple[FloatArray, tuple[list[str], list[str]], Motions]:
    """Of which pairs (E,) both ends are known; names of these; the adjusted ``b_from_a``, nonsense for the others."""
    frames, survey = AdjustedFrames(adjustment), adjustment.survey
    number = {frame_text(ref): i for i, ref in enumerate(survey.pair_frames)}
    ends = [frame_text(p.a) for p in survey.pairs], [frame_text(p.b) for p in survey.pairs]
    a, b = (np.array([number[name] for name in names], dtype=np.int64) for names in ends)
    place = list(map(frames.world_from, survey.pair_frames))
    known = np.array([p is not None for p in place])
    at = np.array([(Pose3() if p is None else p).matrix() for p in place])
    world = Motions(at[:, :3, :3], at[:, :3, 3])
    return known[a] & known[b], ends, world[b].inverse() @ world[a]


def _covariances(adjustment: Adjustment) -> tuple[FloatArray, IntArray]:
    """Of the adjusted pairs (E, 6, 6), and how many components of them there are (E,), 0 where none."""
    precision, pairs = adjustment.precision, adjustment.survey.pairs
    if isinstance(precision, Precision):
        return precision.pair_covariances([p.pair_id for p in pairs])
    return np.zeros((len(pairs), 6, 6)), np.zeros(len(pairs), dtype=np.int64)


def _tests(adjustment: Adjustment) -> tuple[dict[str, FloatArray], IntArray]:
    """Residuals, redundancy numbers and tests (E, ...) of all pairs, and how many components they have (E,)."""
    found, row = adjustment.other_arrays, pair_rows(adjustment)
    size, ends = np.append(found.n_components, 0)[row], np.cumsum(found.n_components)
    columns = {"residual": found.residual, "redundancy": found.redundancies, "standardized": found.standardized}
    out = {name: np.zeros((len(row), 6)) for name in columns}
    for dim in (3, 6):
        rows = np.flatnonzero(size == dim)
        of = ends[row[rows], None] - np.arange(dim, 0, -1)
        for name, column in columns.items():
            out[name][rows, :dim] = column[of]
    test, used = np.append(found.test, np.nan)[row], np.append(found.used, False)[row]
    controlled = ~used | (out["redundancy"].max(axis=1, initial=-np.inf) > UNCONTROLLED)
    p = np.where(controlled, chi2.sf(test, np.maximum(size, 1)), np.nan)
    return out | {"controlled": controlled, "test": np.where(controlled, test, np.nan), "p_value": p}, size


def pair_rows(adjustment: Adjustment) -> IntArray:
    """Of every pair (E,) which of ``other_residuals`` it is, -1 where it is none."""
    row = {name[2][0]: i for i, name in enumerate(names_of(adjustment.other_residuals)) if name[0] == "pair"}
    return np.array([row.get(p.pair_id, -1) for p in adjustment.survey.pairs], dtype=np.int64)


def _tested(found: dict[str, FloatArray], rows: IntArray, size: int) -> dict[str, Column]:
    """What is said of the tests of pairs with so many components; nothing with none."""
    if not size:
        return {}
    out: dict[str, Column] = {}
    parts = (("rotation_arcsec", slice(0, 3), ARCSEC_PER_RAD), ("translation_mm", slice(3, 6), 1e3))
    for name, of, factor in parts[: size // 3]:
        v = found["residual"][rows, of]
        out[f"residual_{name}"] = factor * v
        out[f"misfit_{name.rpartition('_')[2]}"] = factor * np.linalg.norm(v, axis=1)
    out |= {name: found[name][rows, :size] for name in ("redundancy", "standardized")}
    return out | {name: found[name][rows] for name in ("controlled", "test", "p_value")}
