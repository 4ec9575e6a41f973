"""``python -m tests.benchmarks [--quick] [--json FILE] [--doc FILE]``: us and the peers on the same data, in turn."""

import argparse
import os
import platform
import sys
import time
import traceback
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from tests.benchmarks import every_size, sections_cameras, sections_networks, sections_other
from tests.benchmarks.session import Session

CASES: dict[str, Callable[[Session], None]] = {
    "several": sections_cameras.several_cameras, "one": sections_cameras.one_camera,
    "bundle": sections_cameras.unknown_points, "scaling": sections_cameras.scaling,
    "graphs": sections_networks.published_graphs, "additions": sections_networks.additions,
    "large": sections_networks.large_networks, "readings": sections_networks.readings,
    "trials": sections_networks.simulations, "targets": sections_other.targets, "start": sections_other.start_up,
    "stages": sections_other.stages, "script": sections_other.script, "sizes": every_size.sizes,
}  # fmt: skip
PACKAGES = ("gtsam", "numpy", "scipy", "opencv-contrib-python-headless", "pycolmap")


def main() -> int:
    """Run the cases that were asked for; 1 where one of them failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small cases, three rounds")
    parser.add_argument("--long", action="store_true", help="also what takes minutes: 100,000 stations from nothing")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), help="cases to run")
    parser.add_argument("--threads", type=int, default=1, help="threads of every competitor (default 1)")
    parser.add_argument("--json", type=Path, help="write all measurements to this file")
    parser.add_argument("--doc", type=Path, help="write the tables to this Markdown file, plots to pictures beside it")
    options = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    session = Session(options)
    measured = f"Measured on {time.strftime('%d %B %Y')} by `{_command()}`."
    session.say("# Benchmarks", "", measured, "", _machine(options.threads))
    session.top = len(session.text)
    for name in options.only:
        begin = time.perf_counter()
        try:
            CASES[name](session)
        except Exception as error:  # the other cases are not to be lost
            traceback.print_exc()
            session.failures.append(name)
            session.say("", f"The case “{name}” failed: {error}.")
        print(f"  {name}: {time.perf_counter() - begin:.0f} s", file=sys.stderr, flush=True)
        session.write(options.json)
    print(*session.summary(), sep="\n")
    return 1 if session.failures else 0


def _command() -> str:
    return "python -m tests.benchmarks " + " ".join(sys.argv[1:])


def _machine(threads: int) -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    packages = ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    return (
        f"{model}, {os.cpu_count()} cores, {threads} thread{'s' * (threads != 1)} for every competitor; Python "
        f"{platform.python_version()}, {packages}. The competitors of a table ran in turn, each in its own process, "
        "warmed up on a small case; times are medians, ratios run by run with their range. The machine had "
        "other work: small differences mean nothing."
    )


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


if __name__ == "__main__":
    sys.exit(main())
