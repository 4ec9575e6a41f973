"""The solution of a survey as one dictionary of plain values: what ``solution.json`` holds and reports print."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adjust.epochs.states import datum_carriers, open_directions
from adjust.model.result import Adjustment, Estimate, GroupSummary, ImageResiduals, ParameterName
from adjust.model.survey import FloatArray, IntArray
from adjust.precision.precision import in_conditions
from adjust.statistics.score import SharedLens, shared_lenses
from adjust.testing.distributions import norm
from adjust.testing.significance import Significance, significance_of_changes, significances
from survey.folder.plain import attributes, plain
from survey.project.detected import DetectedImage
from survey.project.project import LeftOut
from survey.solution import quantities as q
from survey.solution.instruments import instrument_entries
from survey.solution.left_out import left_out_dict
from survey.solution.records import Form, Records
from survey.solution.statistics import Statistics
from survey.solution.statistics_dict import statistics_dict
from survey.solution.verdict import findings, fit_of, suspects, verdict

CORRELATION_LIMIT = 0.95
# parameters for which "zero" is no sensible hypothesis
_NEVER_ZERO = {"fx", "fy", "u0", "v0", "c", "xp", "yp"}
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
    sigmas: q.SigmaKind = "a_posteriori"
    identification: tuple[tuple[str, str], ...] = ()
    command: str = ""
    images: Mapping[str, DetectedImage] = field(default_factory=dict)
    left_out: tuple[LeftOut, ...] = ()
    n_left_out: int = 0
    n_unused_in_files: int = 0


def solution_dict(adjustment: Adjustment, run: RunInfo, found: Statistics | None = None) -> dict[str, Any]:
    """The whole solution as plain values, floats in full, None where there is no number; ``found``: its statistics."""
    if found is not None:
        return with_statistics(solution_dict(adjustment, run), adjustment, run, found)
    scale = q.scale_of(adjustment, run.sigmas)
    columns = q.pose_columns(adjustment.estimates.values(), scale)
    poses = _poses(columns)
    solution: dict[str, Any] = plain(
        {
            "format": 1,
            "summary": _summary(adjustment, run, scale, None),
            "conventions": CONVENTIONS,
            "cameras": _cameras(adjustment, poses, scale),
            "stations": _stations(adjustment, poses, columns, scale),
            "points": _points(adjustment, scale),
            "tables": _tables(adjustment, poses, scale),
            "targets": _targets(adjustment, poses, scale),
            "pairs": _pairs(adjustment, scale),
            **instrument_entries(adjustment, scale),
            **_network(adjustment),
            **_free_datum(adjustment),
            "groups": {g.group: _group(g) for g in adjustment.groups},
            **left_out_dict(adjustment, run.left_out, run.n_left_out, run.n_unused_in_files),
            "warnings": list(adjustment.warnings),
            **({"diagnosis": adjustment.diagnosis.told()} if adjustment.diagnosis is not None else {}),
            "inputs": {
                "folder": run.folder,
                "identification": dict(run.identification),
                "command": run.command,
                "hashes": dict(run.input_hashes),
                "images": {
                    name: attributes(i, "file", "sha256") | {"points": i.status}
                    | attributes(i, "n_image_points", "n_spots")
                    for name, i in run.images.items()
                },
                "options": dict(run.options),
                "versions": dict(run.versions),
                "date": run.date,
            },
        }
    )
    return solution


def with_statistics(
    solution: dict[str, Any], adjustment: Adjustment, run: RunInfo, found: Statistics
) -> dict[str, Any]:
    """The solution of :func:`solution_dict`, with its statistics before what went in, and judged by them.

    Its warnings: causes that were tried first, then what tests of parts found, then the rest.
    """
    scale, warnings = q.scale_of(adjustment, run.sigmas), adjustment.warnings
    tried = len(adjustment.diagnosis.lines) if adjustment.diagnosis is not None else 0
    told: dict[str, Any] = plain({
        "summary": _summary(adjustment, run, scale, found),
        "warnings": [*warnings[:tried], *findings(found.consistency), *warnings[tried:]],
        **statistics_dict(adjustment, found, scale),
    })  # fmt: skip
    out, names = solution | told, list(solution)
    return out | {name: out.pop(name) for name in names[names.index("inputs") :]}


def _free_datum(adjustment: Adjustment) -> dict[str, Any]:
    """Motions of the whole (t, rotation vector, ln scale) that the observations leave open, and what carries them."""
    directions = open_directions(adjustment)
    if not directions.shape[1]:
        return {}
    carriers = ["/".join(name) for name in datum_carriers(adjustment)]
    return {"free_datum": {"open_motions": directions.T.tolist(), "carried_by": carriers}}


def _summary(adjustment: Adjustment, run: RunInfo, scale: q.Scale, statistics: Statistics | None) -> dict[str, Any]:
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
        **attributes(adjustment, "redundancy", "n_observations", "n_unknowns"),
        "datum": adjustment.survey.datum.kind,
        "datum_defect": adjustment.datum_defect,
        "n_tolerances_not_met": n_unmet,
        **attributes(adjustment, "converged", "iterations"),
        "last_step_sigmas": adjustment.max_step,
        "sigmas": scale.sigmas,
        "sigma_factor": scale.factor,
        "omega": adjustment.omega,
        "global_test": test
        and attributes(test, "omega", "redundancy", "alpha", "lower", "upper", "passed", "status"),
        "suspects": {
            "alpha": found.alpha,
            "image_test_limit": found.image_limit,
            "standardized_limit": found.w_limit,
            "n_image_points": found.n_image,
            **attributes(found, "n_other", "n_not_used"),
        },
    }


def _group(group: GroupSummary) -> dict[str, Any]:
    """``deviation``: of omega from its expectation r, in units of its own sigma sqrt(2 r), as chi-square has it."""
    factor, r = group.factor, group.redundancy
    return {
        **attributes(group, "n_observations", "redundancy", "omega"),
        "variance_factor": factor,
        "sigma_scale": float(np.sqrt(factor)) if factor >= 0.0 else float("nan"),
        "deviation": (group.omega - r) / float(np.sqrt(2.0 * r)) if factor >= 0.0 else float("nan"),
    }


def correlated(estimate: Estimate) -> list[dict[str, Any]]:
    """Pairs of components of one parameter with |correlation| above 95 %, strongest first."""
    rho = q.correlations_in(estimate.cov)
    pairs = [
        (float(rho[i, j]), i, j)
        for i in range(len(rho))
        for j in range(i)
        if abs(rho[i, j]) > CORRELATION_LIMIT and "tied" not in (estimate.status[i], estimate.status[j])
    ]
    names = estimate.components
    return [
        {"a": names[j], "b": names[i], "correlation": value} for value, i, j in sorted(pairs, key=lambda x: -abs(x[0]))
    ]


def _lens(estimate: Estimate, model: str, scale: q.Scale) -> dict[str, Any]:
    entry = {"model": model} | q.vector_entry(estimate, scale)
    sigmas = q.sigmas_of(estimate, scale)
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


def _cameras(adjustment: Adjustment, pose: PoseOf, scale: q.Scale) -> dict[str, Any]:
    sums = _sums_of_blocks(adjustment.image_residuals)
    out: dict[str, Any] = {}
    shared = {s.camera: s for s in shared_lenses(adjustment, scale.sigmas == "a_posteriori")}
    for camera in adjustment.survey.cameras:
        entry: dict[str, Any] = {"station": camera.station_id, "image_size_px": list(camera.image_size)}
        lens = adjustment.estimates.get(("lens", camera.camera_id))
        if lens is not None:
            entry["lens"] = _lens(lens, camera.lens.model, scale)
        if camera.lens.drift is not None:
            entry["lens_drift"] = _changes(adjustment, camera.camera_id, "lens_drift", "changes", scale)
        if camera.lens.crops:
            entry["lens_crop"] = _changes(adjustment, camera.camera_id, "lens_crop", "crops", scale)
        if camera.camera_id in shared:
            entry["lens_shared"] = _shared(shared[camera.camera_id], scale)
        entry |= _clock(adjustment, ("camera_clock", camera.camera_id), scale)
        entry |= pose(("station_from_camera", camera.camera_id), "station_from_camera")
        out[camera.camera_id] = entry | _images(adjustment, camera.camera_id, sums)
    return out


def _images(adjustment: Adjustment, camera_id: str, sums: tuple[IntArray, FloatArray]) -> dict[str, Any]:
    """Number of used image points and RMS residual, of the camera and of each of its images."""
    blocks = adjustment.survey.image_blocks
    mine = [i for i, b in enumerate(blocks) if b.camera_id == camera_id]
    place = {epoch: k for k, epoch in enumerate(dict.fromkeys(blocks[i].epoch_id for i in mine))}
    of = [place[blocks[i].epoch_id] for i in mine]
    n, squares = (np.bincount(of, x[mine], len(place)) for x in sums)
    with np.errstate(invalid="ignore"):
        rms = np.sqrt(squares / (2.0 * n))
    images = Form(np.arange(len(place)), {"n_image_points": n.astype(np.int64), "rms_residual_px": rms})
    return {
        "n_images": len(place),
        "n_image_points": int(n.sum()),
        "rms_residual_px": _rms(int(n.sum()), sum(squares.tolist())),
        "images": Records(tuple(place), (images,)),
    }


def _sums_of_blocks(found: ImageResiduals) -> tuple[IntArray, FloatArray]:
    """Points in use and their residuals squared, of every image block (B,)."""
    squares = np.where(found.used, np.square(found.residuals) @ np.ones(2), 0.0)
    B = len(found.block_ptr) - 1
    block = np.repeat(np.arange(B), np.diff(found.block_ptr))
    n: IntArray = np.bincount(block[found.used], minlength=B)
    return n, np.bincount(block, squares, B).astype(np.float64)


def _rms(n: float, squares: float) -> float:
    """Root mean square over both coordinates of n points."""
    return math.sqrt(squares / (2 * n)) if n else math.nan


def _poses(of: q.PoseColumns) -> PoseOf:
    """What is said of a pose: under ``key`` and, where it moves, under ``epochs``; nothing where it is no unknown."""
    moving: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for name in of.rows:
        if len(name) == 3:
            moving.setdefault(name[:2], []).append(name)

    def pose(name: tuple[str, ...], key: str) -> dict[str, Any]:
        names = moving.get(name, [])
        epochs = Records([n[2] for n in names], [Form(rows, {key: tree}) for rows, tree in of.trees(names)])
        return ({key: of.entry(name)} if name in of.rows else {}) | ({"epochs": epochs} if names else {})

    return pose


def _stations(adjustment: Adjustment, pose: PoseOf, of: q.PoseColumns, scale: q.Scale) -> Records:
    """Fixed ones with nothing but a pose, of which there may be very many, by columns."""
    stations, apart = adjustment.survey.stations, dict[str, dict[str, Any]]()
    names: list[tuple[str, ...]] = [("world_from_station", s.station_id) for s in stations]
    alike = [i for i, s in enumerate(stations) if s.motion == "fixed" and not s.table_id and names[i] in of.rows
             and ("mount_from_station", s.station_id) not in of.rows]  # fmt: skip
    by_column = set(alike)
    for station in (s for i, s in enumerate(stations) if i not in by_column):
        name = station.station_id
        entry = {"motion": station.motion} | ({"table": station.table_id} if station.table_id else {})
        entry |= _clock(adjustment, ("pose_clock", name), scale)
        entry |= pose(("mount_from_station", name), "mount_from_station")
        apart[name] = plain(entry | pose(("world_from_station", name), "world_from_station"))
    at = np.array(alike, dtype=np.int64)
    forms = [Form(at[rows], {"motion": ["fixed"] * len(rows), "world_from_station": tree})
             for rows, tree in of.trees([names[i] for i in alike])]  # fmt: skip
    return Records([s.station_id for s in stations], forms, apart)


def _points(adjustment: Adjustment, scale: q.Scale) -> dict[str, Any]:
    return {n[1]: q.point_entry(e, scale) for n, e in adjustment.estimates.items() if n[0] == "point"}


def _tables(adjustment: Adjustment, pose: PoseOf, scale: q.Scale) -> dict[str, Any]:
    out = {}
    for table in adjustment.survey.tables:
        name = table.table_id
        entry: dict[str, Any] = {"axes": list(table.axes)}
        entry |= pose(("world_from_table", name), "world_from_table")
        geometry = adjustment.estimates.get(("table_geometry", name))
        if geometry is not None:
            entry["geometry"] = _terms(adjustment, geometry, scale)
        entry |= _clock(adjustment, ("table_clock", name), scale)
        angles = {n[2]: e for n, e in adjustment.estimates.items() if n[:2] == ("table_angles", name)}
        out[name] = entry | {"epochs": {epoch: q.vector_entry(e, scale) for epoch, e in angles.items()}}
    return out


def _changes(adjustment: Adjustment, camera_id: str, kind: str, key: str, scale: q.Scale) -> dict[str, Any]:
    """How a lens changes or images are cropped: by the epoch from which on, or per kelvin; and whether it is clear."""
    found = {n: e for n, e in adjustment.estimates.items() if n[:2] == (kind, camera_id)}
    test = significance_of_changes(adjustment, (kind, camera_id), kind, scale.sigmas == "a_posteriori")
    parts = {n[2] if len(n) > 2 else "per_kelvin": q.vector_entry(e, scale) for n, e in found.items()}
    return {key: parts, "significance": {} if test is None else {test.term: _test(test)}}


def _shared(found: SharedLens, scale: q.Scale) -> dict[str, Any]:
    """Whose parameters they are, by how much its own would differ from them, and whether they do."""
    name, k = ("lens", found.camera), len(found.names)
    differences = Estimate(name, found.difference, found.names, found.units, found.cov, ("free",) * k)
    return {"camera": found.lender, "parameters": list(found.names), "differences": q.vector_entry(differences, scale),
            "significance": {found.test.term: _test(found.test)}}  # fmt: skip


def _clock(adjustment: Adjustment, name: ParameterName, scale: q.Scale) -> dict[str, Any]:
    """The clock of a camera, a table or a station's poses, the times of single epochs about it, and their tests."""
    estimate = adjustment.estimates.get(name)
    if estimate is None:
        return {}
    entry = _terms(adjustment, estimate, scale)
    own = {n[2]: q.vector_entry(e, scale) for n, e in adjustment.estimates.items() if n[:2] == name and len(n) > 2}
    test = significance_of_changes(adjustment, name, "clock_jitter", scale.sigmas == "a_posteriori")
    if test is not None:
        entry["significance"] = entry.get("significance", {}) | {test.term: _test(test)}
    return {"clock": entry | ({"epochs": own} if own else {})}


def _test(s: Significance) -> dict[str, Any]:
    return {"components": list(s.components), "statistic": s.statistic, "freedom": list(s.freedom), "p_value": s.p,
            "significant": s.significant}  # fmt: skip


def _terms(adjustment: Adjustment, estimate: Estimate, scale: q.Scale) -> dict[str, Any]:
    """The components, and the tests of those that may be zero."""
    found = significances(adjustment, estimate, scale.sigmas == "a_posteriori")
    tests = {s.term: _test(s) for s in found}
    return q.vector_entry(estimate, scale) | ({"significance": tests} if tests else {})


def _targets(adjustment: Adjustment, pose: PoseOf, scale: q.Scale) -> dict[str, Any]:
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


def _pairs(adjustment: Adjustment, scale: q.Scale) -> Mapping[str, Any]:
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
