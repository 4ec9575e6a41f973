"""Before and after: ``python -m tests.benchmarks.versions FOLDER [--only ROW ...] [--rounds N]``.

FOLDER is another checkout of this project, built. Each version runs the competitors called "ours" of its own
benchmarks, and OpenCV's classic finder as a measure, in a process of its own, in turn with the other, on the same
cases; the first run of each, which may still compile or load, is not counted. Processor seconds, the least of all
rounds: what other work does to them it adds.
"""

import argparse
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks import bundle, finding, pose_graphs, tables, terrestrial, trials
from tests.benchmarks.children import Child, Measured
from tests.benchmarks.data import Calibration, calibration
from tests.benchmarks.kinds import kind_of
from tests.data import data_folder

HERE = Path(__file__).parents[2]
STAGES, START = "ours: in stages", "ours: start, build, solve"
BUNDLE = "ours: build, solve, precision"


def _graph(name: str) -> pose_graphs.PoseGraph:
    return pose_graphs.read(data_folder("calibration", "pose_graphs") / f"{name}.g2o")


def _photographs() -> finding.Pictures:
    return finding.photographs(data_folder("calibration", "opencv_samples"))


def _one(images: int) -> Calibration:
    return calibration(1, images, (8, 11), single=True)


ROWS: dict[str, tuple[str, Callable[[], Any]]] = {
    **{f"1 x {n}, stages": (STAGES, partial(_one, n)) for n in (50, 200)},
    **{f"1 x {n}, from nothing": (START, partial(_one, n)) for n in (50, 200)},
    **{f"3 x {n}, stages": (STAGES, partial(calibration, 3, n)) for n in (50, 500)},
    **{f"3 x {n}, from nothing": (START, partial(calibration, 3, n)) for n in (50, 500)},
    "12 x 1000, stages": (STAGES, partial(calibration, 12, 1000)),
    "AICON": (BUNDLE, lambda: bundle.aicon(data_folder("network", "jaicov"))),
    "500 x 3000, bundle": (BUNDLE, partial(bundle.simulated, 500, 3000, 34)),
    **{name: (pose_graphs.OURS, partial(_graph, name)) for name in ("parking-garage", "sphere2500", "torus3D")},
    "1000 points, readings": (terrestrial.OURS, partial(terrestrial.case, 1000)),
    "Table 1": (trials.TABLE_1, lambda: trials.Trials(np.array(1000))),
    "26 photographs": (finding.OURS, _photographs),
    "26 photographs, OpenCV": (finding.CLASSIC, _photographs),
    **{f"{'ChArUco' if charuco else 'board'}, {w} x {h}": (finding.OURS, partial(finding.rendered, w, h, charuco))
       for w, h in finding.SIZES for charuco in (False, True)},
    **{f"{'ChArUco' if charuco else 'board'}, {w} x {h}, OpenCV":
       (finding.ARUCO if charuco else finding.CLASSIC, partial(finding.rendered, w, h, charuco))
       for w, h in finding.SIZES for charuco in (False, True)},
}  # fmt: skip


def main() -> None:
    """Run the rows that were asked for, and print a table of each version's times."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.versions", description=__doc__)
    parser.add_argument("folder", type=Path, help="the other checkout")
    parser.add_argument("--only", nargs="+", choices=ROWS, default=list(ROWS), metavar="ROW", help="rows to run")
    parser.add_argument("--rounds", type=int, default=7, help="runs of each version (default 7)")
    parser.add_argument("--threads", type=int, default=1, help="threads (default 1)")
    options = parser.parse_args()
    rows = []
    for row in options.only:
        name, make = ROWS[row]
        other, here = _measured(row, name, make(), options)
        rows += _told(row, other, here)
        print("\t".join(rows[-1]), flush=True)
    print(tables.table(("", "other, CPU ms", "here, CPU ms", "here / other", "stages, wall ms: other, here"), rows))


def _measured(row: str, name: str, case: Any, options: argparse.Namespace) -> list[Measured]:
    """The other version, and this one."""
    found = [Measured(row, name), Measured(row, name)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "case.npz"
        case.save(path)
        children = [
            Child(kind_of(case), name, path, path, options.threads, root) for root in (options.folder.resolve(), HERE)
        ]
        for m, child in zip(found, children, strict=True):
            answer = child.answer()
            m.failed = answer if isinstance(answer, str) else ""
        for _ in range(options.rounds):
            for m, child in zip(found, children, strict=True):
                answer = m.failed or child.run()
                if isinstance(answer, str):
                    m.failed = answer
                else:
                    m.take(answer)
        for m, child in zip(found, children, strict=True):
            m.solution = child.end()
    return found


def _told(row: str, other: Measured, here: Measured) -> list[list[str]]:
    if other.failed or here.failed:
        return [[row, other.failed, here.failed, "", ""]]
    times = [1e3 * min(m.cpu) for m in (other, here)]
    before = other.stages
    stages = [f"{s} {1e3 * min(before.get(s, [0.0])):.1f}, {1e3 * min(now):.1f}" for s, now in here.stages.items()]
    return [[row, *(f"{t:.1f}" for t in times), f"{times[1] / times[0]:.2f}", "; ".join(stages)]]


if __name__ == "__main__":
    main()
