"""Chains, keys and columns of all image blocks at once, against the same taken one by one."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from gtsam import Pose3

from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import Unknowns
from adjust.model.observations import FrameRef, ImageBlock, TableReading
from adjust.model.survey import Camera, LensParameter, PoseParameter, Station, Survey, Table, Target
from adjust.observations.images.segments import first_seen, ranges
from tests.adjust import helpers as h

POINTS = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]])


def _survey() -> Survey:
    """Cameras on four stations that move in every way there is; targets in the world and on each of them."""
    held = PoseParameter(Pose3(), "held")
    stations = (Station("base", "fixed", held), Station("tripod"), Station("hand", "epoch"),
                Station("head", "table", table_id="table"))  # fmt: skip
    cameras = tuple(Camera(f"on {s.station_id}", s.station_id, (640, 480), LensParameter("brown", ("fx",)))
                    for s in stations)  # fmt: skip
    targets = tuple(
        Target(f"{motion} on {carrier}", ("a", "b", "c", "d"), POINTS, carrier, motion)
        for motion, carrier in product(("fixed", "epoch"), (None, *(s.station_id for s in stations)))
    )
    reading = TableReading("table", "e0", np.zeros(2), np.eye(2))  # at e1 the head stands anywhere
    return Survey(cameras, stations, (Table("table"),), targets, table_readings=(reading,))


def _block(camera: str, epoch: str, target: str | None) -> ImageBlock:
    n = len(POINTS)
    return ImageBlock(camera, epoch, target, np.arange(n), np.zeros((n, 2)), np.tile(np.eye(2), (n, 1, 1)))


def test_shared_halves_give_the_chain_of_the_whole_way() -> None:
    survey = _survey()
    tree = FrameTree(survey, Unknowns())
    targets = [None, *(t.target_id for t in survey.targets)]
    lengths = {}
    for _, epoch, camera, target in product(range(2), ("e0", "e1"), survey.cameras, targets):
        a = FrameRef("world") if target is None else FrameRef("target", target, epoch)
        whole = tree.relative(a, FrameRef("camera", camera.camera_id, epoch))
        assert tree.of_image(_block(camera.camera_id, epoch, target)) == whole
        lengths[camera.camera_id, epoch, target] = len(whole)
    assert lengths["on base", "e0", None] == 1  # a held identity is left out
    assert lengths["on head", "e0", "fixed on head"] == 2  # what carries both cancels
    assert lengths["on head", "e0", "fixed on hand"] == 6  # camera, mount, motion, table; station, target
    assert lengths["on head", "e1", "fixed on hand"] == 4


def test_ranges_and_first_appearances() -> None:
    first, count = np.array([5, 0, 9, 2]), np.array([2, 0, 1, 3])
    np.testing.assert_array_equal(ranges(first, count), [5, 6, 9, 2, 3, 4])
    assert len(ranges(first[:0], count[:0])) == 0
    at, number = first_seen(np.array([7, 3, 7, 9, 3]))
    np.testing.assert_array_equal(at, [0, 1, 3])
    np.testing.assert_array_equal(number, [0, 1, 0, 2, 1])


def test_keys_of_blocks_in_the_order_in_which_they_are_met() -> None:
    survey, start = h.everything(1)
    graph = h.build(survey, start)
    images, u = graph.images, graph.unknowns
    assert len(images.blocks) > 3
    for b, block in enumerate(images.blocks):
        keys = [u.vectors["lens", block.camera_id].key]
        for slot in images.chains.slot[images.chains.ptr[b] : images.chains.ptr[b + 1]].tolist():
            keys += u.link_keys(slot)
        warp = u.vectors.get(("warp", block.target_id or ""))
        keys += [warp.key] if warp is not None else []
        wanted = list(dict.fromkeys(k for k in keys if k is not None))
        assert images.keys[b] == wanted
        assert images.of_blocks.columns[b] == sum(u.by_key[k].dim for k in wanted)


def test_a_point_that_the_target_does_not_have_is_refused() -> None:
    survey, start = h.everything(1)
    first = next(i for i, block in enumerate(survey.image_blocks) if block.target_id is not None)
    blocks = list(survey.image_blocks)
    blocks[first] = replace(blocks[first], point_idx=np.append(blocks[first].point_idx[:-1], 1000))
    survey = replace(survey, image_blocks=tuple(blocks))
    with pytest.raises(IndexError, match="does not have"):
        h.build(survey, start)
