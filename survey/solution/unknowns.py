"""Cameras, stations, points, turntables and targets in the dictionary of a solution."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from adjust.model.result import Adjustment, Estimate, ImageResiduals, ParameterName
from adjust.model.survey import FloatArray, IntArray
from adjust.statistics.score import SharedLens, shared_lenses
from adjust.testing.distributions import norm
from adjust.testing.significance import Significance, significance_of_changes, significances
from survey.folder.plain import plain
from survey.solution import quantities as q
from survey.solution.records import Form, Records

CORRELATION_LIMIT = 0.95
# parameters for which "zero" is no sensible hypothesis
_NEVER_ZERO = {"fx", "fy", "u0", "v0", "c", "xp", "yp"}
PoseOf = Callable[[tuple[str, ...], str], dict[str, Any]]


def unknown_entries(adjustment: Adjustment, scale: q.Scale) -> dict[str, Any]:
    """``cameras``, ``stations``, ``points``, ``tables`` and ``targets``, by their ids."""
    columns = q.pose_columns(adjustment.estimates.values(), scale)
    poses = _poses(columns)
    return {
        "cameras": _cameras(adjustment, poses, scale),
        "stations": _stations(adjustment, poses, columns, scale),
        "points": _points(adjustment, scale),
        "tables": _tables(adjustment, poses, scale),
        "targets": _targets(adjustment, poses, scale),
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
