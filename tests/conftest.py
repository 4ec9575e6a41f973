"""Compiles the kernels once before several workers would each do it at the same time."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
_WARM_UP = (
    "from survey.simulate import {name}; from adjust.adjustment import adjust; survey, _ = {name}(1); adjust(survey)"
)


def pytest_sessionstart(session: pytest.Session) -> None:
    """With xdist, in the one process that hands out the tests: two small surveys with most of the kernels."""
    if hasattr(session.config, "workerinput") or not getattr(session.config.option, "numprocesses", None):
        return
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    running = [
        subprocess.Popen([sys.executable, "-c", _WARM_UP.format(name=name)], cwd=ROOT, env=environment,
                         stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for name in ("head_on_table", "beacons")
    ]  # fmt: skip
    for process in running:
        process.wait()  # what fails here fails again, and is told, in the tests
