"""What fuzzing found once is read again, and some hundred new inputs; ``python -m tests.fuzz`` does more."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CORPUS = ROOT / "tests" / "fuzz" / "corpus"


@pytest.mark.parametrize(
    "options",
    [
        ["--replay", str(CORPUS), "--reader", ",".join(sorted(p.name for p in CORPUS.iterdir()))],
        ["--count", "60", "--seed", "11", "--reader", "definition,covariance,solution,image,replaced-list,dialect"],
    ],
    ids=["corpus", "new"],
)
def test_no_finding(options: list[str], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.fuzz", *options, "--limit-s", "30", "--findings", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " 0 findings" in done.stdout
