"""`.ci/run` with tools that only say that they were called: whatever fails, it fails, and shows what was said."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

RUN = Path(__file__).parents[1] / ".ci" / "run"
README = """python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/pytest
python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/labsurvey adjust lab
"""
TOOLS = ("pip", "uv", "pytest", "labsurvey", "ruff", "mypy", "lint-imports", "sphinx-build", "python")
_TOOL = """#!/bin/sh
echo "called: ${0##*/} $*" >&2
[ "${0##*/}" = python ] && case "$*" in *build_tools*) echo "clang++ one.cpp";; esac
case "${0##*/} $*" in *"$FAILING"*) echo "this is wrong" >&2; exit 3;; esac
"""
_VENV = """#!/bin/sh
mkdir -p .venv/bin
for name in {tools}; do [ -e .venv/bin/$name ] || ln -s "$TOOL" .venv/bin/$name; done  # others may be running them
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A checkout of the script, README and an example, and a folder of tools."""
    (tmp_path / ".ci").mkdir()
    (tmp_path / "examples").mkdir()
    (tmp_path / "tools").mkdir()
    shutil.copy(RUN, tmp_path / ".ci")
    (tmp_path / "README.md").write_text(README, encoding="utf-8")
    (tmp_path / "examples" / "one.py").touch()
    for name in ("g++", "clang++", "chromium", "tool"):
        (tmp_path / "tools" / name).write_text(_TOOL, encoding="utf-8")
    (tmp_path / "tools" / "python3").write_text(_VENV.format(tools=" ".join(TOOLS)), encoding="utf-8")
    for tool in (tmp_path / "tools").iterdir():
        tool.chmod(0o755)
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    return tmp_path


def _run(place: Path, failing: str) -> subprocess.CompletedProcess[str]:
    tools = place / "tools"
    more = {"PATH": f"{tools}:{os.environ['PATH']}", "TOOL": str(tools / "tool"), "FAILING": failing}
    return subprocess.run(
        ["bash", ".ci/run"], cwd=place, env=os.environ | more, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, check=False, timeout=300,
    )  # fmt: skip


def test_all_checks_are_made(place: Path) -> None:
    done = _run(place, "nothing of this")
    assert done.returncode == 0, done.stdout
    assert "== all passed" in done.stdout
    for called in ("ruff check .", "mypy --strict adjust survey capture", "lint-imports", "clang++ one.cpp",
                   "python tests/native_checked.py -m tests.adjust.native_fuzz", "labsurvey adjust lab",
                   "python examples/one.py", "pytest tests/test_docs.py"):  # fmt: skip
        assert f"called: {called}" in done.stdout


@pytest.mark.parametrize(
    "failing",
    ["pip install .", "ruff", "mypy", "lint-imports", "clang++ one.cpp", "build_tools", "test_native.py",
     "native_fuzz", "labsurvey", "examples/one.py", "sphinx-build", "test_docs.py"],
)  # fmt: skip
def test_whatever_fails_is_shown_and_fails_the_whole(place: Path, failing: str) -> None:
    done = _run(place, failing)
    assert done.returncode != 0
    assert "this is wrong" in done.stdout
    assert "all passed" not in done.stdout


def test_what_was_found_beside_the_tests_is_shown_where_the_tests_fail_too(place: Path) -> None:
    tool = place / "tools" / "tool"
    tool.write_text(_TOOL + '[ "${0##*/} $*" != "pytest " ] || { sleep 1; exit 4; }\n', encoding="utf-8")
    done = _run(place, "ruff")
    assert done.returncode == 4
    assert "this is wrong" in done.stdout
