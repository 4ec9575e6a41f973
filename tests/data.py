"""Where the real data lives, and what a test does without it."""

import os
from pathlib import Path

import pytest


def data_folder(*parts: str) -> Path:
    """Folder of real data; skips where it is absent, fails where ``LABSURVEY_REQUIRE_DATA`` is set."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("LABSURVEY_DATA", str(default))).joinpath(*parts)
    if not path.exists():
        message = f"real data not found at {path}; set LABSURVEY_DATA to the folder that holds it"
        if os.environ.get("LABSURVEY_REQUIRE_DATA"):
            pytest.fail(message)
        pytest.skip(message)
    return path
