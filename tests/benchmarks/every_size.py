"""Every command at every size: processor time of its steps, memory, exponents; and what two threads can do at most.

``python -m tests.benchmarks.every_size --kinds "board points" pairs --sizes 1000 10000`` (all of both without), and
``--threads 1 2`` for the Amdahl table of the last size of each kind: everything is done in turn and timed by the
processor, so that other work on the machine does not matter, and what would have stood beside each other is added up.
"""

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from adjust.model.survey import PointParameter, Survey
from survey.project import write_project
from survey.simulate import beacons, stereo
from survey.simulate.labs import LabSize, full_lab
from tests.adjust.pose_networks import simulate
from tests.benchmarks import bundle, tables, terrestrial
from tests.benchmarks.building import Plan, build
from tests.benchmarks.data import SIZE, calibration, survey
from tests.benchmarks.growth import LATE
from tests.benchmarks.session import Session
from tests.survey.planning_lab import write_lab

SIZES = (1_000, 10_000, 100_000, 1_000_000)
LONGEST_S = 60.0
"""Processor seconds that one command may need, were it linear; a larger one is not run."""
START_S = 0.6
"""What loading the program takes at any size."""
MOST_TURNS = 20
"""Epochs of the table before a camera, for which the board has room in its images."""
Commands = dict[str, list[str]]


@dataclass(frozen=True)
class Run:
    """What a command took: processor seconds, of its steps by name, the largest memory, MB.

    parts, steps: seconds that two threads save at most with what is shared out, and with steps beside each other.
    """

    cpu_s: float
    stages: dict[str, float]
    mb: float
    parts: float = 0.0
    steps: float = 0.0


def _written(place: Path, given: Survey) -> Commands:
    lab, again = str(place / "lab"), str(place / "again")
    for folder in (lab, again):
        write_project(Path(folder), given)
    return {"adjust": ["adjust", lab], "compare": ["compare", lab, again]}


def board_points(place: Path, n: int) -> Commands:
    """Two cameras, 100 points a view; an epoch added."""
    given = survey(calibration(2, max(n // 200, 5)))
    commands = _written(place, given)
    lab, new = place / "lab", place / "new"
    write_project(place / "some", replace(given, image_blocks=given.image_blocks[-2:]))
    (new / "observations").mkdir(parents=True)
    shutil.copy(place / "some" / "observations" / "image_points.csv", new / "observations")
    table = lab / "observations" / "image_points.csv"
    epoch = given.image_blocks[-1].epoch_id
    with table.open(newline="") as stream:
        head, *rows = csv.reader(stream)
    with table.open("w", newline="") as stream:
        csv.writer(stream).writerows([head, *(row for row in rows if row[head.index("epoch_id")] != epoch)])
    del commands["compare"]  # nothing in it stays where it is
    return commands | {"add": ["add", str(lab), str(new), "--out", str(place / "grown")],
                       "report": ["report", str(lab), "--language", "de"]}  # fmt: skip


def unknown_points(place: Path, n: int) -> Commands:
    """Rooms of 100 stations; points and lens roughly known, poses not."""
    rooms = max(n // 10_000, 1)
    along = max(d for d in range(1, int(rooms**0.5) + 1) if rooms % d == 0)
    built = build(Plan(along, rooms // along) if n >= 10_000 else Plan(1, 1, 30, 250))
    given, start = bundle.survey(built.bundle), bundle.start(built.bundle)
    camera = replace(given.cameras[0], lens=replace(given.cameras[0].lens, values=start.lenses["camera"]))
    points = tuple(replace(p, x_in_world=PointParameter(start.points[p.point_id])) for p in given.points)
    inside = [np.all((b.uv >= 0) & (b.uv <= np.array(SIZE) - 1), axis=1) for b in given.image_blocks]
    blocks = tuple(replace(b, point_idx=b.point_idx[k], uv=b.uv[k], cov=b.cov[k])
                   for b, k in zip(given.image_blocks, inside, strict=True))  # fmt: skip
    return _written(place, replace(given, cameras=(camera,), points=points, image_blocks=blocks))


def readings(place: Path, n: int) -> Commands:
    """Three readings a line, thirteen a point."""
    return _written(place, terrestrial.network(max(n // 13, 20), False))


def pairs(place: Path, n: int) -> Commands:
    """A corridor, two stations a row; ten stations added."""
    whole = simulate(max(n // 3, LATE) + LATE, 2).network.as_survey
    old = {s.station_id for s in whole.stations[:-LATE]}
    inside = [p.a.frame_id in old and p.b.frame_id in old for p in whole.pairs]
    known, late = (tuple(p for p, i in zip(whole.pairs, inside, strict=True) if i == w) for w in (True, False))
    commands = _written(place, Survey(stations=whole.stations[:-LATE], pairs=known))
    write_project(place / "new", Survey(stations=whole.stations[-LATE:], pairs=late))
    sections = "".join(f"[stations.{s.station_id}]\n" for s in whole.stations[-LATE:])
    (place / "new" / "survey.toml").write_text(f"format = 1\n{sections}")
    return commands | {"add": ["add", str(place / "lab"), str(place / "new"), "--out", str(place / "grown")]}


def mixed(place: Path, n: int) -> Commands:
    """The whole laboratory: cameras, table, beacons, relay stations, tape and total station."""
    usual = LabSize()
    some = full_lab(1, size=usual)[0]
    share = n / (sum(len(b.uv) for b in some.image_blocks) + some.n_others_used)
    size = LabSize(**{k: max(round(share * v), 4) for k, v in vars(usual).items()})
    return _written(place, full_lab(1, size=replace(size, n_table_epochs=min(size.n_table_epochs, MOST_TURNS)))[0])


def spots(place: Path, n: int) -> Commands:
    """A head among ten beacons, at night; four spots an image, ten epochs to calibrate it."""
    _written(place, beacons(1, n_night_epochs=max(n // 12, 5))[0])
    return {"navigate": ["navigate", str(place / "lab")]}


def planned(place: Path, n: int) -> Commands:
    """A head on its table before a board of 88 corners, beacons, and as many epochs by hand as are wanted."""
    write_lab(place / "lab")
    count = f"count = {max(n // 88, 2)}"
    by_hand = f'{{ camera = "X", target = "board", {count}, distance_mm = [500, 900], tilt_deg = 35 }}'
    with (place / "lab" / "plan.toml").open("a") as plan:
        plan.write(f'\n[[epochs]]\nname = "m"\nby_hand = {by_hand}\npoints = false\n')
    return {"plan": ["plan", str(place / "lab")]}


def folders(place: Path, n: int) -> Commands:
    """Nights of a stereo head, 1080 image points each, by two processes."""
    for i in range(max(n // 1_000, 2)):
        write_project(place / "nights" / f"n{i}", stereo(i + 1, n_pairs=10)[0])
    many = [str(p) for p in (place / "nights").iterdir()]
    return {"batch": ["adjust", *many, "--report", str(place / "overview"), "--jobs", "2"]}


KINDS: dict[str, Callable[[Path, int], Commands]] = {
    "board points": board_points, "unknown points": unknown_points, "readings": readings, "pairs": pairs,
    "mixed": mixed, "spots": spots, "planned points": planned, "folders": folders,
}  # fmt: skip


def measured(command: Sequence[str], threads: int = 1) -> Run:
    """A command in a process of its own, ``tests.benchmarks.command_child``; RuntimeError for one that fails."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment |= {"LABSURVEY_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1"}
    run = subprocess.run([sys.executable, "-m", "tests.benchmarks.command_child", *command, "--quiet"], text=True,
                         capture_output=True, env=environment, check=False)  # fmt: skip
    last = run.stdout.strip().splitlines()[-1:]
    if not last or not last[0].startswith("{"):
        raise RuntimeError(f"{' '.join(command)}: {run.stderr.strip()[-300:]}")
    return Run(**json.loads(last[0]))


def profile(kinds: Sequence[str], sizes: Sequence[int], threads: Sequence[int], longest_s: float) -> str:
    """All tables: every command by size, exponents, and two threads."""
    rows, shared, grown, before = list[list[str]](), list[list[str]](), list[str](), dict[tuple[str, str], Any]()
    for kind in kinds:
        done: tuple[int, dict[str, Run]] = (0, {})
        for n in sizes:
            found = _at(kind, n, before, longest_s, 2 if 2 in threads and n == max(sizes) else 1)
            for name, run in found.items():
                grown += _grown(kind, name, n, run, before)
                before[kind, name] = n, run
                rows.append([kind, name, str(n), f"{run.cpu_s:.2f}", f"{run.mb:.0f}", *_largest(run)])
                print(*rows[-1], sep="  ", file=sys.stderr, flush=True)
            done = (n, found) if found else done
        if 2 in threads:
            shared += [_amdahl(kind, name, done[0], run) for name, run in done[1].items() if run.parts]
    heads = ("", "command", "observations", "CPU s", "MB", "largest step", "s", "share")
    text = tables.table(heads, rows) + f"\n\nExponents of processor time, last two sizes: {'; '.join(grown[::-1])}.\n"
    names = ("", "command", "observations", "CPU s", "shared out", "steps beside", "times faster, at most")
    return text + ("\n" + tables.table(names, shared) + "\n" if shared else "")


def _at(kind: str, n: int, before: dict[tuple[str, str], Any], longest_s: float, threads: int) -> dict[str, Run]:
    """All commands of a kind that may be run at this size."""
    last = {name: (m, run) for (k, name), (m, run) in before.items() if k == kind}
    if last and min(_expected(run, n / m) for m, run in last.values()) > longest_s:
        return {}
    out = {}
    with tempfile.TemporaryDirectory() as place:
        for name, command in KINDS[kind](Path(place), n).items():
            m, run = last.get(name, (n, None))
            if run is not None and _expected(run, n / m) > longest_s:
                continue
            if name == "add":
                measured(["adjust", command[1]])
            try:
                out[name] = measured(command, threads)
            except RuntimeError as error:
                print(f"{kind}, {n}: {error}", file=sys.stderr, flush=True)
    return out


def _expected(run: Run, times: float) -> float:
    return START_S + (run.cpu_s - START_S) * times


def _largest(run: Run) -> tuple[str, str, str]:
    """Name, seconds and share of the largest step."""
    if not run.stages:
        return "", "", ""
    name = max(run.stages, key=lambda k: run.stages[k])
    return name, f"{run.stages[name]:.2f}", f"{100 * run.stages[name] / run.cpu_s:.0f} %"


def _grown(kind: str, name: str, n: int, run: Run, before: dict[tuple[str, str], Any]) -> list[str]:
    if (kind, name) not in before:
        return []
    m, less = before[kind, name]
    return [f"{kind}, {name}, to {n}: {np.log(run.cpu_s / less.cpu_s) / np.log(n / m):.2f}"]


def _amdahl(kind: str, name: str, n: int, run: Run) -> list[str]:
    shared, steps = (f"{100 * 2.0 * x / run.cpu_s:.0f} %" for x in (run.parts, run.steps))
    least, most = run.cpu_s / (run.cpu_s - run.parts), run.cpu_s / (run.cpu_s - run.parts - run.steps)
    return [kind, name, str(n), f"{run.cpu_s:.2f}", shared, steps, f"{least:.2f} to {most:.2f}"]


def sizes(session: Session) -> None:
    """Whole commands by size."""
    session.say("", "## Whole commands by size", "")
    session.say(profile(list(KINDS), SIZES[:2] if session.quick else SIZES, (1, 2), LONGEST_S))


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.every_size", description=__doc__)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--sizes", nargs="+", type=int, default=SIZES)
    parser.add_argument("--threads", nargs="+", type=int, choices=(1, 2), default=(1,))
    parser.add_argument("--longest", type=float, default=LONGEST_S, help="processor seconds that a command may need")
    given = parser.parse_args()
    print(profile(given.kinds, given.sizes, given.threads, given.longest))


if __name__ == "__main__":
    main()
