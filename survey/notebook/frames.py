"""The results of an adjustment as pandas data frames; units stand in the names of the columns, as in result files.

Every function gives a new frame; changing one changes no result. Sigmas are scaled as in the report.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from operator import attrgetter, itemgetter
from typing import Any, Protocol, TypeVar

import numpy as np
from gtsam import Pose3

from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.statistics.result import RelativePrecision
from survey.folder.extras import library
from survey.solution.quantities import (
    ARCSEC_PER_RAD,
    Scale,
    Status,
    point_entry,
    pose_columns,
    sigma_unit_for_people,
    sigmas_of,
    unit_for_people,
    units_for_people,
)
from survey.solution.residual_tables import image_rows
from survey.solution.statistics import Statistics

T = TypeVar("T")
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


def frame(things: Iterable[T], index: Sequence[str], columns: Mapping[str, str | Callable[[T], object]]) -> Any:
    """A data frame of things: its columns by name, each an attribute of theirs or a function; some are the index."""
    rows, of = list(things), {k: attrgetter(how) if isinstance(how, str) else how for k, how in columns.items()}
    return indexed(pandas().DataFrame({k: [how(thing) for thing in rows] for k, how in of.items()}), index)


def of_rows(rows: Iterable[tuple[object, ...]], index: Sequence[str], *columns: str) -> Any:
    """A data frame of rows, each with the index first; none of them has its columns too."""
    return indexed(pandas().DataFrame(list(rows), columns=[*index, *columns]), index)


def indexed(made: Any, index: Sequence[str]) -> Any:
    """A data frame with some of its columns as the index."""
    return made.set_index(list(index) if len(index) > 1 else index[0])


def _semi_axes(of: Callable[[Any], Any]) -> dict[str, Callable[[Any], float]]:
    """A column for each of the semi-axes, mm, that a thing has."""
    return {f"{c}_mm": partial(_number, of, k) for k, c in enumerate("abc")}


def _number(of: Callable[[Any], Any], k: int, thing: Any) -> float:
    return float(of(thing)[k])


def points(s: Solved) -> Any:
    """World points: coordinates, sigmas, semi-axes of the 95 % ellipsoid (mm), status."""
    found = [{"point_id": name[1]} | point_entry(e, s.scale) for name, e in s.adjustment.estimates.items()
             if name[0] == "point"]  # fmt: skip
    own = ("point_id", *(pattern.format(c) for pattern in ("{}_mm", "sigma_{}_mm") for c in "xyz"))
    return frame(found, ["point_id"], {
        **{key: itemgetter(key) for key in own}, **_semi_axes(itemgetter("ellipsoid_95_semi_axes_mm")),
        "status": lambda x: _status(x["status"]),
    })  # fmt: skip


def _status(found: Status) -> str:
    return found if isinstance(found, str) else " ".join(found.values())


def poses(s: Solved, kinds: tuple[str, ...] = _POSES) -> Any:
    """Adjusted poses a_from_b: translation (mm) along a, rotation as Euler angles (deg) and quaternion, sigmas."""
    found = pose_columns((e for name, e in s.adjustment.estimates.items() if name[0] in kinds), s.scale)
    columns: dict[str, Any]
    columns = {key: [(*name, "")[k] for name in found.rows] for k, key in enumerate(("transform", "id", "epoch_id"))}
    for pattern, key, axes in _OF_POSES:
        columns |= {pattern.format(c): found.columns[key][:, k] for k, c in enumerate(axes)}
    columns["status"] = list(map(_status, found.status))
    return pandas().DataFrame(columns).set_index(["transform", "id", "epoch_id"])


_OF_POSES = (
    ("{}_mm", "translation_mm", "xyz"), ("sigma_{}_mm", "sigma_translation_mm", "xyz"),
    ("euler_{}_deg", "rotation_euler_xyz_deg", "xyz"), ("sigma_r{}_arcsec", "sigma_rotation_arcsec", "xyz"),
    ("q{}", "rotation_quaternion_wxyz", "wxyz"),
)  # fmt: skip


def stations(s: Solved) -> Any:
    """Poses of stations in the world or on their mount, by epoch where they move."""
    return poses(s, ("world_from_station", "mount_from_station"))


def cameras(s: Solved) -> Any:
    """Cameras: station, size, number of images and points used, RMS residual (px), pose in the station."""
    made = frame(s.adjustment.survey.cameras, ["camera_id"], {
        "camera_id": "camera_id", "station_id": "station_id", "model": "lens.model",
        "width_px": lambda c: c.image_size[0], "height_px": lambda c: c.image_size[1],
    })  # fmt: skip
    rows = image_residuals(s)
    used = rows[rows["used"]].assign(square=lambda x: (x["residual_u_px"] ** 2 + x["residual_v_px"] ** 2) / 2.0)
    made["n_images"] = rows.groupby("camera_id")["epoch_id"].nunique().reindex(made.index, fill_value=0)
    made["n_points"] = used.groupby("camera_id").size().reindex(made.index, fill_value=0)
    made["rms_px"] = np.sqrt(used.groupby("camera_id")["square"].mean()).reindex(made.index)
    return made.join(poses(s, ("station_from_camera",)).droplevel(["transform", "epoch_id"]).rename_axis("camera_id"))


def lenses(s: Solved) -> Any:
    """Parameters of lenses by (camera, parameter): value and sigma in ``unit``, value over sigma, status."""
    return _vectors(s, "lens")


def tables(s: Solved) -> Any:
    """Geometry of turntables by (table, parameter), as :func:`lenses`."""
    return _vectors(s, "table_geometry")


def _vectors(s: Solved, kind: str) -> Any:
    parts = ((p, *unit_for_people(p.component, p.unit)) for p in _parts(s) if p.kind == kind)
    rows = ((p.id, p.component, p.value * f, p.sigma * f, unit, abs(p.value) / p.sigma if p.sigma > 0.0 else np.nan,
             p.status) for p, unit, f in parts)  # fmt: skip
    return of_rows(rows, ["id", "component"], "value", "sigma", "unit", "value_over_sigma", "status")


def unknowns(s: Solved) -> Any:
    """Every component of every estimate in the tangent, SI units and radians: what ``covariance.npz`` is about."""
    columns = ["kind", "id", "epoch_id", "component", "value", "sigma", "unit", "status"]
    return frame(_parts(s), columns[:4], {name: name for name in columns})


@frozen
class _Part:
    """One component of an estimate, in units inside; of a pose it has no value."""

    kind: str
    id: str
    epoch_id: str
    component: str
    value: float
    sigma: float
    unit: str
    status: str


def _parts(s: Solved) -> Iterator[_Part]:
    for name, e in s.adjustment.estimates.items():
        values = np.full(6, np.nan) if isinstance(e.value, Pose3) else np.asarray(e.value, dtype=float)
        for row in zip(e.components, values.tolist(), sigmas_of(e, s.scale).tolist(), e.units, e.status, strict=True):
            yield _Part(name[0], (*name, "")[1], (*name, "", "")[2], *row)


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
    arrays, every = s.adjustment.other_arrays, s.adjustment.other_residuals
    said = [(o.kind, o.group, " ".join(o.ids), c, *units_for_people(c, unit)) for o in every
            for c, unit in zip(o.components, o.units, strict=True)]  # fmt: skip
    kind, group, ids, component, unit, f, residual_unit, g = np.array(said, dtype=object).reshape(-1, 8).T
    return pandas().DataFrame({
        "kind": kind, "group": group, "ids": ids, "component": component, "observed": arrays.observed * f.astype(float),
        "adjusted": arrays.adjusted * f.astype(float), "unit": unit, "residual": arrays.residual * g.astype(float),
        "sigma": arrays.sigma * g.astype(float), "residual_unit": residual_unit, "redundancy": arrays.redundancies,
        "standardized": arrays.standardized, "test": arrays.test[arrays.observation],
        "used": arrays.used[arrays.observation],
    })  # fmt: skip


def groups(s: Solved) -> Any:
    """Groups of observations: number, redundancy, weighted square sum, variance factor and its root."""
    return frame(s.adjustment.groups, ["group"], {
        "group": "group", "n": "n_observations", "redundancy": "redundancy", "omega": "omega",
        "variance_factor": "factor", "sigma_scale": lambda g: np.sqrt(g.factor) if g.factor >= 0 else np.nan,
    })  # fmt: skip


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

    def turn(r: RelativePrecision) -> float:
        cov = r.rotation_cov
        return np.nan if cov is None else ARCSEC_PER_RAD * float(np.sqrt(np.linalg.eigvalsh(cov)[-1]))

    return frame(s.precision.relative, ["a", "b"], {
        "a": lambda r: r.a[-1], "b": lambda r: r.b[-1], "distance_mm": lambda r: 1e3 * r.distance,
        "sigma_mm": lambda r: 1e3 * r.sigma_distance,
        **_semi_axes(lambda r: [*(1e3 * np.asarray(r.ellipsoid.semi_axes)), np.nan, np.nan]),
        "sigma_rotation_arcsec": turn,
    })  # fmt: skip


def budget(s: Solved) -> Any:
    """Uncertainty budget: a row per source of every result, with its share of the variance."""
    entries = [(e, *sigma_unit_for_people(e.unit)) for e in s.precision.budget]
    rows = (("/".join(e.name), e.component, line.source, line.kind, line.u * f, line.share, e.u * f, e.coverage,
             e.expanded * f, unit) for e, unit, f in entries for line in e.lines)  # fmt: skip
    return of_rows(rows, ["result", "component", "source"], "type", "u", "share", "u_total", "k", "U", "unit")
