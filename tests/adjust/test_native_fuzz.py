"""A short run of the fuzzer of the core, in a process of its own: a crash must not end the tests."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", [1])
def test_damaged_arguments_are_refused_or_answered(seed: int) -> None:
    """``LABSURVEY_FUZZ_SECONDS`` for longer."""
    root = Path(__file__).parents[2]
    seconds = os.environ.get("LABSURVEY_FUZZ_SECONDS", "1")
    command = [sys.executable, "-m", "tests.adjust.native_fuzz", "--seconds", seconds, "--seed", str(seed)]
    done = subprocess.run(command, cwd=root, env=os.environ | {"PYTHONPATH": str(root)}, capture_output=True, text=True,
                          check=False, timeout=float(seconds) + 120.0)  # fmt: skip
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-500:]}"
    assert "refused" in done.stdout
    assert "answered" in done.stdout
