"""Pose graphs from file to report beside plain solves: ``python -m tests.benchmarks.graph_commands FILE.g2o ...``.

The command: reading, start values, solution, covariances, tests, results and report, with and without the search for
wrong pairs. The plain solves: as a process, a script of GTSAM alone from file to file (``gtsam_script``); in memory,
from the start that ours finds, with the graph built and nothing else, our own, GTSAM's Gauss-Newton and its
Levenberg-Marquardt. Processor time of one thread, the least of all rounds, in turn; modules are kept compiled, as ever.
Times as long: each command over a plain solve.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from time import process_time

from survey import cli
from tests.benchmarks import gtsam_script, pose_graphs
from tests.benchmarks.tables import table

_OURS, _GAUSS_NEWTON, _LEVENBERG = "ours, CPU s", "Gauss-Newton", "Levenberg-Marquardt"
_SCRIPT = "GTSAM's process"
_LEFT_OUT = {"command": "reject_pairs = false", "with the search": "reject_pairs = true"}


def main() -> None:
    """Measure the files, and print their table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.graph_commands", description=__doc__)
    parser.add_argument("files", type=Path, nargs="+", help="pose graphs")
    parser.add_argument("--block-diagonal", action="store_true", help="read their information block by block")
    parser.add_argument("--equal-start", action="store_true", help="GTSAM's chordal start has no solution as it stands")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each (default 3)")
    options = parser.parse_args()
    rows = []
    for path in options.files:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(_measured(path, Path(folder), options))
        print("\t".join(rows[-1]), flush=True)
    times = "times the process", "times ours in memory", "times Gauss-Newton in memory"
    print(table(("", _OURS, _GAUSS_NEWTON, _LEVENBERG, _SCRIPT, *_LEFT_OUT, *times), rows))


def _measured(path: Path, folder: Path, options: argparse.Namespace) -> list[str]:
    times: dict[str, list[float]] = {name: [] for name in (_OURS, _GAUSS_NEWTON, _LEVENBERG, _SCRIPT, *_LEFT_OUT)}
    how = ["--block-diagonal"] if options.block_diagonal else []
    for name, option in _LEFT_OUT.items():
        with redirect_stdout(sys.stderr):
            cli.main(["convert", str(path), str(folder / name), "--quiet", *how])
        definition = folder / name / "survey.toml"
        definition.write_text(definition.read_text().replace(_LEFT_OUT["command"], option))
    script = [*("block-diagonal",) * options.block_diagonal, *("equal-start",) * options.equal_start]
    case = pose_graphs.read(path, options.block_diagonal)
    solves: dict[str, Callable[[], object]] = {
        _OURS: pose_graphs.plain_solve(case),
        _GAUSS_NEWTON: pose_graphs.gtsam_solve(case, gauss_newton=True, marginals=False),
        _LEVENBERG: pose_graphs.gtsam_solve(case, gauss_newton=False, marginals=False),
    }
    for _ in range(options.rounds):
        for name, solve in solves.items():
            begin = process_time()
            solve()
            times[name].append(process_time() - begin)
        times[_SCRIPT].append(_process_seconds([gtsam_script.__file__, str(path), str(folder / "out.g2o"), *script]))
        for name in _LEFT_OUT:
            times[name].append(_process_seconds(["-m", "survey", "adjust", str(folder / name), "--quiet"]))
    least = {name: min(found) for name, found in times.items()}
    beside = _SCRIPT, _OURS, _GAUSS_NEWTON
    ratios = (" and ".join(f"{least[name] / least[of]:.1f}" for name in _LEFT_OUT) for of in beside)
    return [path.stem, *(f"{seconds:.2f}" for seconds in least.values()), *ratios]


def _process_seconds(words: list[str]) -> float:
    """Processor time of a program of Python's; RuntimeError for one that fails."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment |= {"OPENBLAS_NUM_THREADS": "1", "LABSURVEY_THREADS": "1"}
    before = os.times()
    done = subprocess.run([sys.executable, *words], env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 3):  # 3: solved, and something does not fit
        raise RuntimeError(f"{' '.join(words)}: {done.stderr.strip()[-300:]}")
    print(done.stdout.strip()[-100:].replace("\n", " "), file=sys.stderr)
    after = os.times()
    return after.children_user - before.children_user + after.children_system - before.children_system


if __name__ == "__main__":
    main()
