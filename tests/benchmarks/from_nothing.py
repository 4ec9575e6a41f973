"""Calibrations from nothing against the peers that find their own start: ``python -m tests.benchmarks.from_nothing``.

Ours: start values, solution, every covariance and test. The peers give no covariances. calibrateCamera takes the
cameras of a rig one by one, which is another and smaller job. Processor time of one thread, the least of all rounds,
in turn.
"""

import argparse

from tests.benchmarks.children import compete
from tests.benchmarks.data import calibration
from tests.benchmarks.tables import table

OURS, PEERS = "ours: adjust (all three)", ("OpenCV calibrateCamera", "OpenCV calibrateMultiview")
ROWS = {"1 x 20": (1, 20, 1.0), "1 x 200": (1, 200, 5.0), "3 x 50": (3, 50, 10.0), "3 x 500": (3, 500, 30.0)}
"""Cameras, images, and how many times as long as ours the best peer with the same result is wanted to take."""


def main() -> None:
    """Measure the rows that were asked for, and print their table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.from_nothing", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=ROWS, default=list(ROWS), metavar="ROW", help="rows to run")
    parser.add_argument("--rounds", type=int, default=5, help="runs of each (default 5)")
    options = parser.parse_args()
    rows = []
    for row in options.only:
        cameras, images, wanted = ROWS[row]
        single = cameras == 1
        case, warm = (calibration(cameras, n, (8, 11) if single else (10, 10), single=single) for n in (images, 5))
        names = (OURS, PEERS[0]) if single else (OURS, *PEERS)
        found = {m.name: m for m in compete(row, case, warm, names, options.rounds)}
        least = {name: min(m.cpu, default=float("nan")) for name, m in found.items()}
        ratios = [f"{least[name] / least[OURS]:.1f}" if name in least else "" for name in PEERS]
        rows.append([row, f"{1e3 * least[OURS]:.1f}", *ratios, f"{wanted:.0f}"])
        print("\t".join(rows[-1]), flush=True)
    head = ("", "ours, CPU ms", *(f"{name.split()[-1]}, times as long" for name in PEERS), "wanted of the best")
    print(table(head, rows))


if __name__ == "__main__":
    main()
