"""Work for several workers: what takes long comes first, kernels are compiled once and not by all at the same time."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
_IMAGES = "from survey.simulate import {name}; from adjust.adjustment import adjust; adjust({name}(1)[0])"
_NAVIGATION = """
import numpy as np
from adjust.navigation import navigate
from gtsam import Pose3
from tests.adjust.navigation import Sight, scattered_beacons, simulated, wide_head
place = wide_head(), scattered_beacons(20)
rng = np.random.default_rng(1)
for named in (True, False):
    navigate(*place, [simulated(*place, Pose3(), rng, Sight(0.2, named=named))[0]])
"""
_READINGS = """
from adjust.statistics.cleaned import adjust_cleaned
from tests.adjust.terrestrial_networks import measured, polar_network
adjust_cleaned(measured(*polar_network(4), 1))
"""
_WARM_UP = ((_IMAGES.format(name="head_on_table"),), (_NAVIGATION, _READINGS, _IMAGES.format(name="beacons")))
"""For each of two processes: what hardly shares kernels with what the other one does at that time."""


_LONG = ("test_docs", "test_end_to_end", "test_coverage", "test_planted_faults", "test_hardening_fuzz", "test_mfns",
         "test_navigation", "test_pose_networks", "test_led_selfcal", "test_networks", "test_relay_paper",
         "test_positioner", "test_batch", "test_detection", "test_camera_lab", "test_camera_gige")  # fmt: skip
"""Files of 20 s and more: what is begun last is waited for by all workers."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The long files first, all others in their order."""
    rank = {name: i for i, name in enumerate(_LONG)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(_LONG)))


def pytest_sessionstart(session: pytest.Session) -> None:
    """With xdist, in the one process that hands out the tests: small surveys with most of the kernels."""
    if hasattr(session.config, "workerinput") or not getattr(session.config.option, "numprocesses", None):
        return
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    running = [
        subprocess.Popen([sys.executable, "-c", "\n".join(code)], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL,
                         stderr=subprocess.DEVNULL)
        for code in _WARM_UP
    ]  # fmt: skip
    for process in running:
        process.wait()  # what fails here fails again, and is told, in the tests
