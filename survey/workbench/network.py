"""The network of the readings: between which places each was taken, and how well it fits."""

from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.model.observations import FrameRef, PositionRef, Reading
from adjust.model.survey import FloatArray
from survey.project.observed import Observed
from survey.solution.dictionary import plain
from survey.solution.frames import AdjustedFrames
from survey.workbench.rows import refs_of
from survey.workbench.session import Workbench
from survey.workbench.views import readings


class _Places:
    """Where in the world (m) a reference of a reading is; None where the solution does not tell."""

    def __init__(self, bench: Workbench) -> None:
        self.frames = AdjustedFrames(bench.adjustment)
        self.points = {p.point_id: p for p in bench.adjustment.survey.points}

    def point(self, point_id: str) -> FloatArray | None:
        """An adjusted point, or the value at which it is held."""
        found = self.frames.estimates.get(("point", point_id))
        value = found.value if found is not None else \
            self.points[point_id].x_in_world.value if point_id in self.points else None  # fmt: skip
        return None if value is None or isinstance(value, Pose3) else np.asarray(value, dtype=float)

    def of(self, ref: FrameRef | PositionRef) -> FloatArray | None:
        """Of the origin of a frame, of a point, or of a point of a target."""
        frame = ref if isinstance(ref, FrameRef) else ref.frame
        point_id = None if isinstance(ref, FrameRef) else ref.point_id
        if frame is None:
            return self.point(point_id or "")
        pose = self.frames.world_from(frame)
        target = self.frames.targets.get(frame.frame_id) if frame.kind == "target" else None
        if pose is None or (point_id is not None and (target is None or point_id not in target.point_ids)):
            return None
        if target is not None and point_id is not None:
            return np.asarray(pose.transformFrom(target.x_in_target[target.point_ids.index(point_id)]))
        return np.asarray(pose.translation())


def network(bench: Workbench) -> dict[str, Any]:
    """Every reading that joins places, and the set-ups of instruments.

    lines: ``id``, ``table``, ``kind``, ends in the world ``x`` (m), largest ``w`` of its components and ``share`` of
    the limit, ``why`` as of readings. marks: the same of readings of a single place. n_nowhere: readings of which an
    end has no place. setups: ``id``, ``instrument``, ``x``, ``n`` readings. Raises SurveyError where nothing is solved.
    """
    places, survey = _Places(bench), bench.situation.everything.survey
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
        ends = [[places.of(ref) for ref in line] for line in _lines(item)]
        known = [line for line in ends if all(x is not None for x in line)]
        out["n_nowhere"] += bool(ends) and not known
        said = found[name] | {"kind": getattr(item, "kind", found[name]["table"])}
        for line in known:
            out["lines" if len(line) > 1 else "marks"].append({**said, "x": line})
        if isinstance(item, Reading) and item.setup_id and known:
            one = setups.setdefault(item.setup_id, {"id": item.setup_id, "x": known[0][0], "n": 0,
                                                    "instrument": instruments.get(item.setup_id)})  # fmt: skip
            one["n"] += 1
    return dict(plain({"version": bench.version, **out, "setups": list(setups.values())}))


def _lines(item: Any) -> list[tuple[FrameRef | PositionRef, ...]]:
    """Between what a reading was taken: differences of coordinates in pairs, others from the first to all others."""
    if isinstance(getattr(item, "at", None), tuple):
        return list(zip(item.at, item.to, strict=True))
    refs = refs_of(item)
    if len(refs) < 2 or hasattr(item, "positions"):
        return [(ref,) for ref in refs]
    return [(refs[0], ref) for ref in refs[1:]]
