"""What is suspect or was left out by the last adjustment, worst first, and what would mend it."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from survey.folder.plain import attributes, plain
from survey.report.anchors import ANCHORED, anchor, anchors_in
from survey.report.language import message
from survey.workbench.resident import Resident
from survey.workbench.rows import BY_THIS_RUN, IN_USE
from survey.workbench.situation import in_complex
from survey.workbench.views.project import in_words, limits, readings, warnings_of

if TYPE_CHECKING:
    from adjust.diagnosis.hypothesis import Place

_MOST_FINDINGS = 100
_MOST_FITTING = 20
_CAUSE = "probable cause: "


def findings(bench: Resident) -> dict[str, Any]:
    """The verdict, warnings, and what is suspect or was left out by this run, worst first, each with its remedies.

    remedies: what the diagnosis says would mend it; also of a survey that cannot be adjusted, of which nothing else is
    known.
    """
    found, kept = bench.situation.judgement, bench.kept
    known: dict[str, Any] = {"verdict": "failed", "reason": message(str(bench.failure or "")), "warnings": [],
                             "causes": [], "n_failing": 0, "findings": []}  # fmt: skip
    said = kept if found is None else found.snapshot
    if said is not None:
        known = _of_solution(bench, in_words(said.summary))
    return dict(plain({"version": bench.version, **known, "remedies": remedies(bench)}))


def remedies(bench: Resident) -> list[dict[str, Any]]:
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
    """Where a hypothesis sits, as a place of the page: of a table the reading, where it is one."""
    if place.kind == "table" and len(place.epochs) == 1:
        return anchor("reading", f"table_angles:{'/'.join((*place.ids, *place.epochs))}")
    return anchor(place.kind, "/".join(place.ids)) if place.kind in ANCHORED and place.ids else None


def _of_solution(bench: Resident, summary: Mapping[str, Any]) -> dict[str, Any]:
    (image_limit, limit), warnings = limits(bench), warnings_of(bench)
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


def _of_points(bench: Resident, limit: float) -> Iterable[dict[str, Any]]:
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


def _exclude(bench: Resident, name: str, row: int | None = None) -> dict[str, Any]:
    if row is not None and row >= sum(len(b.uv) for b in bench.situation.everything.survey.image_blocks):
        name = _spot_name(bench, row)
    return {"label": f"exclude {name}", "changes": [{"name": name, "excluded": True}]}


def _spot_name(bench: Resident, row: int) -> str:
    """The name under which a spot that has got a name is left out, by its row; raises IndexError for others."""
    at, there = row, bench.situation.everything
    at -= sum(len(b.uv) for b in there.survey.image_blocks)
    for block in bench.situation.identified:
        if 0 <= at < len(block.uv):
            place, z = (block.camera_id, block.epoch_id), complex(*block.uv[at].tolist())
            return next(f"spot:{'/'.join(place)}/{name}" for s in there.spots for name, spot in
                        zip(s.spot_ids, in_complex(s.uv), strict=True)
                        if (s.camera_id, s.epoch_id) == place and spot == z)  # fmt: skip
        at -= len(block.uv)
    raise IndexError(row)


def _of_readings(bench: Resident, limit: float) -> Iterable[dict[str, Any]]:
    for row in readings(bench)["rows"]:
        if row["w"] is not None and row["why"] in (IN_USE, BY_THIS_RUN):
            yield {
                "kind": "reading", "id": row["id"], "anchor": anchor("reading", row["id"]), "image": None,
                "component": row["component"], "limit": limit, "unit": row["sigma_unit"],
                **{k: row[k] for k in ("w", "share", "redundancy", "residual", "why")},
                "remedies": [_exclude(bench, row["id"])],
            }  # fmt: skip


def _of_images(bench: Resident, failing: list[dict[str, Any]]) -> list[dict[str, Any]]:
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
