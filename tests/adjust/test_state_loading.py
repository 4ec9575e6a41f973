"""Poses reach the kernels' arrays whether the values hold only them or others too."""

import gtsam
import numpy as np
from gtsam import Pose3

from adjust.graph.building import GraphBuilder
from tests.benchmarks.data import calibration, rough_start, survey


def test_poses_are_loaded_in_their_slots_beside_foreign_ones():
    case = calibration(2, 3, (3, 3))
    start = rough_start(case)
    graph = GraphBuilder(survey(case), start.lenses).build(start)
    values = gtsam.Values(graph.start)
    rng = np.random.default_rng(1)
    for _, key in graph.state._free_slots:
        values.update(key, Pose3.Expmap(rng.normal(size=6)))
    for foreign in (False, True):
        if foreign:
            values.insert(0, Pose3())
        graph.state.slot_R[:], graph.state.slot_t[:] = 0.0, 0.0
        graph.state.load(values)
        assert len(graph.state._free_slots) == 4
        for slot, key in graph.state._free_slots:
            np.testing.assert_array_equal(graph.state.slot_R[slot], values.atPose3(key).rotation().matrix())
            np.testing.assert_array_equal(graph.state.slot_t[slot], values.atPose3(key).translation())
