"""What a small network loads: the clock is for benchmarks, the list of modules does not depend on the machine."""

import os
import platform
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from adjust.native.parallel import cores
from survey.cli import main

NEEDLESS = (
    "cv2", "matplotlib", "pycolmap", "pandas", "pyarrow", "distributed", "scipy.stats", "scipy.optimize",
    "scipy.linalg", "scipy.sparse.linalg", "scipy.sparse.csgraph", "scipy.spatial", "scipy.fft",
    "numpy.f2py.crackfortran", "tqdm",
    "adjust.pose_network", "adjust.relay", "adjust.diagnosis.table", "survey.detection", "survey.simulate",
    "survey.jobs.detecting.job",
)  # fmt: skip
CODE = """
import sys
import time
from survey.cli import main
code = main([sys.argv[1], sys.argv[2], "--quiet"])
print("CODE", code, "LOADED", *sorted(set(sys.argv[3:]) & set(sys.modules)))
"""


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    folder = tmp_path_factory.mktemp("start") / "network"
    assert main(["example", "total-station", str(folder), "--quiet"]) == 0
    return folder


def loaded(folder, names, command="adjust"):
    asked = [sys.executable, "-c", CODE, command, str(folder), *names]
    run = subprocess.run(asked, capture_output=True, text=True, timeout=300, check=True)
    last = run.stdout.splitlines()[-1].split()
    assert last[:3] == ["CODE", "0", "LOADED"]
    return last[3:]


def test_a_network_of_readings_loads_nothing_that_it_does_not_need(network):
    assert loaded(network, NEEDLESS) == []


AHEAD = """
import sys
import survey.project.tables.files
print(*sorted(name for name in ("gtsam", "scipy", "survey.project.reading") if name in sys.modules))
"""


def test_tables_are_read_by_what_loads_little():
    """It is loaded before all else, which loads while large tables are read."""
    run = subprocess.run([sys.executable, "-c", AHEAD], capture_output=True, text=True, timeout=60, check=True)
    assert run.stdout.split() == []


def test_a_list_of_runs_loads_nothing_that_adjusts(network):
    names = ("scipy.special", "scipy.sparse", "adjust.adjustment", "adjust.graph", "adjust.precision", "jinja2")
    assert loaded(network, (*NEEDLESS, *names), "runs") == []


def test_the_times_of_the_stages_are_the_time_that_passed(network, capsys):
    """No stage is counted twice, and nothing that takes long is counted by none.

    The best of several shares, because other work on the machine may hold up what lies between the stages.
    """
    assert main(["adjust", str(network), "--quiet"]) == 0  # loads
    for _ in range(4):
        capsys.readouterr()
        begin = time.perf_counter()
        assert main(["adjust", str(network), "--quiet"]) == 0
        passed = time.perf_counter() - begin
        told = capsys.readouterr().out.strip().splitlines()[-1]
        stages = {name: float(s) for name, s in re.findall(r"(\w+) ([\d.]+) s", told)}
        assert set(stages) >= {"read", "adjust", "statistics", "report"}
        rounding = 0.005 * len(stages)
        assert sum(stages.values()) <= passed + rounding
        share = (sum(stages.values()) + rounding) / passed
        if share >= 0.6:
            return
    pytest.fail(f"the stages are {share:.0%} of the time")


FREED = """
import resource
from survey.commands.common import begin_adjusting
begin_adjusting()
import numpy as np
for i in range(20):
    if i == 2:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(2**22)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators decide for themselves")
def test_memory_that_was_freed_is_used_again():
    """Else every array of 32 MB is 8192 pages that the system clears once more."""
    run = subprocess.run([sys.executable, "-c", FREED], capture_output=True, text=True, timeout=60, check=True)
    assert int(run.stdout) < 8192


THREADS = """
import os
from survey.commands.common import run_as_program

def main():
    import numpy
    print(len(os.listdir("/proc/self/task")))
    return 0

run_as_program(main)
"""


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads of a process are counted by Linux")
@pytest.mark.parametrize(("said", "expected"), [({}, 1), ({"OPENBLAS_NUM_THREADS": "2"}, 2)])
def test_linear_algebra_has_one_thread_in_a_command(said, expected):
    """The command's own threads share out the survey."""
    unsaid = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    out = subprocess.run([sys.executable, "-c", THREADS], env=unsaid | said, capture_output=True, text=True, check=True)
    assert int(out.stdout) == min(expected, cores())
