"""Commands killed, and on full disks, in numbers: a table.

    python -m tests.acceptance.kill_adjust --count 200

Every row is a command. It is killed before every single step in which it changes the disk, ``--count`` times at random
instants, and run on a disk that is full from every step on that needs room. Each time the results that a reader finds
are the old set or the new one; after the next command all of the folder is as before or as after, and nothing is left
over. Faults are printed and make the exit code 1.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.acceptance.interruptions import CASES, Ground, full_at_step, killed_at_instant, killed_at_step, prepare

_NEED_ROOM = ("open", "os.mkdir", "os.link", "fsync")


def main() -> int:
    """All rows; they go out as they are done."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200, help="kills at random instants, of each command")
    parser.add_argument("--only", choices=tuple(CASES), action="append", help="this command")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng, faults = np.random.default_rng(given.seed), 0
    print(f"{'command':<10}{'steps':>7}{'killed at a step':>18}{'at an instant':>15}{'disk full':>11}{'faults':>8}")
    with tempfile.TemporaryDirectory() as name:
        for case in given.only or CASES:
            ground = prepare(CASES[case], Path(name) / case)
            found = _row(case, ground, given.count, rng)
            faults += found
    return 1 if faults else 0


def _row(case: str, ground: Ground, count: int, rng: np.random.Generator) -> int:
    """A line of the table; its number of faults."""
    faults, hits = 0, 0
    numbers = range(1, len(ground.steps) + 1)
    faults += sum(_said(case, f"killed before step {n}", lambda n=n: killed_at_step(ground, n)) for n in numbers)
    for _ in range(count):
        after_s = rng.uniform(0.0, 1.05 * ground.seconds)
        was_at_work, found = killed_at_instant(ground, after_s)
        hits += was_at_work
        faults += _said(case, f"killed after {after_s:.4f} s", lambda found=found: found)
    full = [n for n in numbers if ground.steps[n - 1].startswith(_NEED_ROOM)][1:]  # the first is that of the folder
    faults += sum(_said(case, f"disk full from step {n}", lambda n=n: full_at_step(ground, n)) for n in full)
    print(f"{case:<10}{len(numbers):>7}{len(numbers):>18}{hits:>15}{len(full):>11}{faults:>8}", flush=True)
    return faults


def _said(case: str, what: str, tried: Callable[[], list[str]]) -> bool:
    try:
        found = tried()
    except Exception as error:  # the next command could not read the folder
        found = [f"{type(error).__name__}: {error}"]
    for fault in found:
        print(f"  {case} {what}: {fault}", file=sys.stderr)
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
