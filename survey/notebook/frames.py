"""The results of an adjustment as pandas data frames; units stand in the names of the columns, as in result files.

Every function gives a new frame; changing one changes no result. Sigmas are scaled as in the report.
"""

from typing import Any, Protocol

import numpy as np
from gtsam import Pose3

from adjust.model.result import Adjustment, Estimate, ParameterName
from survey.folder.extras import library
from survey.solution.quantities import (
    ARCSEC_PER_RAD,
    Scale,
    ellipsoid,
    pose_entry,
    sigma_unit_for_people,
    sigmas_of,
    status_of,
    unit_for_people,
)
from survey.solution.residual_tables import image_rows
from survey.solution.statistics import Statistics

_POSES = ("station_from_camera", "mount_from_station", "world_from_station", "world_from_table", "carrier_from_target")


class Solved(Protocol):
    """What frames are made of: a solution."""

    @property
    def adjustment(self) -> Adjustment:
        """The adjusted survey."""

    @property
    def scale(self) -> Scale:
        """What covariances are multiplied with."""

    @property
    def precision(self) -> Statistics:
        """Tests, reliability, relative precision, budget."""


def pandas() -> Any:
    """The library. Raises SurveyError where it is not installed."""
    return library("pandas", "notebook", "data frames need pandas")


def frame(rows: list[dict[str, Any]], index: list[str], columns: list[str]) -> Any:
    """A data frame with an index; empty ones have their columns too."""
    made = pandas().DataFrame(rows, columns=[*index, *columns])
    return made.set_index(index if len(index) > 1 else index[0])


def points(s: Solved) -> Any:
    """World points: coordinates, sigmas, semi-axes of the 95 % ellipsoid (mm), status."""
    rows = []
    for name, e in s.adjustment.estimates.items():
        if name[0] == "point":
            values, sigmas = 1e3 * np.asarray(e.value, dtype=float), 1e3 * sigmas_of(e, s.scale)
            axes = 1e3 * ellipsoid(e.cov, s.scale)[0]
            rows.append({"point_id": name[1], **_named("{}_mm", values), **_named("sigma_{}_mm", sigmas),
                         **dict(zip(("a_mm", "b_mm", "c_mm"), axes, strict=True)), "status": _status(e)})  # fmt: skip
    columns = [p.format(c) for p in ("{}_mm", "sigma_{}_mm") for c in "xyz"]
    return frame(rows, ["point_id"], [*columns, "a_mm", "b_mm", "c_mm", "status"])


def _named(pattern: str, values: Any) -> dict[str, float]:
    return {pattern.format(c): float(v) for c, v in zip("xyz", values, strict=True)}


def _status(e: Estimate) -> str:
    found = status_of(e)
    return found if isinstance(found, str) else " ".join(found.values())


def poses(s: Solved, kinds: tuple[str, ...] = _POSES) -> Any:
    """Adjusted poses a_from_b: translation (mm) along a, rotation as Euler angles (deg) and quaternion, sigmas."""
    return frame(_pose_rows(s, kinds), ["transform", "id", "epoch_id"], _POSE_COLUMNS)


def stations(s: Solved) -> Any:
    """Poses of stations in the world or on their mount, by epoch where they move."""
    return poses(s, ("world_from_station", "mount_from_station"))


def _pose_rows(s: Solved, kinds: tuple[str, ...]) -> list[dict[str, Any]]:
    return [_pose_row(name, e, s.scale) for name, e in s.adjustment.estimates.items()
            if name[0] in kinds and isinstance(e.value, Pose3)]  # fmt: skip


_POSE_COLUMNS = [*(f"{c}_mm" for c in "xyz"), *(f"sigma_{c}_mm" for c in "xyz"), *(f"euler_{c}_deg" for c in "xyz"),
                 *(f"sigma_r{c}_arcsec" for c in "xyz"), *(f"q{c}" for c in "wxyz"), "status"]  # fmt: skip


def _pose_row(name: ParameterName, e: Estimate, scale: Scale) -> dict[str, Any]:
    entry = pose_entry(e, scale)
    q = dict(zip(("qw", "qx", "qy", "qz"), entry["rotation_quaternion_wxyz"], strict=True))
    return {
        "transform": name[0], "id": name[1], "epoch_id": name[2] if len(name) > 2 else "",
        **_named("{}_mm", entry["translation_mm"]), **_named("sigma_{}_mm", entry["sigma_translation_mm"]),
        **_named("euler_{}_deg", entry["rotation_euler_xyz_deg"]),
        **_named("sigma_r{}_arcsec", entry["sigma_rotation_arcsec"]), **q, "status": _status(e),
    }  # fmt: skip


def cameras(s: Solved) -> Any:
    """Cameras: station, size, number of images and points used, RMS residual (px), pose in the station."""
    found, rows = s.adjustment.image_residuals, []
    blocks = s.adjustment.survey.image_blocks
    where = {row["id"]: row for row in _pose_rows(s, ("station_from_camera",))}
    for camera in s.adjustment.survey.cameras:
        mine = [i for i, b in enumerate(blocks) if b.camera_id == camera.camera_id]
        parts = [found.residuals[found.block_ptr[i] : found.block_ptr[i + 1]][
            found.used[found.block_ptr[i] : found.block_ptr[i + 1]]] for i in mine]  # fmt: skip
        every = np.concatenate([*parts, np.empty((0, 2))])
        rows.append({
            "camera_id": camera.camera_id, "station_id": camera.station_id, "model": camera.lens.model,
            "width_px": camera.image_size[0], "height_px": camera.image_size[1],
            "n_images": len({blocks[i].epoch_id for i in mine}), "n_points": len(every),
            "rms_px": float(np.sqrt(np.mean(every**2))) if every.size else float("nan"),
            **where.get(camera.camera_id, {}),
        })  # fmt: skip
    first = ["station_id", "model", "width_px", "height_px", "n_images", "n_points", "rms_px"]
    return frame(rows, ["camera_id"], first + _POSE_COLUMNS)


def lenses(s: Solved) -> Any:
    """Parameters of lenses by (camera, parameter): value and sigma in ``unit``, value over sigma, status."""
    return _vectors(s, "lens")


def tables(s: Solved) -> Any:
    """Geometry of turntables by (table, parameter), as :func:`lenses`."""
    return _vectors(s, "table_geometry")


def _vectors(s: Solved, kind: str) -> Any:
    rows = []
    for name, e in s.adjustment.estimates.items():
        if name[0] == kind and not isinstance(e.value, Pose3):
            values = np.asarray(e.value, dtype=float)
            for component, unit, value, sigma, status in zip(
                e.components, e.units, values, sigmas_of(e, s.scale), e.status, strict=True
            ):
                shown, factor = unit_for_people(component, unit)
                rows.append({
                    "id": name[1] if len(name) > 1 else name[0], "component": component, "value": value * factor,
                    "sigma": sigma * factor, "unit": shown,
                    "value_over_sigma": abs(value) / sigma if sigma > 0.0 else float("nan"), "status": status,
                })  # fmt: skip
    return frame(rows, ["id", "component"], ["value", "sigma", "unit", "value_over_sigma", "status"])


def unknowns(s: Solved) -> Any:
    """Every component of every estimate in the tangent, SI units and radians: what ``covariance.npz`` is about."""
    rows = []
    for name, e in s.adjustment.estimates.items():
        flat = None if isinstance(e.value, Pose3) else np.asarray(e.value, dtype=float)
        for i, (component, unit) in enumerate(zip(e.components, e.units, strict=True)):
            rows.append({
                "kind": name[0], "id": name[1] if len(name) > 1 else "", "epoch_id": name[2] if len(name) > 2 else "",
                "component": component, "value": float("nan") if flat is None else flat[i],
                "sigma": float(sigmas_of(e, s.scale)[i]), "unit": unit, "status": e.status[i],
            })  # fmt: skip
    return frame(rows, ["kind", "id", "epoch_id", "component"], ["value", "sigma", "unit", "status"])


def image_residuals(s: Solved) -> Any:
    """Image points: observed place, residual (predicted minus observed), sigma, redundancy, test; one row each."""
    rows, found = image_rows(s.adjustment), s.adjustment.image_residuals
    blocks = s.adjustment.survey.image_blocks
    names = np.array([(b.epoch_id, b.camera_id, b.target_id or "") for b in blocks], dtype=object).reshape(-1, 3)
    columns: dict[str, Any] = dict(zip(("epoch_id", "camera_id", "target_id"), names[rows.block].T, strict=True))
    columns["point_id"] = np.array(rows.point_ids, dtype=object)[rows.point] if len(rows.point) else []
    for name, pair in (("{}_px", rows.uv), ("residual_{}_px", found.residuals), ("sigma_{}_px", rows.sigmas),
                       ("redundancy_{}", found.redundancy), ("standardized_{}", found.standardized)):  # fmt: skip
        columns |= {name.format(c): pair[:, k] for k, c in enumerate("uv")}
    return pandas().DataFrame(columns | {"test": found.test, "used": found.used})


def readings(s: Solved) -> Any:
    """Every observation that is no image point, a row per component: mm and deg, residual and sigma mm and arcsec."""
    rows = []
    for o in s.adjustment.other_residuals:
        for i, (component, unit) in enumerate(zip(o.components, o.units, strict=True)):
            value_unit, f = unit_for_people(component, unit)
            sigma_unit, g = sigma_unit_for_people(unit)
            rows.append({
                "kind": o.kind, "group": o.group, "ids": " ".join(o.ids), "component": component,
                "observed": o.observed[i] * f, "adjusted": o.adjusted[i] * f, "unit": value_unit,
                "residual": o.residual[i] * g, "sigma": o.sigma[i] * g, "residual_unit": sigma_unit,
                "redundancy": o.redundancy[i], "standardized": o.standardized[i], "test": o.test, "used": o.used,
            })  # fmt: skip
    columns = ["kind", "group", "ids", "component", "observed", "adjusted", "unit", "residual", "sigma",
               "residual_unit", "redundancy", "standardized", "test", "used"]  # fmt: skip
    return pandas().DataFrame(rows, columns=columns)


def groups(s: Solved) -> Any:
    """Groups of observations: number, redundancy, weighted square sum, variance factor and its root."""
    rows = [{"group": g.group, "n": g.n_observations, "redundancy": g.redundancy, "omega": g.omega,
             "variance_factor": g.factor, "sigma_scale": float(np.sqrt(g.factor)) if g.factor >= 0 else float("nan")}
            for g in s.adjustment.groups]  # fmt: skip
    return frame(rows, ["group"], ["n", "redundancy", "omega", "variance_factor", "sigma_scale"])


def reliability(s: Solved) -> Any:
    """Every observation: tests, redundancy, least detectable bias in its sigmas (MDB), external reliability."""
    tests, rows = s.precision.reliability.tests, image_rows(s.adjustment)
    blocks, image = s.adjustment.survey.image_blocks, []
    for k in range(tests.n_image):
        b = blocks[int(rows.block[k])]
        image.append(("image", f"{b.camera_id} {b.epoch_id} {rows.point_ids[rows.point[k]]}"))
    names = image + [(o.kind, " ".join(o.ids)) for o in s.adjustment.other_residuals]
    return pandas().DataFrame({
        "kind": [n[0] for n in names], "ids": [n[1] for n in names],
        "group": [tests.group_names[i] for i in tests.group], "n_components": tests.n_components,
        "redundancy": tests.redundancy, "test": tests.statistic, "p": tests.p, "fails": tests.fails,
        "mdb_sigmas": tests.detectable, "external": tests.external, "used": tests.used,
    })  # fmt: skip


def relative_precision(s: Solved) -> Any:
    """Relative precision of neighbours: distance, its sigma and semi-axes of the relative ellipsoid, mm."""
    rows = []
    for r in s.precision.relative:
        axes = [1e3 * float(a) for a in r.ellipsoid.semi_axes] + [float("nan")] * (3 - r.ellipsoid.dimension)
        turn = float("nan")
        if r.rotation_cov is not None:
            turn = ARCSEC_PER_RAD * float(np.sqrt(np.linalg.eigvalsh(r.rotation_cov)[-1]))
        rows.append({
            "a": r.a[-1], "b": r.b[-1], "distance_mm": 1e3 * r.distance, "sigma_mm": 1e3 * r.sigma_distance,
            **dict(zip(("a_mm", "b_mm", "c_mm"), axes, strict=True)), "sigma_rotation_arcsec": turn,
        })  # fmt: skip
    columns = ["distance_mm", "sigma_mm", "a_mm", "b_mm", "c_mm", "sigma_rotation_arcsec"]
    return frame(rows, ["a", "b"], columns)


def budget(s: Solved) -> Any:
    """Uncertainty budget: a row per source of every result, with its share of the variance."""
    rows = []
    for e in s.precision.budget:
        unit, f = sigma_unit_for_people(e.unit)
        rows += [{"result": "/".join(e.name), "component": e.component, "source": line.source, "type": line.kind,
                  "u": line.u * f, "share": line.share, "u_total": e.u * f, "k": e.coverage, "U": e.expanded * f,
                  "unit": unit} for line in e.lines]  # fmt: skip
    return frame(rows, ["result", "component", "source"], ["type", "u", "share", "u_total", "k", "U", "unit"])
