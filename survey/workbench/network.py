"""The network of the readings: between which places each was taken, and how well it fits."""

from typing import Any

from adjust.model.observations import Reading
from survey.project.observed import Observed
from survey.solution.dictionary import plain
from survey.solution.frames import AdjustedFrames
from survey.workbench.places import Places, refs_of
from survey.workbench.session import Workbench
from survey.workbench.views import readings


def network(bench: Workbench) -> dict[str, Any]:
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
