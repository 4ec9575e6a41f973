"""What the page shows of results on disk before anything is adjusted."""

import shutil
import subprocess
import sys

import numpy as np
import pytest

from survey.jobs.adjusting.job import adjust_job
from survey.workbench.session import Workbench
from tests import labs

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kept") / "lab"
    labs.example("head", folder)
    adjust_job(folder, progress=False)
    return folder


def test_rows_are_those_of_the_solution(adjusted):
    """Every row of residuals.csv is found by its name; numbers to the decimals of the table."""
    bench = Workbench(adjusted, read_only=True)
    early = bench.rows
    assert bench.kept is not None
    bench.adjust()
    late = bench.rows
    assert bench.kept is None
    assert np.isfinite(early.residuals).all()
    assert np.abs(early.residuals - late.residuals).max() < 1e-6
    assert np.abs(early.test - late.test).max() < 1e-4
    assert np.array_equal(early.used, late.used)
    assert np.array_equal(early.why, late.why)


def test_rows_of_the_table_in_any_order(adjusted, tmp_path):
    folder = shutil.copytree(adjusted, tmp_path / "lab")
    path = folder / "results" / "residuals.csv"
    head, *rows = path.read_text().splitlines()
    np.random.default_rng(1).shuffle(rows)
    path.write_text("\n".join([head, *rows[5:]]) + "\n")
    early, whole = Workbench(folder, read_only=True).rows, Workbench(adjusted, read_only=True).rows
    there = np.isfinite(early.test)
    assert (~there).sum() == 5
    assert np.array_equal(early.residuals[there], whole.residuals[there])
    assert np.array_equal(early.used[there], whole.used[there])


@pytest.mark.parametrize("name", ["results/solution.json", "results/residuals.csv", "observations/table_angles.csv"])
def test_results_of_other_inputs_or_broken_ones_say_nothing(adjusted, tmp_path, name):
    folder = shutil.copytree(adjusted, tmp_path / "lab")
    path = folder / name
    path.write_text(path.read_text() + ("\n" if name.startswith("obs") else "}{"))
    bench = Workbench(folder, read_only=True)
    assert (bench.kept is None) == (name != "results/residuals.csv")
    assert np.isnan(bench.rows.test).all()


FIRST = """
import sys
from survey.workbench.server import Server
from survey.workbench.session import Workbench
bench = Workbench(sys.argv[1], read_only=True)
Server(bench, "token").app()
bench.state(), bench.findings(), bench.points(), bench.readings(), bench.runs()
assert bench.kept is not None
heavy = {"scipy.sparse", "adjust.adjustment", "adjust.graph.assembly", "jinja2", "cv2", "pandas"}
print(sorted(heavy & set(sys.modules)))
"""


SERVED = """
import sys, uvicorn, survey.workbench.live, survey.workbench.server
print({"gtsam", "numpy"} & {*sys.modules})
"""


def test_the_page_is_served_before_what_reads_a_project_is_loaded():
    done = subprocess.run([sys.executable, "-c", SERVED], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_what_the_results_say_is_shown_before_what_adjusts_is_loaded(adjusted):
    done = subprocess.run([sys.executable, "-c", FIRST, str(adjusted)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
