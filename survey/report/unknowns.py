"""Sections on what was estimated: cameras, stations, tables, targets, points."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from survey.report import camera_plots
from survey.report.context import Context
from survey.report.language import known, t
from survey.report.markup import (
    count,
    esc,
    fixed,
    general,
    pill,
    section,
    sigma_text,
    table,
    value_text,
    with_sigma,
)

_MOST_ROWS = 250
_MANY_EPOCHS = 12
_POSE_COLUMNS = ("<Pose", "<Epoch", "x [mm]", "y [mm]", "z [mm]", "rx [°]", "ry [°]", "rz [°]", "<Status")
_POSE_NOTE = (
    "A pose a_from_b is the origin of b in a and R = Rz Ry Rx. Below each coordinate its sigma along the axes of a in "
    "mm, below each angle the sigma of a small rotation about the same axis of b in arcseconds."
)


def status_pill(status: Any) -> str:
    """The status of a component, or of a whole parameter."""
    if isinstance(status, dict):
        return " ".join(f"{esc(k)} {status_pill(v)}" for k, v in status.items())
    return pill({"free": "quiet", "held": "plain", "prior": "soft", "tied": "soft"}.get(status, "quiet"), known(status))


def _components(entry: dict[str, Any]) -> Iterator[tuple[str, float | None, str, float | None, str, str]]:
    """Name, value, unit, sigma, its unit and status of every component of a vector entry."""
    for name, status in entry["status"].items():
        value_key = next(k for k in entry if k == name or k.startswith(f"{name}_"))
        sigma_key = next(k for k in entry if k == f"sigma_{name}" or k.startswith(f"sigma_{name}_"))
        unit, sigma_unit = value_key[len(name) + 1 :], sigma_key[len(name) + 7 :]
        yield name, entry[value_key], unit, entry[sigma_key], sigma_unit, status


def _value_in(unit: str, value: float | None, sigma: float | None, sigma_unit: str) -> str:
    """A value with decimals that suit a sigma in another unit."""
    same = sigma / 3600.0 if (unit, sigma_unit) == ("deg", "arcsec") and sigma else sigma
    return value_text(value, same)


def vector_table(entry: dict[str, Any], ratios: dict[str, float] | None = None) -> str:
    """Components of a lens, a table or a warp; ``ratios`` adds the column of significance."""
    rows = []
    idle = []
    for name, value, unit, sigma, sigma_unit, status in _components(entry):
        if status == "held" and not value:
            idle.append(f"<code>{esc(name)}</code>")
            continue
        row = [f"<code>{esc(name)}</code>", _value_in(unit, value, sigma, sigma_unit), sigma_text(sigma)]
        shown = unit if unit == sigma_unit else f"{unit} (σ {sigma_unit})"
        row += [esc(shown.replace("_", " ")), status_pill(status)]
        if ratios is not None:
            ratio = ratios.get(name)
            weak = name in entry.get("not_significant", ())
            row.append(pill("warn", fixed(ratio, 1)) if weak else fixed(ratio, 1))
        rows.append(row)
    columns = ["<Parameter", "Value", "σ", "<Unit", "<Status"] + ([] if ratios is None else ["|value| / σ"])
    note = f'<p class="note">{t("Held at zero: {names}.", names=", ".join(idle))}</p>' if idle else ""
    return (table(columns, rows) if rows else "") + note


def pose_row(name: str, epoch: str, entry: dict[str, Any]) -> list[str]:
    """A row of the table of poses."""
    smallest = min((s for s in entry["sigma_translation_mm"] if s), default=None)
    cells = [
        with_sigma(v, s, smallest) for v, s in zip(entry["translation_mm"], entry["sigma_translation_mm"], strict=True)
    ]
    least = min((s for s in entry["sigma_rotation_arcsec"] if s), default=None)
    for angle, sigma in zip(entry["rotation_euler_xyz_deg"], entry["sigma_rotation_arcsec"], strict=True):
        below = f"± {sigma_text(sigma)}″" if sigma else t("held")
        cells.append(f'{_value_in("deg", angle, least, "arcsec")}<span class="s">{below}</span>')
    return [name, esc(epoch), *cells, status_pill(entry["status"])]


def _pose_rows(thing_id: str, entry: dict[str, Any]) -> Iterator[list[str]]:
    """All poses of a thing, also those per epoch."""
    for key, value in entry.items():
        if key == "epochs":
            for epoch, poses in value.items():
                for name, pose in poses.items():
                    if "_from_" in name and isinstance(pose, dict):
                        yield pose_row(f"<b>{esc(thing_id)}</b> <code>{esc(name)}</code>", epoch, pose)
        elif "_from_" in key:
            yield pose_row(f"<b>{esc(thing_id)}</b> <code>{esc(key)}</code>", "", value)


def _limited(columns: tuple[str, ...], rows: list[list[str]]) -> str:
    if not rows:
        return ""
    n = count(len(rows) - _MOST_ROWS)
    more = f'<p class="note">{t("{n} more in solution.json.", n=n)}</p>' if len(rows) > _MOST_ROWS else ""
    return table(columns, rows[:_MOST_ROWS]) + more


def cameras(c: Context) -> str:
    """Every camera: lens, pose, residuals."""
    found = c.adjustment.image_residuals
    blocks = c.adjustment.survey.image_blocks
    camera_of_block = np.array([b.camera_id for b in blocks], dtype=object)
    parts = []
    for camera in c.adjustment.survey.cameras:
        entry = c.solution["cameras"][camera.camera_id]
        mine = (camera_of_block == camera.camera_id)[c.rows.block] if len(blocks) else np.zeros(0, dtype=bool)
        residuals = camera_plots.CameraResiduals(
            camera.camera_id, camera.image_size, c.rows.uv[mine], found.residuals[mine], found.standardized[mine],
            found.used[mine], c.suspect[mine],
        )  # fmt: skip
        parts.append(_camera(camera.camera_id, entry, residuals))
    note = t(
        "Residual vectors point from the observed to the adjusted position. Red: suspect, orange: not used. "
        "A pattern in the mean per cell is what the lens model leaves over; empty cells hold no points."
    )
    return section("cameras", "Cameras", "".join(parts), note)


def _camera(camera_id: str, entry: dict[str, Any], residuals: camera_plots.CameraResiduals) -> str:
    width, height = entry["image_size_px"]
    facts = t(
        "{width} × {height} px on station {station} · {images} images, {points} points", width=width, height=height,
        station=esc(entry["station"]), images=count(entry["n_images"]), points=count(entry["n_image_points"]),
    )  # fmt: skip
    facts += " · " + t("lens model {model}", model=esc(entry["lens"]["model"])) if "lens" in entry else ""
    facts += " · " + t("RMS residual {rms} px", rms=fixed(entry["rms_residual_px"], 3))
    parts = [f'<h3>{t("Camera")} {esc(camera_id)}</h3><p class="note">{facts}</p><div class="panes">']
    if "lens" in entry:
        lens = entry["lens"]
        parts.append('<div class="pane">' + vector_table(lens, lens["value_over_sigma"]) + _remarks(lens) + "</div>")
    if len(residuals.uv):
        drawn = (
            camera_plots.vector_field(residuals),
            camera_plots.mean_field(residuals),
            camera_plots.histogram(residuals),
        )
        parts.append('<div class="pane figures">' + "".join(f"<figure>{x}</figure>" for x in drawn) + "</div>")
    parts.append("</div>")
    rows = [row[:1] + row[2:] for row in _pose_rows(camera_id, entry)]
    columns = _POSE_COLUMNS[:1] + _POSE_COLUMNS[2:]
    return f'<div class="camera">{"".join(parts)}{table(columns, rows) if rows else ""}</div>'


def _remarks(lens: dict[str, Any]) -> str:
    """What is weak about a lens: parameters that could as well be zero, correlations."""
    strong, weak = lens["correlations_over_95_percent"], lens["not_significant"]
    named = ", ".join(
        f"<code>{esc(p['a'])}</code> {t('with')} <code>{esc(p['b'])}</code> {fixed(100 * p['correlation'], 1)} %"
        for p in strong
    )
    # fx and fy of a camera always go together; alone they are no warning
    kind = "warn" if any({p["a"], p["b"]} != {"fx", "fy"} for p in strong) else "quiet"
    correlation = (
        f"{pill(kind, t('correlated above 95 %'))} {named}"
        if strong
        else t("No correlation above 95 % within the lens.")
    )
    remarks = [correlation]
    if weak:
        names = ", ".join(f"<code>{esc(name)}</code>" for name in weak)
        said = t("{names}: not distinguishable from zero at 95 %.", names=names)
        remarks.append(f"{pill('warn', t('not significant'))} {said}")
    return "".join(f'<p class="note">{r}</p>' for r in remarks)


def stations(c: Context) -> str:
    """Poses of stations, of their mounts, of tables and targets."""
    rows = [
        row
        for kind in ("stations", "tables", "targets")
        for i, e in c.solution[kind].items()
        for row in _pose_rows(i, e)
    ]
    by_epoch = [row for row in rows if row[1]]
    body = _limited(_POSE_COLUMNS, rows)
    if len(by_epoch) > _MANY_EPOCHS:
        body = _limited(_POSE_COLUMNS, [row for row in rows if not row[1]])
        title = t("{n} poses by epoch", n=count(len(by_epoch)))
        body += f"<details><summary>{title}</summary>{_limited(_POSE_COLUMNS, by_epoch)}</details>"
    return section("poses", "Poses of stations, tables and targets", body, t(_POSE_NOTE))


def tables(c: Context) -> str:
    """Geometry and angles of every table."""
    parts = []
    for table_id, entry in c.solution["tables"].items():
        axes = t(" then ").join(entry["axes"])
        body = f"<h3>{esc(table_id)}, {t('axes {axes}', axes=esc(axes))}</h3>"
        if "geometry" in entry:
            body += vector_table(entry["geometry"])
        if entry["epochs"]:
            names = list(next(iter(entry["epochs"].values()))["status"])
            columns = ("<Epoch", *(x for n in names for x in (f"{esc(n)} [°]", "σ [″]")))
            rows = [
                [esc(epoch)]
                + [x for _, v, u, s, su, _ in _components(angles) for x in (_value_in(u, v, s, su), sigma_text(s))]
                for epoch, angles in entry["epochs"].items()
            ]
            opened = " open" if len(rows) <= _MANY_EPOCHS else ""
            title = t("{n} epochs: adjusted angles", n=count(len(rows)))
            body += f"<details{opened}><summary>{title}</summary>{_limited(columns, rows)}</details>"
        parts.append(body)
    return section("tables", "Turntables", "".join(parts))


def targets(c: Context) -> str:
    """What the targets are; their poses are listed with those of the stations."""
    rows = []
    warps = ""
    for target_id, entry in c.solution["targets"].items():
        carrier = t("station {name}", name=esc(entry["station"])) if "station" in entry else t("the world")
        rows.append(
            [
                esc(target_id),
                count(entry["n_points"]),
                carrier,
                esc(known(entry["motion"])),
                count(len(entry.get("epochs", {}))),
            ]
        )
        if "warp" in entry:
            warps += f"<h3>{t('Warp of {name}', name=esc(target_id))}</h3>" + vector_table(entry["warp"])
    columns = ("<Target", "Points", "<Stands on", "<Motion", "Poses per epoch")
    return section("targets", "Targets", table(columns, rows) + warps if rows else "")


def points(c: Context) -> str:
    """Coordinates of points, least precise first."""
    entries = sorted(c.solution["points"].items(), key=lambda x: -x[1]["ellipsoid_95_semi_axes_mm"][0])
    worst = entries[0][1]["ellipsoid_95_semi_axes_mm"][0] if entries else 0.0
    rows = []
    every = [p[f"sigma_{a}_mm"] for _, p in entries for a in "xyz" if p[f"sigma_{a}_mm"]]
    typical = float(np.median(every)) if every else None
    for point_id, p in entries:
        axes = p["ellipsoid_95_semi_axes_mm"]
        length = 100.0 * axes[0] / worst if worst else 0.0
        bar = f'<span class="bar"><i style="width:{length:.0f}%"></i></span>'
        row = [f"<b>{esc(point_id)}</b>", *(with_sigma(p[f"{a}_mm"], p[f"sigma_{a}_mm"], typical) for a in "xyz")]
        rows.append([*row, *(sigma_text(a) for a in axes), bar, status_pill(p["status"])])
    columns = ("<Point", "x [mm]", "y [mm]", "z [mm]", "a [mm]", "b [mm]", "c [mm]", "<", "<Status")
    note = t(
        "World coordinates with sigmas below; a, b, c: semi-axes of the 95 % confidence ellipsoid ({k} sigmas). "
        "Least precise first.",
        k=general(c.scale.ellipsoid, 4),
    )
    return section("points", "Points", _limited(columns, rows), note)
