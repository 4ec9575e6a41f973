"""Sections on what was estimated: cameras, stations, tables, targets, points, instruments and surfaces."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np
from markupsafe import Markup

from survey.report import charts
from survey.report import markup as m
from survey.report.context import Context
from survey.report.language import known, t
from survey.report.sections.components import status_pill, tests_of, value_in, vector_table
from survey.solution.quantities import components_of
from survey.solution.records import having, keys_of

_MOST_ROWS, _MOST_CAMERAS, _MOST_BLOCKS = 250, 40, 100
_MANY_EPOCHS = 12
T = TypeVar("T")
_Pose = tuple[str, str, str, Callable[[], dict[str, Any]]]
"""A thing, the name of its pose, the epoch or nothing, and what gives the entry: few of many are shown."""
_POSE_COLUMNS = ("<Pose", "<Epoch", "x [mm]", "y [mm]", "z [mm]", "rx [°]", "ry [°]", "rz [°]", "<Status")
_POSE_NOTE = (
    "A pose a_from_b is the origin of b in a and R = Rz Ry Rx. Below each coordinate its sigma along the axes of a in "
    "mm, below each angle the sigma of a small rotation about the same axis of b in arcseconds."
)


def _pose_row(pose: _Pose) -> list[str]:
    """A row of the table of poses."""
    (thing_id, name, epoch, _), entry = pose, pose[-1]()
    smallest = min((s for s in entry["sigma_translation_mm"] if s), default=None)
    cells = [
        m.with_sigma(v, s, smallest)
        for v, s in zip(entry["translation_mm"], entry["sigma_translation_mm"], strict=True)
    ]
    least = min((s for s in entry["sigma_rotation_arcsec"] if s), default=None)
    for angle, sigma in zip(entry["rotation_euler_xyz_deg"], entry["sigma_rotation_arcsec"], strict=True):
        below = f"± {m.sigma_text(sigma)}″" if sigma else t("held")
        cells.append(m.part("below", value_in("deg", angle, least, "arcsec"), below))
    return [m.joined((m.element("b", thing_id), m.code(name)), " "), epoch, *cells, status_pill(entry["status"])]


def _poses(thing_id: str, entries: Mapping[str, dict[str, Any]]) -> Iterator[_Pose]:
    """All poses of a thing, also those per epoch."""
    for key in keys_of(entries, thing_id):
        if key == "epochs":
            poses = entries[thing_id][key]
            for epoch in poses:
                names = (name for name in keys_of(poses, epoch) if "_from_" in name)
                yield from ((thing_id, name, epoch, partial(_part_of, poses, epoch, name)) for name in names)
        elif "_from_" in key:
            yield thing_id, key, "", partial(_part_of, entries, thing_id, key)


def _part_of(entries: Mapping[str, dict[str, Any]], name: str, key: str) -> dict[str, Any]:
    return dict(entries[name][key])


def _limited(columns: Sequence[str], things: Sequence[T], row: Callable[[T], list[str]]) -> Markup:
    """A table with a row for each of the first things, and how many more there are."""
    if not things:
        return Markup()
    return m.table(columns, map(row, things[:_MOST_ROWS])) + _more(len(things) - _MOST_ROWS)


def _more(n: int) -> Markup:
    return m.note(m.more(n)) if n > 0 else Markup()


def cameras(c: Context) -> Markup:
    """Every camera: lens, pose, residuals."""
    entries, parts = c.solution["cameras"], []
    # of very many cameras those with the largest residuals are shown whole
    by_size = sorted(entries, key=lambda k: -(entries[k]["rms_residual_px"] or 0.0))
    shown, others = set(by_size[:_MOST_CAMERAS]), by_size[_MOST_CAMERAS:]
    for camera in c.adjustment.survey.cameras:
        if camera.camera_id in shown:
            residuals = charts.camera_residuals(c.adjustment, c.rows, c.suspect, camera)
            parts.append(_camera(camera.camera_id, entries[camera.camera_id], residuals))
    if others:
        n = m.count(len(others))
        title = t("{n} more cameras, with smaller residuals; their lenses and poses in solution.json", n=n)
        columns = ("<Camera", "Images", "Points", "RMS residual [px]")
        parts.append(m.part("details", title, _limited(columns, others, lambda k: _camera_row(k, entries[k])), True))
    said = t(
        "Residual vectors point from the observed to the adjusted position. Red: suspect, orange: not used. "
        "A pattern in the mean per cell is what the lens model leaves over; empty cells hold no points."
    )
    return m.section("cameras", "Cameras", m.joined(parts), said)


def _camera_row(camera_id: str, entry: dict[str, Any]) -> list[str]:
    numbers = (m.count(entry["n_images"]), m.count(entry["n_image_points"]), m.fixed(entry["rms_residual_px"], 3))
    return [camera_id, *numbers]


def _camera(camera_id: str, entry: dict[str, Any], residuals: charts.CameraResiduals) -> Markup:
    width, height = entry["image_size_px"]
    facts = t(
        "{width} × {height} px on station {station} · {images} images, {points} points", width=width, height=height,
        station=entry["station"], images=m.count(entry["n_images"]), points=m.count(entry["n_image_points"]),
    )  # fmt: skip
    facts += " · " + t("lens model {model}", model=entry["lens"]["model"]) if "lens" in entry else ""
    facts += " · " + t("RMS residual {rms} px", rms=m.fixed(entry["rms_residual_px"], 3))
    lens = entry.get("lens")
    shown = Markup() if lens is None else vector_table(lens, lens["value_over_sigma"]) + _remarks(lens)
    shown += m.joined(_changes(entry[key], part) for key, part in _OF_LENS.items() if key in entry)
    shown += _clock(entry)
    makers = (charts.vector_field, charts.mean_field, charts.histogram)
    drawn = [make(residuals) for make in makers] if len(residuals.uv) else []
    rows = [row[:1] + row[2:] for row in map(_pose_row, _poses(camera_id, {camera_id: entry}))]
    poses = m.table(_POSE_COLUMNS[:1] + _POSE_COLUMNS[2:], rows) if rows else ""
    return m.part("camera", camera_id, facts, shown, drawn, poses, of="report.html")


_OF_LENS = {"lens_drift": "changes", "lens_crop": "crops", "lens_shared": "differences"}


def _changes(entry: dict[str, Any], key: str) -> Markup:
    """How the lens changes, images are cropped or a shared lens would differ: a table for each, and what is clear."""
    changes = [(entry["camera"], entry[key])] if key == "differences" else list(entry[key].items())
    parts = [m.note(_change_head(key, name)) + vector_table(change) for name, change in changes]
    return m.joined((*parts[:_MOST_BLOCKS], _more(len(parts) - _MOST_BLOCKS))) + tests_of(entry["significance"])


def _change_head(key: str, name: str) -> Markup | str:
    if key == "differences":
        return t("Shared with camera {name}; a lens of its own would differ by", name=name)
    if key == "crops":
        return t("Images cropped from epoch {name} on", name=name)
    return t("Change per kelvin") if name == "per_kelvin" else t("Change from epoch {name} on", name=name)


_OWN_TIMES = ("<Epoch", "Value", "σ", "<Unit")


def _clock(entry: dict[str, Any], owner: str = "") -> Markup:
    """The clock of a camera, a table or a station's poses, where it has one; the times of single epochs folded in."""
    clock = entry.get("clock")
    if clock is None:
        return Markup()
    own = [(epoch, *found) for epoch, e in clock.get("epochs", {}).items() for found in components_of(e)]
    rows = [[e, value_in(unit, v, s, s_unit), m.sigma_text(s), unit] for e, _, v, unit, s, s_unit, _ in own]
    head = t("Clock of {name}", name=owner) if owner else t("Clock")
    title = t("{n} epochs: times of their own", n=m.count(len(rows)))
    shown = m.element("h3", head) + vector_table(clock)
    return shown + (m.part("details", title, _limited(_OWN_TIMES, rows, list), False) if rows else Markup())


def _remarks(lens: dict[str, Any]) -> Markup:
    """What is weak about a lens: parameters that could as well be zero, correlations."""
    strong, weak = lens["correlations_over_95_percent"], lens["not_significant"]
    pairs = (
        m.joined((m.code(p["a"]), t("with"), m.code(p["b"]), m.fixed(100 * p["correlation"], 1), "%"), " ")
        for p in strong
    )
    # fx and fy of a camera always go together; alone they are no warning
    kind = "warn" if any({p["a"], p["b"]} != {"fx", "fy"} for p in strong) else "quiet"
    correlation = (
        m.joined((m.pill(kind, t("correlated above 95 %")), m.joined(pairs, ", ")), " ")
        if strong
        else t("No correlation above 95 % within the lens.")
    )
    remarks = [correlation]
    if weak:
        said = t("{names}: not distinguishable from zero at 95 %.", names=m.joined(map(m.code, weak), ", "))
        remarks.append(m.joined((m.pill("warn", t("not significant")), said), " "))
    return m.joined(map(m.note, remarks))


def stations(c: Context) -> Markup:
    """Poses of stations, of their mounts, of tables and targets."""
    kinds = (c.solution[kind] for kind in ("stations", "tables", "targets"))
    poses = [pose for entries in kinds for i in entries for pose in _poses(i, entries)]
    by_epoch = [pose for pose in poses if pose[2]]
    many = len(by_epoch) > _MANY_EPOCHS
    body = _limited(_POSE_COLUMNS, [pose for pose in poses if not pose[2]] if many else poses, _pose_row)
    if many:
        title = t("{n} poses by epoch", n=m.count(len(by_epoch)))
        body += m.part("details", title, _limited(_POSE_COLUMNS, by_epoch, _pose_row), False)
    body += m.joined(_clock(e, k) for k, e in having(c.solution["stations"], "clock").items())
    return m.section("poses", "Poses of stations, tables and targets", body, t(_POSE_NOTE))


def tables(c: Context) -> Markup:
    """Geometry and angles of every table."""
    parts = []
    for table_id, entry in c.solution["tables"].items():
        axes = t(" then ").join(entry["axes"])
        body = m.element("h3", m.joined((table_id, t("axes {axes}", axes=axes)), ", "))
        if "geometry" in entry:
            body += vector_table(entry["geometry"])
        body += _clock(entry, table_id)
        if entry["epochs"]:
            names = list(next(iter(entry["epochs"].values()))["status"])
            columns = ("<Epoch", *(x for n in names for x in (f"{n} [°]", "σ [″]")))
            epochs = list(entry["epochs"].items())
            title = t("{n} epochs: adjusted angles", n=m.count(len(epochs)))
            body += m.part("details", title, _limited(columns, epochs, _angles_row), len(epochs) <= _MANY_EPOCHS)
        parts.append(body)
    return m.section("tables", "Turntables", m.joined(parts))


def _angles_row(epoch: tuple[str, dict[str, Any]]) -> list[str]:
    name, angles = epoch
    parts = ((value_in(unit, v, s, s_unit), m.sigma_text(s)) for _, v, unit, s, s_unit, _ in components_of(angles))
    return [name, *(x for both in parts for x in both)]


def targets(c: Context) -> Markup:
    """What the targets are; their poses are listed with those of the stations."""
    entries = list(c.solution["targets"].items())
    columns = ("<Target", "Points", "<Stands on", "<Motion", "Poses per epoch")
    bent = [(k, e["warp"]) for k, e in entries if "warp" in e]
    warps = [m.element("h3", t("Warp of {name}", name=k)) + vector_table(warp) for k, warp in bent[:_MOST_BLOCKS]]
    body = m.joined((_limited(columns, entries, _target_row), *warps, _more(len(bent) - _MOST_BLOCKS)))
    return m.section("targets", "Targets", body)


def _target_row(target: tuple[str, dict[str, Any]]) -> list[str]:
    target_id, entry = target
    carrier = t("station {name}", name=entry["station"]) if "station" in entry else t("the world")
    epochs = m.count(len(entry.get("epochs", {})))
    return [target_id, m.count(entry["n_points"]), carrier, known(entry["motion"]), epochs]


def points(c: Context) -> Markup:
    """Coordinates of points, least precise first."""
    entries = sorted(c.solution["points"].items(), key=lambda x: -x[1]["ellipsoid_95_semi_axes_mm"][0])
    worst = entries[0][1]["ellipsoid_95_semi_axes_mm"][0] if entries else 0.0
    every = [p[f"sigma_{a}_mm"] for _, p in entries for a in "xyz" if p[f"sigma_{a}_mm"]]
    typical = float(np.median(every)) if every else None

    def row(point: tuple[str, dict[str, Any]]) -> list[str]:
        point_id, p = point
        axes = p["ellipsoid_95_semi_axes_mm"]
        bar = m.part("bar", f"{100.0 * axes[0] / worst if worst else 0.0:.0f}")
        cells = [m.element("b", point_id), *(m.with_sigma(p[f"{a}_mm"], p[f"sigma_{a}_mm"], typical) for a in "xyz")]
        return [*cells, *(m.sigma_text(a) for a in axes), bar, status_pill(p["status"])]

    columns = ("<Point", "x [mm]", "y [mm]", "z [mm]", "a [mm]", "b [mm]", "c [mm]", "<", "<Status")
    said = t(
        "World coordinates with sigmas below; a, b, c: semi-axes of the 95 % confidence ellipsoid ({k} sigmas). "
        "Least precise first.",
        k=m.general(c.scale.ellipsoid, 4),
    )
    return m.section("points", "Points", _limited(columns, entries, row), said)


def instruments(c: Context) -> Markup:
    """The vertical, instruments, their setups, laser beams and surfaces: what they were found to be."""
    parts: list[Markup] = []
    vertical = c.solution.get("vertical")
    if vertical is not None:
        parts += [m.element("h3", t("Vertical")), _vector(t("upwards in the world"), vertical["up_in_world"])]
        parts += [vector_table(vertical["tilt"])] if "tilt" in vertical else []
    for instrument_id, entry in c.solution.get("instruments", {}).items():
        parts += [m.element("h3", m.joined((t("Instrument"), instrument_id), " ")), vector_table(entry)]
    setups = list(c.solution.get("setups", {}).items())
    for setup_id, entry in setups[:_MOST_BLOCKS]:
        of = f" ({entry['instrument']})" if "instrument" in entry else ""
        parts += [m.element("h3", m.joined((t("Setup"), f"{setup_id}{of}"), " "))]
        parts += [vector_table(entry[kind]) for kind in ("orientation", "centring") if kind in entry]
    parts += [_more(len(setups) - _MOST_BLOCKS)]
    for beam_id, entry in c.solution.get("beams", {}).items():
        carrier = next(f"{kind} {entry[kind]}" for kind in ("mount", "station") if kind in entry)
        head = f"{t('Laser beam')} {beam_id} ({carrier}, {t('along')} {entry['axis']})"
        parts += [m.element("h3", head), vector_table(entry["parameters"])]
    for surface_id, entry in c.solution.get("surfaces", {}).items():
        key = next((k for k in ("normal", "direction") if k in entry), None)
        parts += [m.element("h3", m.joined((t(entry["kind"]), surface_id), " "))]
        parts += [_vector(t(key), entry[key])] if key else []
        parts += [vector_table(entry["parameters"])]
    return m.section("instruments", "Instruments and surfaces", m.joined(parts))


def _vector(what: str, components: list[float | None]) -> Markup:
    return m.note(f"{what}: ({', '.join(m.fixed(x, 6) for x in components)})")
