"""What the views of the workbench show, as plain values: state, findings, parameters, scene, exclusions."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.observations import Reading
from survey.folder.plain import attributes, plain
from survey.folder.text import suggestion
from survey.project.observed import Observed, name_of_residual
from survey.report.language import message
from survey.solution.earlier.runs import list_runs
from survey.solution.frames import AdjustedFrames
from survey.solution.quantities import (
    ARCSEC_PER_RAD,
    motion_columns,
    sigma_unit_for_people,
    sigmas_of,
    status_of,
    unit_for_people,
)
from survey.solution.verdict import suspects
from survey.workbench.places import Places, refs_of
from survey.workbench.resident import Resident
from survey.workbench.rows import columns, reading_rows

if TYPE_CHECKING:
    from survey.solution.dictionary import RunInfo

_MOST_LOOPS = 1000


def limits(bench: Resident) -> tuple[float, float]:
    """Of ``|w|`` of image points (square root of the chi-square test's) and of other observations."""
    adjustment = bench.situation.adjustment
    found = bench.kept if adjustment is None else suspects(adjustment)
    return (1.0, 1.0) if found is None else (float(np.sqrt(found.image_limit)), found.w_limit)


def state(bench: Resident) -> dict[str, Any]:
    """What there is, how it stands, and what can be done; the tree of names among it."""
    now = bench.situation
    solved, empty = now.adjustment, now.everything.is_empty
    return dict(plain({
        "version": bench.version, "folder": str(bench.folder), "title": now.project.title,
        "read_only": bench.read_only, "lock": bench.holder(), "changed_files": bench.changed_files(),
        "unsaved": bench.n_unsaved, "undo": [*map(message, bench.undoable)], "redo": [*map(message, bench.redoable)],
        "solution": None if solved is None else in_words(now.solved.snapshot.summary) | {
            "mode": now.mode, "seconds": now.seconds, "sigmas": bench.scale.sigmas},
        "kept": None if bench.kept is None else in_words(bench.kept.summary) | {"date": bench.kept.date},
        "warnings": [message(w) for w in warnings_of(bench)],
        "failure": None if bench.failure is None or empty else message(str(bench.failure)),
        "empty": empty, "n_looked_at": len(now.everything.detected),
        "n_pictures": len(now.everything.images),
        "exclusions": [e.as_dict() | {"line": e.line} for e in now.exclusions.values()],
        "tree": _tree(bench),
        "groups": [] if solved is None else [
            attributes(g, "group", "n_observations", "redundancy", "omega", "factor")
            | {"scale": now.project.sigmas.scale.get(g.group, 1.0)} for g in solved.groups],
        "datum": {"kind": now.project.survey.datum.kind, "points": now.project.survey.datum.points,
                  "stations": now.project.survey.datum.stations},
    }))  # fmt: skip


def in_words(summary: Mapping[str, Any]) -> dict[str, Any]:
    """A summary with its reason in the language that is spoken."""
    return {**summary, "reason": message(str(summary["reason"]))}


def warnings_of(bench: Resident) -> Sequence[str]:
    """Of the solution, or of the results until there is one."""
    found = bench.situation.judgement or bench.kept
    return () if found is None else found.warnings


def _tree(bench: Resident) -> dict[str, Any]:
    survey, project = bench.situation.survey, bench.situation.project
    images: dict[str, list[str]] = {c.camera_id: [] for c in survey.cameras}
    seen = dict.fromkeys([*project.images, *((b.camera_id, b.epoch_id) for b in survey.image_blocks)])
    for camera, epoch in seen:
        images.setdefault(camera, []).append(epoch)
    epochs = dict.fromkeys([*(e for _, e in seen), *(r.epoch_id for r in survey.table_readings)])
    return {
        "cameras": [{"id": c.camera_id, "station": c.station_id, "size": list(c.image_size),
                     "images": images[c.camera_id]} for c in survey.cameras],
        "epochs": list(epochs),
        "targets": [t.target_id for t in survey.targets], "stations": [s.station_id for s in survey.stations],
        "tables": [t.table_id for t in survey.tables], "points": [p.point_id for p in survey.points],
    }  # fmt: skip


def points(
    bench: Resident, camera: str = "", epoch: str = "", worst: int = 0, known: int | None = None
) -> bytes:
    """Image points as :func:`survey.workbench.rows.columns`: all, those of one image, or the ``worst`` by ``|w|``.

    known: the layout of the rows that the page has; where it is still that, only what the solution says of all.
    """
    rows, chosen = bench.rows, None
    if camera and epoch:
        chosen = rows.in_image(camera, epoch)
    elif 0 < worst < len(rows.test):
        chosen = np.sort(np.argpartition(-np.nan_to_num(rows.test, nan=-1.0), worst)[:worst])
    whole = chosen is not None or known != bench.layout
    return columns(rows, limits(bench)[0], bench.version, chosen, bench.layout, whole)


def readings(bench: Resident) -> dict[str, Any]:
    """All observations that are no image points."""
    now = bench.situation
    limit = limits(bench)[1]
    rows = reading_rows(now.everything.survey, now.left, now.adjustment, limit)
    return {"version": bench.version, "limit": limit, "rows": rows}


def parameters(bench: Resident) -> dict[str, Any]:
    """Every component of every parameter: value, sigma and status in the units shown, as columns.

    The turns of a pose are Euler angles (deg) with R = Rz Ry Rx, beside the sigma of a small turn about the same axis.
    A column of texts has each of them once: ``texts``, and by row their places, ``codes``.
    """
    out: dict[str, list[Any]] = {k: [] for k in ("name", "component", "value", "unit", "sigma", "sigma_unit", "status")}
    poses = {name: e.value for name, e in bench.adjustment.estimates.items() if isinstance(e.value, Pose3)}
    matrices = np.array([pose.matrix() for pose in poses.values()]).reshape(-1, 4, 4)
    motions = motion_columns(matrices[:, :3, :3], matrices[:, :3, 3])
    turned = dict(zip(poses, motions["rotation_euler_xyz_deg"].tolist(), strict=True))
    for name, e in bench.adjustment.estimates.items():
        sigmas, turns = sigmas_of(e, bench.scale), turned.get(name)
        values = np.asarray(e.value.translation() if isinstance(e.value, Pose3) else e.value, dtype=float).tolist()
        values = [*np.radians(turns or []).tolist(), *values]
        one = status_of(e)
        for k, component in enumerate(e.components):
            unit, factor = unit_for_people(component, e.units[k])
            sigma_unit, sigma_factor = sigma_unit_for_people(e.units[k], component)
            status = one if isinstance(one, str) else one[component]
            row = ("/".join(name), component, values[k] * factor, unit, sigmas[k] * sigma_factor,
                   sigma_unit, status)  # fmt: skip
            for key, value in zip(out, row, strict=True):
                out[key].append(value)
    columns = {k: values if k in ("value", "sigma") else _coded(values) for k, values in out.items()}
    return {"version": bench.version, "sigmas": bench.scale.sigmas, "columns": plain(columns)}


def _coded(values: Sequence[str]) -> dict[str, list[Any]]:
    places: dict[str, int] = {}
    codes = [places.setdefault(value, len(places)) for value in values]
    return {"texts": list(places), "codes": codes}


def runs(bench: Resident) -> dict[str, Any]:
    """The runs that were kept, the last first."""
    found = [r.as_dict() for r in reversed(list_runs(bench.folder))]
    return {"version": bench.version, "runs": [r | {"summary": in_words(r["summary"])} for r in found]}


def scene(bench: Resident) -> dict[str, Any]:
    """Cameras, targets, tables, points and stations in the world (m), covariances (m^2) as sigmas are given."""
    from survey.report.scene import scene_values

    return {"version": bench.version, **scene_values(bench.adjustment, bench.scale)}


def run(bench: Resident) -> "RunInfo":
    """What was run, for reports."""
    from survey.jobs.adjusting.outcome import run_info

    return run_info(bench.situation.project, {})


def loops(bench: Resident) -> dict[str, Any]:
    """The loops of measured pairs that close worst, and how many there are; None where there are none."""
    from survey.solution.dictionary import solution_dict

    solution = solution_dict(bench.adjustment, run(bench), None)
    found = solution.get("loops")
    if found is not None:
        found = found | {"worst_first": found["worst_first"][:_MOST_LOOPS]}
    return {"version": bench.version, "loops": found, "network": solution.get("network")}


def table_residuals(bench: Resident) -> dict[str, Any]:
    """Residuals of turntables (arcsec) over the adjusted angles (deg) of all their axes, by table, in use or not."""
    out: dict[str, list[dict[str, Any]]] = {}
    for o in bench.adjustment.other_residuals:
        if o.kind == "table":
            out.setdefault(o.ids[0], []).append({
                "epoch": o.ids[-1], "id": name_of_residual(o), "angles_deg": np.degrees(o.adjusted),
                "residual_arcsec": ARCSEC_PER_RAD * o.residual, "sigma_arcsec": ARCSEC_PER_RAD * o.sigma,
                "w": o.standardized, "used": o.used,
            })  # fmt: skip
    return dict(plain({"version": bench.version, "tables": out}))


PARTS = {
    "solution": None, "reliability": "reliability", "correlations": "correlated_above_95_percent",
    "weak": "weak_directions", "relative": "relative_precision", "budget": "budget", "consistency": "consistency",
    "tolerances": "tolerances", "components": "variance_components", "outliers": "outliers",
}  # fmt: skip
"""What statistics there are, by the key of ``solution.json`` that has them; ``solution``: all of it."""


def statistics_part(bench: Resident, part: str) -> dict[str, Any]:
    """A part of what ``solution.json`` says, one of ``PARTS``; computed when first asked for. Raises SurveyError."""
    from survey.solution.dictionary import solution_dict

    if part not in PARTS:
        raise SurveyError(f"there are no statistics {part!r}; {suggestion(part, PARTS)}")
    solution, key = solution_dict(bench.adjustment, run(bench), bench.statistics), PARTS[part]
    return {"version": bench.version, part: solution if key is None else solution[key]}


def network(bench: Resident) -> dict[str, Any]:
    """Every reading that joins places, and the set-ups of instruments.

    lines: ``id``, ``table``, ``kind``, ends in the world ``x`` (m), largest ``w`` of its components and ``share`` of
    the limit, ``why`` as of readings. marks: the same of readings of a single place. n_nowhere: readings of which an
    end has no place. setups: ``id``, ``instrument``, ``x``, ``n`` readings. Raises SurveyError where nothing is solved.
    """
    survey, solved = bench.situation.everything.survey, bench.adjustment
    places = Places(AdjustedFrames(solved), solved.survey.points)
    found: dict[str, dict[str, Any]] = {}
    for row in readings(bench)["rows"]:
        if row["id"] not in found or (row["share"] or 0.0) > (found[row["id"]]["share"] or 0.0):
            found[row["id"]] = {k: row[k] for k in ("id", "table", "w", "share", "why")}
    out: dict[str, Any] = {"lines": [], "marks": [], "n_nowhere": 0}
    setups: dict[str, dict[str, Any]] = {}
    instruments = {s.setup_id: s.instrument_id for s in survey.setups}
    for name, where in Observed(survey, ()).readings.items():
        field, i = where[0]
        item = getattr(survey, field)[i]
        known = places.lines(item)
        out["n_nowhere"] += not known and bool(refs_of(item))
        said = found[name] | {"kind": getattr(item, "kind", found[name]["table"])}
        for line in known:
            out["lines" if len(line) > 1 else "marks"].append({**said, "x": line})
        if isinstance(item, Reading) and item.setup_id and known:
            one = setups.setdefault(item.setup_id, {"id": item.setup_id, "x": known[0][0], "n": 0,
                                                    "instrument": instruments.get(item.setup_id)})  # fmt: skip
            one["n"] += 1
    return dict(plain({"version": bench.version, **out, "setups": list(setups.values())}))
