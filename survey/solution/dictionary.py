"""The solution of a survey as one dictionary of plain values: what ``solution.json`` holds and reports print."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from adjust.epochs.states import datum_carriers, open_directions
from adjust.model.result import Adjustment, Estimate, GroupSummary, ImageResiduals
from adjust.model.survey import FloatArray, IntArray
from adjust.precision.precision import in_conditions
from adjust.testing.distributions import norm
from adjust.testing.significance import Significance, significance_of_drift, significances
from survey.project.detected import DetectedImage
from survey.project.project import LeftOut
from survey.solution.instruments import instrument_entries
from survey.solution.left_out import left_out_dict
from survey.solution.plain import plain as plain
from survey.solution.quantities import Scale, SigmaKind, point_entry, pose_entries, scale_of, vector_entry
from survey.solution.statistics import Statistics
from survey.solution.statistics_dict import statistics_dict
from survey.solution.verdict import findings, fit_of, suspects, verdict

CORRELATION_LIMIT = 0.95
# parameters for which "zero" is no sensible hypothesis
_NEVER_ZERO = {"fx", "fy", "u0", "v0", "c", "xp", "yp"}
_JSON = json.JSONEncoder(ensure_ascii=False, allow_nan=False)
PoseOf = Callable[[tuple[str, ...], str], dict[str, Any]]
CONVENTIONS = {
    "poses": "a_from_b takes coordinates in b to coordinates in a; camera x right, y down, z forward",
    "translation_mm": "origin of b in a; sigma_translation_mm along the axes of a",
    "rotation_euler_xyz_deg": "R = Rz(z) Ry(y) Rx(x); sigma_rotation_arcsec: small rotations about the axes of b",
    "residuals": "adjusted (predicted) minus observed",
    "image": "the centre of the first pixel is (0, 0)",
}


@dataclass(frozen=True)
class RunInfo:
    """What was run: everything in a result file that the adjustment itself does not know.

    date: time stamp, ISO 8601. seconds: duration per step; printed, but in no file, so that equal input gives equal
    files. sigmas: how sigmas of unknowns are given. identification: what the project says of itself (who, where, with
    what), in its order. command: as it can be given again. images: by camera/epoch, with their hashes. left_out,
    n_left_out, n_unused_in_files: as of :class:`survey.project.Project`.
    """

    folder: str
    title: str
    input_hashes: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    date: str = ""
    seconds: Mapping[str, float] = field(default_factory=dict)
    sigmas: SigmaKind = "a_posteriori"
    identification: tuple[tuple[str, str], ...] = ()
    command: str = ""
    images: Mapping[str, DetectedImage] = field(default_factory=dict)
    left_out: tuple[LeftOut, ...] = ()
    n_left_out: int = 0
    n_unused_in_files: int = 0


def solution_dict(adjustment: Adjustment, run: RunInfo, found: Statistics | None = None) -> dict[str, Any]:
    """The whole solution as plain values, floats in full, None where there is no number; ``found``: its statistics."""
    scale = scale_of(adjustment, run.sigmas)
    poses = _poses(adjustment, scale)
    solution: dict[str, Any] = plain(
        {
            "format": 1,
            "summary": _summary(adjustment, run, scale, found),
            "conventions": CONVENTIONS,
            "cameras": _cameras(adjustment, poses, scale),
            "stations": _stations(adjustment, poses),
            "points": _points(adjustment, scale),
            "tables": _tables(adjustment, poses, scale),
            "targets": _targets(adjustment, poses, scale),
            "pairs": _pairs(adjustment, scale),
            **instrument_entries(adjustment, scale),
            **_network(adjustment),
            **_free_datum(adjustment),
            "groups": {g.group: _group(g) for g in adjustment.groups},
            **left_out_dict(adjustment, run.left_out, run.n_left_out, run.n_unused_in_files),
            "warnings": _warnings(adjustment, found),
            **({"diagnosis": adjustment.diagnosis.told()} if adjustment.diagnosis is not None else {}),
            **(statistics_dict(adjustment, found, scale) if found is not None else {}),
            "inputs": {
                "folder": run.folder,
                "identification": dict(run.identification),
                "command": run.command,
                "hashes": dict(run.input_hashes),
                "images": {
                    name: {"file": i.file, "sha256": i.sha256, "points": i.status, "n_image_points": i.n_image_points,
                           "n_spots": i.n_spots}
                    for name, i in run.images.items()
                },
                "options": dict(run.options),
                "versions": dict(run.versions),
                "date": run.date,
            },
        }
    )
    return solution


def _warnings(adjustment: Adjustment, found: Statistics | None) -> list[str]:
    """Causes that were tried first, then what tests of parts found, then the rest."""
    tried = len(adjustment.diagnosis.lines) if adjustment.diagnosis is not None else 0
    return [*adjustment.warnings[:tried], *findings(found.consistency if found else None),
            *adjustment.warnings[tried:]]  # fmt: skip


def _free_datum(adjustment: Adjustment) -> dict[str, Any]:
    """Motions of the whole (t, rotation vector, ln scale) that the observations leave open, and what carries them."""
    directions = open_directions(adjustment)
    if not directions.shape[1]:
        return {}
    carriers = ["/".join(name) for name in datum_carriers(adjustment)]
    return {"free_datum": {"open_motions": directions.T.tolist(), "carried_by": carriers}}


def _summary(adjustment: Adjustment, run: RunInfo, scale: Scale, statistics: Statistics | None) -> dict[str, Any]:
    found, test = suspects(adjustment), adjustment.global_test
    n_unmet = sum(not v.met for v in statistics.verdicts) if statistics is not None else 0
    tested = statistics.consistency if statistics is not None else None
    level, reason = verdict(adjustment, found, n_unmet, tested)
    return {
        "title": run.title,
        "verdict": level,
        "reason": reason,
        "fit": fit_of(adjustment, tested),
        "sigma0": adjustment.sigma0 if adjustment.redundancy > 0 else None,
        "redundancy": adjustment.redundancy,
        "n_observations": adjustment.n_observations,
        "n_unknowns": adjustment.n_unknowns,
        "datum": adjustment.survey.datum.kind,
        "datum_defect": adjustment.datum_defect,
        "n_tolerances_not_met": n_unmet,
        "converged": adjustment.converged,
        "iterations": adjustment.iterations,
        "last_step_sigmas": adjustment.max_step,
        "sigmas": scale.sigmas,
        "sigma_factor": scale.factor,
        "omega": adjustment.omega,
        "global_test": test
        and {
            "omega": test.omega,
            "redundancy": test.redundancy,
            "alpha": test.alpha,
            "lower": test.lower,
            "upper": test.upper,
            "passed": test.passed,
            "status": test.status,
        },
        "suspects": {
            "alpha": found.alpha,
            "image_test_limit": found.image_limit,
            "standardized_limit": found.w_limit,
            "n_image_points": found.n_image,
            "n_other": found.n_other,
            "n_not_used": found.n_not_used,
        },
    }


def _group(group: GroupSummary) -> dict[str, Any]:
    """``deviation``: of omega from its expectation r, in units of its own sigma sqrt(2 r), as chi-square has it."""
    factor, r = group.factor, group.redundancy
    return {
        "n_observations": group.n_observations,
        "redundancy": group.redundancy,
        "omega": group.omega,
        "variance_factor": factor,
        "sigma_scale": float(np.sqrt(factor)) if factor >= 0.0 else float("nan"),
        "deviation": (group.omega - r) / float(np.sqrt(2.0 * r)) if factor >= 0.0 else float("nan"),
    }


def correlated(estimate: Estimate) -> list[dict[str, Any]]:
    """Pairs of components of one parameter with |correlation| above 95 %, strongest first."""
    sigmas = np.sqrt(np.clip(np.diag(estimate.cov), 0.0, None))
    safe = np.where(sigmas > 0.0, sigmas, np.inf)
    rho = estimate.cov / np.outer(safe, safe)
    pairs = [
        (float(rho[i, j]), i, j)
        for i in range(len(sigmas))
        for j in range(i)
        if abs(rho[i, j]) > CORRELATION_LIMIT and "tied" not in (estimate.status[i], estimate.status[j])
    ]
    names = estimate.components
    return [
        {"a": names[j], "b": names[i], "correlation": value} for value, i, j in sorted(pairs, key=lambda x: -abs(x[0]))
    ]


def _lens(estimate: Estimate, model: str, scale: Scale) -> dict[str, Any]:
    entry = {"model": model} | vector_entry(estimate, scale)
    sigmas = scale.factor * np.sqrt(np.clip(np.diag(estimate.cov), 0.0, None))
    values = np.asarray(estimate.value, dtype=float)
    ratios = {
        name: float(abs(value) / sigma)
        for name, value, sigma in zip(estimate.components, values, sigmas, strict=True)
        if sigma > 0.0 and name not in _NEVER_ZERO
    }
    limit = float(norm.isf(0.025))
    entry["value_over_sigma"] = ratios
    entry["not_significant"] = [name for name, ratio in ratios.items() if ratio < limit]
    entry["correlations_over_95_percent"] = correlated(estimate)
    return entry


def _cameras(adjustment: Adjustment, pose: PoseOf, scale: Scale) -> dict[str, Any]:
    sums = _sums_of_blocks(adjustment.image_residuals)
    out: dict[str, Any] = {}
    for camera in adjustment.survey.cameras:
        entry: dict[str, Any] = {"station": camera.station_id, "image_size_px": list(camera.image_size)}
        lens = adjustment.estimates.get(("lens", camera.camera_id))
        if lens is not None:
            entry["lens"] = _lens(lens, camera.lens.model, scale)
        if camera.lens.drift is not None:
            entry["lens_drift"] = _drift(adjustment, camera.camera_id, scale)
        entry |= pose(("station_from_camera", camera.camera_id), "station_from_camera")
        out[camera.camera_id] = entry | _images(adjustment, camera.camera_id, sums)
    return out


def _images(adjustment: Adjustment, camera_id: str, sums: tuple[IntArray, FloatArray]) -> dict[str, Any]:
    """Number of used image points and RMS residual, of the camera and of each of its images."""
    blocks = adjustment.survey.image_blocks
    mine = [i for i, b in enumerate(blocks) if b.camera_id == camera_id]
    per_image: dict[str, list[float]] = {}
    for i, n, squares in zip(mine, *(x[mine].tolist() for x in sums), strict=True):
        of_image = per_image.setdefault(blocks[i].epoch_id, [0, 0.0])
        of_image[0], of_image[1] = of_image[0] + n, of_image[1] + squares
    n_all, squares_of_all = (sum(x) for x in zip((0, 0.0), *per_image.values(), strict=True))
    return {
        "n_images": len(per_image),
        "n_image_points": n_all,
        "rms_residual_px": _rms(n_all, squares_of_all),
        "images": {e: {"n_image_points": n, "rms_residual_px": _rms(n, s)} for e, (n, s) in per_image.items()},
    }


def _sums_of_blocks(found: ImageResiduals) -> tuple[IntArray, FloatArray]:
    """Points in use and their residuals squared, of every image block (B,)."""
    squares = np.where(found.used, (found.residuals**2).sum(axis=1), 0.0)
    B = len(found.block_ptr) - 1
    block = np.repeat(np.arange(B), np.diff(found.block_ptr))
    n: IntArray = np.bincount(block[found.used], minlength=B)
    return n, np.bincount(block, squares, B).astype(np.float64)


def _rms(n: float, squares: float) -> float:
    """Root mean square over both coordinates of n points."""
    return math.sqrt(squares / (2 * n)) if n else math.nan


def _poses(adjustment: Adjustment, scale: Scale) -> PoseOf:
    """What is said of a pose: under ``key`` and, where it moves, under ``epochs``; nothing where it is no unknown."""
    moving: dict[tuple[str, ...], dict[str, dict[str, Any]]] = {}
    entries = pose_entries(adjustment.estimates.values(), scale)
    for name, entry in entries.items():
        if len(name) == 3:
            moving.setdefault(name[:2], {})[name[2]] = entry

    def pose(name: tuple[str, ...], key: str) -> dict[str, Any]:
        epochs = {epoch: {key: entry} for epoch, entry in moving.get(name, {}).items()}
        return ({key: entries[name]} if name in entries else {}) | ({"epochs": epochs} if epochs else {})

    return pose


def _stations(adjustment: Adjustment, pose: PoseOf) -> dict[str, Any]:
    out = {}
    for station in adjustment.survey.stations:
        name = station.station_id
        entry = {"motion": station.motion} | ({"table": station.table_id} if station.table_id else {})
        entry |= pose(("mount_from_station", name), "mount_from_station")
        out[name] = entry | pose(("world_from_station", name), "world_from_station")
    return out


def _points(adjustment: Adjustment, scale: Scale) -> dict[str, Any]:
    return {n[1]: point_entry(e, scale) for n, e in adjustment.estimates.items() if n[0] == "point"}


def _tables(adjustment: Adjustment, pose: PoseOf, scale: Scale) -> dict[str, Any]:
    out = {}
    for table in adjustment.survey.tables:
        name = table.table_id
        entry: dict[str, Any] = {"axes": list(table.axes)}
        entry |= pose(("world_from_table", name), "world_from_table")
        geometry = adjustment.estimates.get(("table_geometry", name))
        if geometry is not None:
            entry["geometry"] = _terms(adjustment, geometry, scale)
        angles = {n[2]: e for n, e in adjustment.estimates.items() if n[:2] == ("table_angles", name)}
        out[name] = entry | {"epochs": {epoch: vector_entry(e, scale) for epoch, e in angles.items()}}
    return out


def _drift(adjustment: Adjustment, camera_id: str, scale: Scale) -> dict[str, Any]:
    """How a lens changes: by the epoch at which a block begins, or per kelvin; and whether it changes at all."""
    found = {n: e for n, e in adjustment.estimates.items() if n[:2] == ("lens_drift", camera_id)}
    test = significance_of_drift(adjustment, camera_id, scale.sigmas == "a_posteriori")
    parts = {n[2] if len(n) > 2 else "per_kelvin": vector_entry(e, scale) for n, e in found.items()}
    return {"changes": parts, "significance": {} if test is None else {test.term: _test(test)}}


def _test(s: Significance) -> dict[str, Any]:
    return {"components": list(s.components), "statistic": s.statistic, "freedom": list(s.freedom), "p_value": s.p,
            "significant": s.significant}  # fmt: skip


def _terms(adjustment: Adjustment, estimate: Estimate, scale: Scale) -> dict[str, Any]:
    """The components, and the tests of those that may be zero."""
    found = significances(adjustment, estimate, scale.sigmas == "a_posteriori")
    tests = {s.term: _test(s) for s in found}
    return vector_entry(estimate, scale) | ({"significance": tests} if tests else {})


def _targets(adjustment: Adjustment, pose: PoseOf, scale: Scale) -> dict[str, Any]:
    out = {}
    for target in adjustment.survey.targets:
        name = target.target_id
        key = "station_from_target" if target.station_id else "world_from_target"
        entry: dict[str, Any] = {"n_points": len(target.point_ids), "motion": target.motion}
        entry |= {"station": target.station_id} if target.station_id else {}
        entry |= pose(("carrier_from_target", name), key)
        warp = adjustment.estimates.get(("warp", name))
        out[name] = entry | ({"warp": _terms(adjustment, warp, scale)} if warp is not None else {})
    return out


def _pairs(adjustment: Adjustment, scale: Scale) -> dict[str, Any]:
    if not adjustment.survey.pairs:
        return {}
    from survey.solution.pairs import pairs_dict  # here: as above

    return pairs_dict(adjustment, scale)


def _network(adjustment: Adjustment) -> dict[str, Any]:
    """What the pairs can tell, and how well their loops close; nothing where there are no pairs."""
    survey = adjustment.survey
    if not survey.pairs:
        return {}
    # here: a survey without pairs is reported without it
    from survey.solution.loops import closures_dict, loops_after, loops_dict, network_dict, pair_loops, pair_network

    loops = pair_loops(survey)
    if loops is None:
        return {}
    left_out = [p.pair_id for p in survey.pairs if not p.used]
    how = "conditions" if in_conditions(adjustment) else "poses"
    listed = loops_dict(loops, left_out, loops_after(adjustment, loops), survey.pair_form, how)
    closures = {"closures": closures_dict(adjustment)} if survey.closures else {}
    return {"network": network_dict(pair_network(survey)), "loops": listed, **closures}


def solution_json(solution: Mapping[str, Any]) -> str:
    """JSON with one line per entry of a mapping and lists of numbers kept on one line; floats by repr."""
    return _lines(solution, 0) + "\n"


def _lines(value: Any, depth: int) -> str:
    kind = type(value)
    if kind is float:
        return _one(value)
    if kind is dict and value:
        before = " " * (depth + 1)
        inner = ",\n".join([f"{before}{_key(k)}: {_lines(v, depth + 1)}" for k, v in value.items()])
        return f"{{\n{inner}\n{' ' * depth}}}"
    if kind is not list:
        return _one(value)
    try:
        text = ", ".join(map(float.__repr__, value))
    except TypeError:
        text = "n"
    if "n" not in text:  # not even of nan or inf
        return f"[{text}]"
    kinds = set(map(type, value))
    if dict in kinds or str in kinds:
        inner = ",\n".join([" " * (depth + 1) + _lines(v, depth + 1) for v in value])
        return f"[\n{inner}\n{' ' * depth}]"
    return f"[{', '.join(map(_one, value))}]"


def _one(value: Any) -> str:
    kind = type(value)
    if kind is float and math.isfinite(value):
        return float.__repr__(value)
    if kind is int:
        return int.__repr__(value)
    return json.encoder.encode_basestring(value) if kind is str else _JSON.encode(value)


_key = lru_cache(json.encoder.encode_basestring)
