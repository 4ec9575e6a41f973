"""What the views of the workbench show, as plain values: state, findings, parameters, scene, exclusions."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.observations import Reading
from adjust.model.result import Adjustment
from survey.folder.plain import attributes, plain
from survey.folder.text import suggestion
from survey.project.observed import Observed, name_of_residual
from survey.report.anchors import ANCHORED, anchor, anchors_in
from survey.report.language import message
from survey.solution.earlier.changes import snapshot
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
from survey.workbench.jobs import Jobs
from survey.workbench.places import Places, refs_of
from survey.workbench.rows import BY_THIS_RUN, IN_USE, columns, reading_rows

if TYPE_CHECKING:
    from adjust.diagnosis.hypothesis import Place

_MOST_FINDINGS = 100
_MOST_FITTING = 20
_CAUSE = "probable cause: "


def limits(bench: Jobs) -> tuple[float, float]:
    """Of ``|w|`` of image points (square root of the chi-square test's) and of other observations."""
    adjustment = bench.situation.adjustment
    found = bench.kept if adjustment is None else suspects(adjustment)
    return (1.0, 1.0) if found is None else (float(np.sqrt(found.image_limit)), found.w_limit)


def state(bench: Jobs) -> dict[str, Any]:
    """What there is, how it stands, and what can be done; the tree of names among it."""
    now = bench.situation
    solved, empty = now.adjustment, now.everything.is_empty
    return dict(plain({
        "version": bench.version, "folder": str(bench.folder), "title": now.project.title,
        "read_only": bench.read_only, "lock": bench.holder(), "changed_files": bench.changed_files(),
        "unsaved": bench.n_unsaved, "undo": [*map(message, bench.undoable)], "redo": [*map(message, bench.redoable)],
        "solution": None if solved is None else _summary(solved) | {
            "mode": now.mode, "seconds": now.seconds, "sigmas": bench.scale.sigmas},
        "kept": None if bench.kept is None else in_words(bench.kept.summary) | {"date": bench.kept.date},
        "warnings": [message(w) for w in _warnings(bench)],
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


def _summary(solved: Adjustment) -> dict[str, Any]:
    return in_words(snapshot(solved).summary)


def in_words(summary: Mapping[str, Any]) -> dict[str, Any]:
    """A summary with its reason in the language that is spoken."""
    return {**summary, "reason": message(str(summary["reason"]))}


def _warnings(bench: Jobs) -> Sequence[str]:
    """Of the solution, or of the results until there is one."""
    found = bench.situation.adjustment or bench.kept
    return () if found is None else found.warnings


def _tree(bench: Jobs) -> dict[str, Any]:
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
    bench: Jobs, camera: str = "", epoch: str = "", worst: int = 0, known: int | None = None
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


def readings(bench: Jobs) -> dict[str, Any]:
    """All observations that are no image points."""
    now = bench.situation
    limit = limits(bench)[1]
    rows = reading_rows(now.everything.survey, now.left, now.adjustment, limit)
    return {"version": bench.version, "limit": limit, "rows": rows}


def parameters(bench: Jobs) -> dict[str, Any]:
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


def findings(bench: Jobs) -> dict[str, Any]:
    """The verdict, warnings, and what is suspect or was left out by this run, worst first, each with its remedies.

    remedies: what the diagnosis says would mend it; also of a survey that cannot be adjusted, of which nothing else is
    known.
    """
    solved = bench.situation.adjustment
    known: dict[str, Any] = {"verdict": "failed", "reason": message(str(bench.failure or "")), "warnings": [],
                             "causes": [], "n_failing": 0, "findings": []}  # fmt: skip
    kept = bench.kept
    if solved is not None or kept is not None:
        known = _of_solution(bench, in_words(kept.summary) if kept is not None else _summary(bench.adjustment))
    return dict(plain({"version": bench.version, **known, "remedies": remedies(bench)}))


def remedies(bench: Jobs) -> list[dict[str, Any]]:
    """The candidates of the diagnosis, the best first: cause, change, evidence, and whether a program can do it."""
    out = []
    for number, candidate in enumerate(bench.remedies, start=1):
        h = candidate.hypothesis
        out.append({
            "number": number, "name": h.name, "cause": message(h.cause), "change": message(h.change),
            "possible": bool(h.edits), "anchor": _anchor_of(h.place),
            **attributes(candidate, "where", "explained", "statistic", "critical", "probability", "sigma0"),
        })  # fmt: skip
    return out


def _anchor_of(place: "Place") -> str | None:
    """Where a hypothesis sits, as a place of the page."""
    return anchor(place.kind, "/".join(place.ids)) if place.kind in ANCHORED and place.ids else None


def _of_solution(bench: Jobs, summary: Mapping[str, Any]) -> dict[str, Any]:
    (image_limit, limit), warnings = limits(bench), _warnings(bench)
    found = [*_of_points(bench, image_limit), *_of_readings(bench, limit)]
    worst = sorted(found, key=lambda f: -(f["share"] or 0.0))
    failing = [f for f in worst if f["why"] == BY_THIS_RUN or (f["share"] or 0.0) > 1.0]
    fitting = [f for f in worst if f["why"] == IN_USE and (f["share"] or 0.0) <= 1.0]
    told = bench.diagnosis.lines if bench.diagnosis is not None else ()
    causes = [w.removeprefix(_CAUSE) for w in warnings if w.startswith(_CAUSE)]
    shown = [*_of_images(bench, failing), *failing[:_MOST_FINDINGS], *fitting[:_MOST_FITTING]]
    return {
        **{k: v for k, v in summary.items() if k in ("verdict", "reason")},
        "warnings": [_said(w) for w in warnings if not w.startswith(_CAUSE)],
        "causes": [_said(c) for c in causes if c not in told], "n_failing": len(failing), "findings": shown,
    }  # fmt: skip


def _said(text: str) -> dict[str, Any]:
    """A message in the reader's language, with the places it names."""
    return {"text": message(text), "anchors": anchors_in(text)}


def _of_points(bench: Jobs, limit: float) -> Iterable[dict[str, Any]]:
    rows = bench.rows
    test = np.where((rows.why == IN_USE) | (rows.why == BY_THIS_RUN), np.nan_to_num(rows.test, nan=-1.0), -1.0)
    most = min(_MOST_FINDINGS + _MOST_FITTING, len(test))
    largest = np.sort(np.argpartition(-test, most - 1)[:most]) if most else np.zeros(0, dtype=np.int64)
    for row in largest[np.argsort(-test[largest], kind="stable")].tolist():
        if test[row] >= 0.0:
            name, w = rows.id_of(row), float(np.sqrt(test[row]))
            yield {
                "kind": "image_point", "id": f"image_point:{name}", "anchor": anchor("obs", f"image_point:{name}"),
                "image": "/".join(name.split("/")[:2]), "w": w, "limit": limit, "share": w / limit,
                "redundancy": rows.redundancy[row].mean(), "residual": rows.residuals[row], "unit": "px",
                "why": int(rows.why[row]), "remedies": [_exclude(bench, f"image_point:{name}", row)],
            }  # fmt: skip


def _exclude(bench: Jobs, name: str, row: int | None = None) -> dict[str, Any]:
    if row is not None and row >= sum(len(b.uv) for b in bench.situation.everything.survey.image_blocks):
        name = bench.spot_name(row)
    return {"label": f"exclude {name}", "changes": [{"name": name, "excluded": True}]}


def _of_readings(bench: Jobs, limit: float) -> Iterable[dict[str, Any]]:
    for row in readings(bench)["rows"]:
        if row["w"] is not None and row["why"] in (IN_USE, BY_THIS_RUN):
            yield {
                "kind": "reading", "id": row["id"], "anchor": anchor("reading", row["id"]), "image": None,
                "component": row["component"], "limit": limit, "unit": row["sigma_unit"],
                **{k: row[k] for k in ("w", "share", "redundancy", "residual", "why")},
                "remedies": [_exclude(bench, row["id"])],
            }  # fmt: skip


def _of_images(bench: Jobs, failing: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Images of which a fifth of the points or more do not fit: the image is wrong rather than each of them."""
    counts: dict[str, int] = {}
    for f in failing:
        if f["image"]:
            counts[f["image"]] = counts.get(f["image"], 0) + 1
    out = []
    for image, n in counts.items():
        rows = bench.rows.in_image(*image.split("/"))
        if n >= 4 and 5 * n >= len(rows):
            out.append({"kind": "image", "id": f"image:{image}", "anchor": anchor("image", image), "image": image,
                        "w": None, "share": None, "why": BY_THIS_RUN, "n_points": n, "n_in_image": len(rows),
                        "remedies": [_exclude(bench, f"image:{image}")]})  # fmt: skip
    return out


def runs(bench: Jobs) -> dict[str, Any]:
    """The runs that were kept, the last first."""
    found = [r.as_dict() for r in reversed(list_runs(bench.folder))]
    return {"version": bench.version, "runs": [r | {"summary": in_words(r["summary"])} for r in found]}


def scene(bench: Jobs) -> dict[str, Any]:
    """Cameras, targets, tables, points and stations in the world (m), covariances (m^2) as sigmas are given."""
    from survey.report.scene import scene_values

    return {"version": bench.version, **scene_values(bench.adjustment, bench.scale)}


def loops(bench: Jobs) -> dict[str, Any]:
    """Loops of measured pairs and how they close, the worst first; None where there are none."""
    from survey.solution.dictionary import solution_dict

    solution = solution_dict(bench.adjustment, bench.run(), None)
    return {"version": bench.version, "loops": solution.get("loops"), "network": solution.get("network")}


def table_residuals(bench: Jobs) -> dict[str, Any]:
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


def statistics_part(bench: Jobs, part: str) -> dict[str, Any]:
    """A part of what ``solution.json`` says, one of ``PARTS``; computed when first asked for. Raises SurveyError."""
    from survey.solution.dictionary import solution_dict

    if part not in PARTS:
        raise SurveyError(f"there are no statistics {part!r}; {suggestion(part, PARTS)}")
    solution, key = solution_dict(bench.adjustment, bench.run(), bench.statistics), PARTS[part]
    return {"version": bench.version, part: solution if key is None else solution[key]}


def network(bench: Jobs) -> dict[str, Any]:
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
