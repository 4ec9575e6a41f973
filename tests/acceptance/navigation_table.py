"""The figures of the page on navigation: ``python -m tests.acceptance.navigation_table --doc docs/navigation.md``.

Ten beacons (table 4, 0.3963 mm each) around the three-camera head (tables 2 and 3), turned about its main axis by 3
degrees between epochs. For every turn the errors of cameras and beacons are drawn from their covariances anew; spots
are projected by OpenCV with 0.2 px of noise. Each case draws from its own seed, so one alone gives the same numbers.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from gtsam import Pose3
from scipy.stats import chi2, norm

from adjust.adjustment import adjust
from adjust.navigation import (
    EpochPose,
    Head,
    Motion,
    NavigateOptions,
    PosePrior,
    expected_precision,
    head_and_beacons,
    navigate,
)
from survey.simulate import head_on_table
from tests.adjust.navigation import (
    Sight,
    drawn,
    mfns_head,
    pose_error,
    printed_beacons,
    scattered_beacons,
    simulated,
    turned,
    wide_head,
    with_table,
)

# table 5: scatter of roll, pitch, yaw in degrees, x, y, z in mm
PRINTED = np.array([0.1541, 0.1497, 0.1729, 1.6043, 1.6108, 1.8292])
SIGMA_PX = 0.2
SIGMA_READING = np.radians(8 / 3600)
ALONE = NavigateOptions(motion=None)
MOVING = NavigateOptions(motion=Motion(0.02, 0.002, 0.5, 0.1))
EVERY_3_DEG = np.radians(np.arange(0.0, 360.0, 3.0))
PEOPLE = np.array([180 / np.pi] * 3 + [1e3] * 3)
WRONG = float(chi2.isf(2 * norm.sf(5.0), 6))  # as unlikely as five sigmas of one component
# the table turns by 3 degrees a second: the rates of the start are known to about that
STARTED = NavigateOptions(motion=Motion(0.02, 0.002, 0.06, 0.01))
START = np.diag([np.radians(1.0) ** 2] * 3 + [0.005**2] * 3)
MARK = "<!-- {} by tests.acceptance.navigation_table -->"


@dataclass(frozen=True)
class Case:
    """Turns of the table under one kind of knowledge.

    gaps: two beacons at most are left in view in the last third of every 30 epochs, and only these are counted.
    start: the pose of the first epoch is known to 1 degree and 5 mm, its rates to 3.4 degrees and 10 mm a second.
    """

    title: str
    sight: Sight
    options: NavigateOptions = ALONE
    head: Callable[[], Head] = mfns_head
    beacons: Callable[[], object] = printed_beacons
    gaps: bool = False
    start: bool = False
    turns: int = 17


@dataclass(frozen=True, eq=False)
class Run:
    """One epoch: what was found, the true names, the true pose."""

    result: EpochPose
    names: tuple
    pose: Pose3
    counted: bool = True

    @property
    def error(self):
        """(6,) rad and m, None without a pose."""
        found = self.result.world_from_station
        return None if found is None else pose_error(found, self.pose)


def one_turn(head, beacons, angles, sight, options, rng, gaps=False, start=False):
    """Navigate a turn with errors drawn from the covariances: runs, seconds of processor time."""
    true_head, true_beacons = drawn(head, beacons, rng)
    epochs, truth, poses = [], [], [turned(angle) for angle in angles]
    in_gap = np.arange(len(angles)) % 30 >= 20
    for i, angle in enumerate(angles):
        more = {"time_s": float(i)}
        if head.table is not None:
            read = np.array([0.0, angle]) + rng.normal(0, SIGMA_READING, 2)
            more |= {"table_angles": read, "table_cov": np.eye(2) * SIGMA_READING**2}
        if start and i == 0:
            step = rng.normal(size=6) * np.sqrt(np.diag(START))
            more["prior"] = PosePrior(poses[0].compose(Pose3.Expmap(step)), START)
        here = replace(sight, most=2) if gaps and in_gap[i] else sight
        epoch, names = simulated(true_head, true_beacons, poses[i], rng, here, f"e{i}", **more)
        epochs.append(epoch)
        truth.append(names)
    begin = time.process_time()
    found = navigate(head, beacons, epochs, options).epochs
    seconds = time.process_time() - begin
    counted = in_gap if gaps else np.ones(len(angles), dtype=bool)
    return [Run(*row) for row in zip(found, truth, poses, counted.tolist(), strict=True)], seconds


def turn_table(head, beacons, angles, sight, options=ALONE, draws=1, seed=1, **more):
    """Several turns: all their runs."""
    rng = np.random.default_rng(seed)
    return [run for _ in range(draws) for run in one_turn(head, beacons, angles, sight, options, rng, **more)[0]]


def claimed(runs):
    """The epochs for which one pose is given as the only one."""
    return [run for run in runs if run.result.status in ("fixed", "bridged")]


def distance(cov, error):
    """Squared error in sigmas."""
    return float(error @ np.linalg.solve(cov, error))


def wrong_poses(runs):
    """How many claimed poses are off by more than five sigmas."""
    return sum(distance(run.result.cov, run.error) > WRONG for run in claimed(runs))


def wrong_names(runs):
    """Among claimed epochs the spots with a wrong name, and all that got one."""
    pairs = [
        (a, b)
        for run in claimed(runs)
        for x, y in zip(run.result.labels, run.names, strict=True)
        for a, b in zip(x, y, strict=True)
    ]
    return sum(a is not None and a != b for a, b in pairs), sum(a is not None for a, _ in pairs)


def truth_listed(runs):
    """Of the ambiguous epochs: how many list the true pose, how many have it first, median number of solutions."""
    ambiguous = [run for run in runs if run.result.status == "ambiguous"]
    places = []
    for run in ambiguous:
        near = [
            i for i, s in enumerate(run.result.alternatives)
            if distance(s.cov, pose_error(s.world_from_station, run.pose)) < WRONG
        ]  # fmt: skip
        places.append(near[0] if near else -1)
    n = int(np.median([len(r.result.alternatives) for r in ambiguous])) if ambiguous else 0
    return sum(p >= 0 for p in places), sum(p == 0 for p in places), len(ambiguous), n


def counts(runs):
    """Epochs by status."""
    kinds = ("fixed", "bridged", "ambiguous", "undetermined", "none")
    return {s: sum(run.result.status == s for run in runs) for s in kinds}


def _on_table() -> Head:
    return with_table(mfns_head(), 0.02, 0.2)


def _twenty():
    return scattered_beacons(20)


NAMED, PLAIN = Sight(SIGMA_PX), Sight(SIGMA_PX, named=False)
DIRTY = replace(PLAIN, false_share=0.3)
CASES = (
    Case("names, nothing else", NAMED),
    Case("names, motion", NAMED, MOVING),
    Case("nothing else", PLAIN),
    Case("nothing else, 30 % false spots", DIRTY, turns=2),
    Case("nothing but motion", PLAIN, MOVING, turns=2),
    Case("start to 1 deg and 5 mm, then motion", PLAIN, STARTED, start=True, turns=4),
    Case("table angles", PLAIN, head=_on_table),
    Case("table angles, 30 % false spots", DIRTY, head=_on_table),
    Case("start, motion, 30 % false spots", DIRTY, STARTED, start=True, turns=4),
    Case("20 beacons, lenses of 600 px", PLAIN, head=wide_head, beacons=_twenty),
    Case("the same, 30 % false spots, 10 % missing", replace(DIRTY, missing=0.1), head=wide_head, beacons=_twenty,
         turns=1),
    Case("two beacons, names, nothing else", replace(NAMED, most=2)),
    Case("two beacons, names, table angles", replace(NAMED, most=2), head=_on_table),
    Case("two beacons, table angles", replace(PLAIN, most=2), head=_on_table),
    Case("two beacons for 10 of 30 epochs, names, motion", NAMED, MOVING, gaps=True, turns=51),
)  # fmt: skip


def measured(case: Case, number: int, turns: int | None) -> str:
    """One row of the table."""
    rng, runs, seconds, all_epochs = np.random.default_rng(100 + number), [], 0.0, 0
    head, beacons = case.head(), case.beacons()
    for _ in range(turns or case.turns):
        more, took = one_turn(
            head, beacons, EVERY_3_DEG, case.sight, case.options, rng, case.gaps, case.start
        )  # fmt: skip
        seconds, all_epochs = seconds + took, all_epochs + len(more)
        runs += [run for run in more if run.counted]
    c, listed = counts(runs), truth_listed(runs)
    names = wrong_names(runs)
    among = f"{listed[0]} of {listed[2]} ({listed[1]} first, {listed[3]} solutions)" if listed[2] else "-"
    n = len(claimed(runs))
    values = (
        case.title, len(runs), c["fixed"], c["bridged"], c["ambiguous"], c["undetermined"], c["none"],
        f"{wrong_poses(runs)} of {n}" if n else "-", f"{names[0]} of {names[1]}" if n else "-", among,
        f"{sum(b is None for r in runs for s in r.names for b in s)} of {sum(len(s) for r in runs for s in r.names)}",
        f"{all_epochs / seconds:.0f}",
    )  # fmt: skip
    return "| " + " | ".join(str(v) for v in values) + " |"


def rates(jobs: int, turns: int | None, only: Sequence[int] | None) -> str:
    """The table of wrong solutions."""
    chosen = list(range(len(CASES))) if only is None else list(only)
    # forked children of a process with threads may hang
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        rows = list(pool.map(measured, [CASES[i] for i in chosen], chosen, [turns] * len(chosen)))
    head = (
        "| known | epochs | fixed | bridged | ambiguous | undetermined | none | wrong poses | wrong names "
        "| truth among the ambiguous | false spots | epochs/s |\n|---|" + "---|" * 11
    )
    return "\n".join([head, *rows])


def joint_calibration() -> Head:
    """The printed head with the covariance that a joint adjustment of its calibration reaches."""
    survey, _ = head_on_table(seed=2)
    adjusted, _ = head_and_beacons(adjust(survey), "head", known=printed_beacons())
    head = mfns_head()
    n = sum(len(c.lens) + 6 for c in head.cameras)
    return replace(head, cov=adjusted.cov[:n, :n])


def precision(head: Head):
    """Positions that determine the pose, of how many, and by source the rms (6,) of sigmas, in degrees and mm."""
    expected = list(expected_precision(head, printed_beacons(), [turned(a) for a in EVERY_3_DEG], SIGMA_PX))
    sharp = [e for e in expected if not e.undetermined and np.sqrt(e.cov[0, 0]) < 0.2]

    def rms(matrices):
        return PEOPLE * np.sqrt(np.mean([np.diag(m) for m in matrices], axis=0))

    parts = {k: rms([getattr(e.shares, k) for e in sharp]) for k in ("spots", "beacons", "calibration")}
    return len(sharp), len(expected), parts | {"together": rms([e.cov for e in sharp])}


def scatter(head: Head, turns: int):
    """Rms (6,) of errors and of their sigmas over fixed epochs, in degrees and mm, and how many there are."""
    runs = turn_table(head, printed_beacons(), EVERY_3_DEG, NAMED, draws=turns, seed=7)
    fixed = [r for r in runs if r.result.status == "fixed"]
    both = np.array([[r.error for r in fixed], [r.result.sigmas for r in fixed]])
    return (*(PEOPLE * np.sqrt(np.mean(both**2, axis=1))), len(fixed))


def table_5(turns: int) -> str:
    """Standard deviations beside the printed ones."""
    lines = ["| | roll deg | pitch | yaw | x mm | y | z |", "|---|---|---|---|---|---|---|"]

    def row(title, values):
        lines.append(f"| {title} | " + " | ".join([f"{v:.3f}" for v in values[:3]] + [f"{v:.2f}" for v in values[3:]])
                     + " |")  # fmt: skip

    row("published", PRINTED)
    for title, head in (("printed calibration", mfns_head()), ("joint calibration", joint_calibration())):
        sharp, every, parts = precision(head)
        found, sigmas, n = scatter(head, turns)
        row(f"{title}, {sharp} of {every} positions", parts["together"])
        for name in ("spots", "beacons", "calibration"):
            row(f"- of it {name}", parts[name])
        row(f"- rms error of {n} simulated fixed epochs", found)
        row("- rms of their sigmas", sigmas)
    return "\n".join(lines)


def main() -> None:
    """Measure, print, and put into the page."""
    parser = argparse.ArgumentParser(prog="python -m tests.acceptance.navigation_table", description=__doc__)
    parser.add_argument("--doc", type=Path, help="put the tables between the marks of this page")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--turns", type=int, help="turns of 120 epochs per case; default: as the case says")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of cases")
    options = parser.parse_args()
    blocks = {"precision": table_5(options.turns or 17), "rates": rates(options.jobs, options.turns, options.only)}
    for name, block in blocks.items():
        print(f"{name}\n{block}\n")
    if options.doc:
        text = options.doc.read_text()
        for name, block in blocks.items():
            begin, end = MARK.format(f"{name}"), MARK.format(f"end of {name}")
            before, rest = text.split(begin)
            text = f"{before}{begin}\n{block}\n{end}{rest.split(end)[1]}"
        options.doc.write_text(text)


if __name__ == "__main__":
    main()
