"""Work for several workers: what takes long comes first."""

import pytest

_LONG = ("test_docs", "test_end_to_end", "test_coverage", "test_planted_faults", "test_hardening_fuzz", "test_mfns",
         "test_navigation", "test_pose_networks", "test_led_selfcal", "test_networks", "test_relay_paper",
         "test_positioner", "test_batch", "test_detection", "test_camera_lab", "test_camera_gige")  # fmt: skip
"""Files of 20 s and more: what is begun last is waited for by all workers."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The long files first, all others in their order."""
    rank = {name: i for i, name in enumerate(_LONG)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(_LONG)))
