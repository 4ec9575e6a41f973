"""The jobs ``plan`` (what a network of pairs will tell, before it is measured) and ``add`` (let one grow)."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.observations import Pair
from survey.jobs.changing import Change, ChangeOutcome, changed_project
from survey.project import Definition, read_definition
from survey.project.merging import merge, read_merged
from survey.project.project import OBSERVATIONS_FOLDER
from survey.project.tables.files import read_table
from survey.project.tables.layouts import (
    COVARIANCE_COLUMNS,
    EULER,
    PAIRS,
    QUATERNION,
    SIGMA_COLUMNS,
    TRANSLATION,
)
from survey.project.tables.pairs import read_ends
from survey.project.tables.reading import Table
from survey.project.tables.references import Names
from survey.solution.earlier.runs import command_line
from survey.solution.network.counts import network_dict, pair_network

_MOST_SHOWN = 8
_MOST_NAMED = 12


@frozen
class PlanOutcome:
    """What can be said before measuring, section by section; ``problems`` for people, worst first."""

    folder: Path
    title: str
    sections: dict[str, dict[str, Any]]
    problems: tuple[str, ...]

    def summary(self) -> dict[str, Any]:
        """As plain values."""
        return {"folder": str(self.folder), "title": self.title, **self.sections, "problems": list(self.problems)}

    def text(self) -> str:
        """For people."""
        n = self.sections["network"]
        what = "poses" if n["equations_per_condition"] == 6 else "rotations"
        through = n["conditions_through_given_stations"]
        lines = [
            f"{self.title or self.folder}: {n['n_stations']} stations, {n['measured_pairs']} of "
            f"{n['measurable_pairs']} measurable pairs",
            *(f"  ! {problem}" for problem in self.problems),
            "",
            f"  independent unknown {what:<10}{n['independent_unknown_poses']:>8}",
            f"  triangle conditions           {n['triangle_conditions']:>8}",
            f"  independent conditions        {n['independent_conditions']:>8}"
            + (f"   ({through} of them through given stations)" if through else ""),
            f"  redundancy                    {n['redundancy']:>8}   equations",
            f"  conditions per pair           {n['conditions_per_pair']:>8.2f}",
        ]
        groups = n["inseparable_pairs"]
        lines += [f"  errors seen but not told apart: {listed(group, _MOST_NAMED)}" for group in groups[:_MOST_SHOWN]]
        lines += [f"  and {len(groups) - _MOST_SHOWN} more such groups"] if len(groups) > _MOST_SHOWN else []
        return "\n".join(lines)


def plan_job(folder: Path) -> PlanOutcome:
    """Count what the pairs of a project will tell; they need no values yet. Raises SurveyError."""
    definition = read_definition(Path(folder))
    path = next((p for ending in ("csv", "parquet")
                 if (p := definition.folder / OBSERVATIONS_FOLDER / f"pairs.{ending}").is_file()), None)  # fmt: skip
    if path is None:
        raise SurveyError(
            f"{definition.folder / OBSERVATIONS_FOLDER}/pairs.csv: there is no such file; list the pairs to be "
            "measured in it: pair_id,a_id,b_id (values may follow later). What images will tell is planned by "
            f"{definition.folder / 'plan.toml'}, which is not there either"
        )
    survey = replace(definition.survey, pairs=_planned(read_table(path, PAIRS), Names.of(definition.survey)))
    network = network_dict(pair_network(survey))
    return PlanOutcome(definition.folder, definition.title, {"network": network}, _problems(definition, network))


def _planned(table: Table, names: Names) -> tuple[Pair, ...]:
    """Pairs by their ends; rotations where the table has values, but none of a translation."""
    ids, used = table.unique_ids("pair_id"), table.flags("used").tolist()
    shifts = (*TRANSLATION, *(c for cs in SIGMA_COLUMNS["translation"] for c in cs), COVARIANCE_COLUMNS[-1])
    turns = (*QUATERNION, *EULER, *(c for cs in SIGMA_COLUMNS["rotation"] for c in cs), COVARIANCE_COLUMNS[0])
    shift, turn = _filled(table, shifts), _filled(table, turns)
    out = []
    for row, (a, b) in enumerate(read_ends(table, names)):
        rotation_only = bool(turn[row] and not shift[row])
        motion = Rot3() if rotation_only else Pose3()
        out.append(Pair(ids[row], a, b, motion, np.eye(3 if rotation_only else 6), used=used[row]))
    return tuple(out)


def _filled(table: Table, columns: Sequence[str]) -> list[bool]:
    """Rows in which any of the columns has a value."""
    missing = np.isnan(np.stack([table.numbers(c) for c in columns], axis=1))
    return [not all(row) for row in missing.tolist()]


def _problems(definition: Definition, network: dict[str, Any]) -> tuple[str, ...]:
    out = []
    parts = network["parts"]
    if parts:
        named = " | ".join(listed(part, _MOST_NAMED) for part in parts[:6]) + (" | ..." if len(parts) > 6 else "")
        beside = ", unless images join them" if definition.survey.cameras else ""
        out.append(f"the pairs leave {len(parts)} parts that hang together by nothing{beside}: {named}")
    if definition.survey.datum.kind == "given" and not network["given_stations"] and not definition.survey.cameras:
        out.append('no station is held or has a prior; hold one, or write [datum] kind = "inner"')
    if network["uncontrolled_pairs"]:
        out.append(
            f"close no loop, so that nobody would notice an error in them: "
            f"{listed(network['uncontrolled_pairs'], _MOST_NAMED)}; measure a second way to what they lead to"
        )
    return tuple(out)


def add_job(folder: Path, new: Path, *, out: Path | None = None, progress: bool = True) -> ChangeOutcome:
    """Add what is in ``new`` to the adjusted project ``folder``, or to a copy of it at ``out``. Raises SurveyError.

    The project is as before whatever goes wrong.
    """
    folder, new = Path(folder), Path(new)

    def grown(place: Path) -> Change:
        merged = merge(folder, new, place)
        added: dict[str, Sequence[str] | int] = {**merged.new_ids, **merged.rows}
        said = "; ".join(f"{kind} {_added(what)}" for kind, what in added.items())
        return Change(read_merged(merged, out or folder), merged.entries, command_line("add", folder, new, out=out),
                      {"added": added}, (f"added: {said}",), told=True)  # fmt: skip

    return changed_project(folder, out, grown, progress=progress, compared=True)


def _added(what: Sequence[str] | int) -> str:
    return str(what) if isinstance(what, int) else listed(what, _MOST_NAMED)
