"""Mistakes planted into simulated surveys, each in three sizes and one or two kinds of survey: what is named?

``python -m tests.acceptance.planted_mistakes RESULTS`` runs what RESULTS (a file of lines) does not have yet, and
prints the outcomes: named first, among three, another one first, refused with the right reason, silent. ``--part 1/2``
runs every second one, ``--again NAME`` (of a mistake, or an outcome) runs what is known once more, ``--seed N`` is that
of the surveys' noise, ``--table`` prints how many of each mistake were named first.
"""

import argparse
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import adjust
from adjust.diagnosis.case import Case
from adjust.diagnosis.diagnosis import Diagnosis, diagnose
from adjust.model.errors import SurveyError
from adjust.model.survey import Survey
from tests.acceptance.planted_images import IMAGE_MISTAKES, Mistake, board_of, camera_of
from tests.acceptance.planted_networks import NETWORK_MISTAKES
from tests.acceptance.planted_surveys import survey_of

__all__ = ["MISTAKES", "board_of", "camera_of", "diagnosed", "outcome_of", "survey_of"]
MISTAKES: tuple[Mistake, ...] = IMAGE_MISTAKES + NETWORK_MISTAKES
SEED = 3


def diagnosed(survey: Survey) -> Diagnosis:
    """The diagnosis of a survey, whether it can be adjusted or not."""
    return diagnose(_adjusted(survey))


def _adjusted(survey: Survey) -> Case:
    try:
        return Case(survey, adjust.solve(survey))
    except SurveyError as error:
        return Case(survey, None, error)


@cache
def _seconds(kind: str, seed: int) -> float:
    """CPU s of adjusting a survey without a mistake."""
    survey, _ = survey_of(kind, seed)
    begin = time.process_time()
    adjust.solve(survey)
    return time.process_time() - begin


def outcome_of(mistake: Mistake, kind: str, size: float, seed: int = SEED) -> dict[str, Any]:
    """outcome; first: what was named first; adjustment (without the mistake), diagnosis: CPU s of either."""
    survey, truth = survey_of(kind, seed)
    case = _adjusted(mistake.plant(survey, truth, size))
    begin = time.process_time()
    found = diagnose(case).candidates
    end = time.process_time()
    about, names = mistake.about(survey), (mistake.name, *mistake.alike)
    right = [c.hypothesis.name in names and (not about or bool({about, *mistake.alike} & {*c.hypothesis.place.ids}))
             for c in found[:3]]  # fmt: skip
    outcome = "first" if right and right[0] else "among three" if any(right) else "another" if right else "silent"
    first = f"{found[0].hypothesis.name} {' '.join(found[0].hypothesis.place.ids)}" if found else ""
    return {"outcome": outcome, "first": first, "adjustment": round(_seconds(kind, seed), 3),
            "diagnosis": round(end - begin, 3)}  # fmt: skip


def rows() -> Iterator[tuple[Mistake, str, float]]:
    """All of them, by mistake, kind of survey and size."""
    for mistake in MISTAKES:
        for kind in mistake.kinds:
            for size in mistake.sizes:
                yield mistake, kind, size


def key(mistake: Mistake, kind: str, size: float) -> str:
    """A row's name in a file of results."""
    return f"{mistake.name}|{mistake.title}|{kind}|{size:.6g}"


def run(results: Path, part: tuple[int, int], again: Sequence[str], seed: int) -> None:
    """Run what is not known yet, and add a line for each."""
    known = read(results)
    for i, (mistake, kind, size) in enumerate(rows()):
        name = key(mistake, kind, size)
        if i % part[1] != part[0] - 1 or (name in known and not any(a in (known[name]["outcome"], mistake.name)
                                                                    for a in again)):  # fmt: skip
            continue
        line = {"key": name, **outcome_of(mistake, kind, size, seed)}
        with results.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        print(f"{name:60} {line['outcome']:12} {line['first'] if line['outcome'] != 'first' else ''}", flush=True)


def read(results: Path) -> dict[str, dict[str, Any]]:
    """The last line of every row."""
    if not results.exists():
        return {}
    lines = [json.loads(line) for line in results.read_text(encoding="utf-8").splitlines()]
    return {line["key"]: line for line in lines}


def counts(results: Mapping[str, Mapping[str, Any]]) -> dict[str, int]:
    """How many of each outcome, of the rows that there are."""
    every = [results[k]["outcome"] for m, kind, size in rows() if (k := key(m, kind, size)) in results]
    return {name: every.count(name) for name in ("first", "among three", "another", "silent")} | {"all": len(every)}


def times(results: Mapping[str, Mapping[str, Any]]) -> str:
    """What a diagnosis takes, in adjustments of the survey without its mistake, and in CPU s."""
    known = [results[k] for m, kind, size in rows() if (k := key(m, kind, size)) in results]
    ratio = np.array([r["diagnosis"] / max(r["adjustment"], 1e-3) for r in known])
    seconds = np.array([r["diagnosis"] for r in known])
    some = [f"{name} {q(ratio):.1f} adjustments, {q(seconds):.2f} s" for name, q in (
        ("median", np.median), ("90 %", lambda x: np.quantile(x, 0.9)), ("worst", np.max))]  # fmt: skip
    return f"{'; '.join(some)}; at most ten in {int((ratio <= 10.0).sum())} of {len(known)}"


def table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """The table of the documentation: what is planted, into which kinds of survey, and what became of it."""
    cells: dict[str, dict[str, list[str]]] = {}
    for mistake, kind, size in rows():
        found = results.get(key(mistake, kind, size))
        if found is not None:
            name = f"{mistake.name}{': ' * bool(mistake.title)}{mistake.title}"
            cells.setdefault(name, {}).setdefault(kind, []).append(found["outcome"])
    lines = ["| mistake | named first, of so many sizes, by kind of survey |", "|---|---|"]
    for name, kinds in sorted(cells.items()):
        each = [f"{kind} {outcomes.count('first')}/{len(outcomes)}" for kind, outcomes in kinds.items()]
        lines.append(f"| {name} | {', '.join(each)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("--part", default="1/1")
    parser.add_argument("--again", action="append", default=[], help="name of a mistake, or an outcome")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--table", action="store_true")
    said = parser.parse_args()
    if said.table:
        print(table(read(said.results)))
        return
    first, of = (int(x) for x in said.part.split("/"))
    run(said.results, (first, of), said.again, said.seed)
    print(counts(read(said.results)))
    print(times(read(said.results)))


if __name__ == "__main__":
    main()
