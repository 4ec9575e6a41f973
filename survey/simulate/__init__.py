"""Simulated surveys with known truth.

>>> survey, truth = head_on_table(seed=1, n_table_epochs=5, n_free_epochs=3)
>>> again = resample(survey, truth, seed=2)  # the same survey with fresh noise
"""

from survey.simulate.labs import LabSize, beacons, full_lab, head_on_table, relay, single_camera, stereo
from survey.simulate.noise import resample
from survey.simulate.scene import BROWN, Scene, Truth

__all__ = [
    "BROWN",
    "LabSize",
    "Scene",
    "Truth",
    "beacons",
    "full_lab",
    "head_on_table",
    "relay",
    "resample",
    "single_camera",
    "stereo",
]
