"""Networks from file to file beside GNU Gama: ``python -m tests.benchmarks.gama_commands --points 300 1000 3000``.

Simulated networks of total station readings (``terrestrial``), as a project and as the same in Gama's own format by
``labsurvey convert``, points 3 cm off in both. Ours: ``labsurvey adjust``, with every statistic and the report. Gama:
``gama-local``, found on the PATH or named by ``--gama`` (built from its released source: it is neither in Debian nor in
the index of Python packages), results as XML, with the variances alone and with the whole covariance matrix. All are
whole processes of one thread, in turn; of each the least processor time and the largest memory of all rounds.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from adjust.model.survey import PointParameter
from survey.project import write_project
from tests.acceptance.gama_folder import compared, run_command
from tests.acceptance.gama_results import gama_result
from tests.benchmarks import terrestrial
from tests.benchmarks.tables import seconds, table

OURS = "labsurvey adjust"


@dataclass(frozen=True)
class Process:
    """One process: processor time, s; its largest memory, MB; what it said last where it failed."""

    cpu_s: float
    mb: float
    failed: str = ""


_LAUNCHER = """import resource, subprocess, sys
code = subprocess.run(sys.argv[2:], stdout=sys.stderr, timeout=float(sys.argv[1])).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(code, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
"""  # a small process: the kernel's account of the largest memory begins with that of who starts


def run(words: Sequence[str], good: Sequence[int], longest_s: float) -> Process:
    """One process of one thread, by the operating system's account of it."""
    one = {"OPENBLAS_NUM_THREADS": "1", "LABSURVEY_THREADS": "1"}
    done = subprocess.run([sys.executable, "-I", "-S", "-c", _LAUNCHER, str(longest_s), *words],
                          env=os.environ | one, capture_output=True, text=True, check=False)  # fmt: skip
    if done.returncode != 0:
        late = "TimeoutExpired" in done.stderr
        return Process(np.nan, np.nan, f"longer than {longest_s:.0f} s" if late else done.stderr.strip()[-200:])
    code, cpu, mb = done.stdout.split()
    failed = "" if int(code) in good else f"exit code {code}: {done.stderr.strip()[-200:]}"
    return Process(float(cpu), float(mb), failed)


def projects(n: int, free: bool, folder: Path) -> tuple[Path, Path]:
    """The network as a project and as Gama's file."""
    survey = terrestrial.network(n, free)
    rough = terrestrial.rough(survey)
    points = tuple(replace(p, x_in_world=PointParameter(rough[p.point_id], p.x_in_world.treatment))
                   for p in survey.points)  # fmt: skip
    lab, gkf = folder / "lab", folder / "network.gkf"
    write_project(lab, replace(survey, points=points))
    code, said = run_command("convert", str(lab), str(gkf), "--quiet")
    if code != 0:
        raise RuntimeError(said)
    return lab, gkf


def measured(n: int, options: argparse.Namespace, gama: str) -> list[list[str]]:
    """Rows of one network: a competitor each, with how far its results are from ours."""
    label = f"{n}{' free' if options.free else ''}"
    with tempfile.TemporaryDirectory() as scratch:
        lab, gkf = projects(n, options.free, Path(scratch))
        printed = {"variances": gkf.with_suffix(".band.xml"), "whole covariance": gkf.with_suffix(".xml")}
        band = {"variances": ["--cov-band", "0"], "whole covariance": []}
        commands = {OURS: [sys.executable, "-m", "survey", "adjust", str(lab), "--quiet"]} | {
            f"gama-local, {what}": [gama, str(gkf), "--algorithm", options.algorithm, "--xml", str(path), *band[what]]
            for what, path in printed.items()
        }
        runs: dict[str, list[Process]] = {name: [] for name in commands}
        for _ in range(options.rounds):
            for name, words in commands.items():
                if not runs[name] or not runs[name][-1].failed:
                    runs[name].append(run(words, (0, 3) if name == OURS else (0,), options.longest))
        solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
        said = {name: _difference(label, solution, path)
                for name, path in zip(list(commands)[1:], printed.values(), strict=True)
                if not runs[name][-1].failed}  # fmt: skip
    least = min(r.cpu_s for r in runs[OURS])
    return [_row(label, name, found, least, said.get(name, "")) for name, found in runs.items()]


def _difference(label: str, solution: dict, path: Path) -> str:
    off = compared(label, solution, gama_result(path))
    if off.coordinate_m is None or off.sigma_ratio is None:
        return off.said
    wider = max(abs(r - 1.0) for r in off.sigma_ratio)
    return f"coordinates to {off.coordinate_m:.1e} m, sigmas to {wider:.1e} of them"


def _row(label: str, name: str, runs: Sequence[Process], ours: float, said: str) -> list[str]:
    if runs[-1].failed:
        return [label, name, "-", "-", "-", runs[-1].failed]
    cpu = min(r.cpu_s for r in runs)
    return [label, name, seconds(cpu), f"{cpu / ours:.2f}", f"{max(r.mb for r in runs):.0f}", said]


def main() -> int:
    """Measure, and print a table; 2 where there is no gama-local."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.gama_commands", description=__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=[300, 1000, 3000], help="sizes of the networks")
    parser.add_argument("--free", action="store_true", help="inner constraints over all points, not four held points")
    parser.add_argument("--gama", default="gama-local", help="the program (default: gama-local on the PATH)")
    parser.add_argument("--algorithm", default="envelope", help="of Gama: envelope (sparse, its default), gso, svd ...")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each (default 3)")
    parser.add_argument("--longest", type=float, default=120.0, help="seconds that a run may take (default 120)")
    options = parser.parse_args()
    gama = shutil.which(options.gama)
    if gama is None:
        print(f"there is no {options.gama}: build GNU Gama from its released source", file=sys.stderr)
        return 2
    version = subprocess.run([gama, "--version"], capture_output=True, text=True, check=False).stdout
    print(version.splitlines()[0])
    rows = []
    for n in options.points:
        for row in measured(n, options, gama):
            rows.append(row)
            print("\t".join(row), file=sys.stderr, flush=True)
    print(table(("points", "", "CPU s", "times ours", "MB", "from ours"), rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
