"""What is shipped: the wheel's contents, lower bounds, licences, completion, help."""

import configparser
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from survey.cli import build_parser, main
from survey.commands.completion import SHELLS, commands_of
from tests.completion_checks import bash_completes, names_every_command_and_parses
from tests.lower_bounds import pins, requirements

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Names of what a wheel would hold beside the native library, by setuptools itself from a copy of the sources."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("adjust", "survey", "capture"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    (folder / "tests").mkdir()
    (folder / "tests" / "__init__.py").touch()
    command = [sys.executable, "-c", "import setuptools; setuptools.setup()", "-q", "build", "--build-lib", "out"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return {p.relative_to(folder / "out").as_posix() for p in (folder / "out").rglob("*") if p.is_file()}


@pytest.mark.slow
def test_wheel_has_every_source_and_nothing_else(installed: set[str]) -> None:
    wanted = {
        p.relative_to(ROOT).as_posix()
        for package in ("adjust", "survey", "capture")
        for p in (ROOT / package).rglob("*")
        if p.is_file() and "__pycache__" not in p.parts and p.suffix not in (".so", ".h", ".cpp")
    }
    assert wanted - installed == set()
    assert installed - wanted == set()
    assert {f"{package}/py.typed" for package in ("adjust", "survey", "capture")} <= installed


def test_every_dependency_has_a_lower_bound_and_a_licence() -> None:
    """``pins`` raises for a requirement without a bound; packaging_smoke.py --lowest installs what it gives."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    wanted = list(requirements(setup["options.extras_require"]))
    assert len(pins(wanted)) > 20
    page = (ROOT / "docs" / "licences.md").read_text(encoding="utf-8").lower()
    rows = {tuple(re.split(r"(?=[<>=])", line, maxsplit=1)) for line in wanted}
    assert [row for row in sorted(rows) if f"| {row[0].lower()} | {row[1]} |" not in page] == []


def test_lower_bounds_are_taken_as_they_stand() -> None:
    assert pins(["Some.Name>=2.0", "other[fast]>=1.2.3; python_version > '3'", "fixed==3.1.1"]) == [
        "Some.Name==2.0", "fixed==3.1.1", "other==1.2.3",
    ]  # fmt: skip
    for line in ("free", "below<3", "after>2.0"):
        with pytest.raises(ValueError, match=r"no lower bound"):
            pins([line])


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["labsurvey", "adj"], ["adjust"]),
        (["labsurvey", "re"], ["report", "remove"]),
        (["labsurvey", "convert", "a", "b", "--format", "kr"], ["krumm"]),
        (["labsurvey", "remove", "--ou"], ["--out"]),
        (["labsurvey", "completion", ""], ["bash", "zsh", "fish"]),
        (["labsurvey", "adjust", "so"], []),
    ],
)
def test_bash_completes(tmp_path: Path, words: list[str], expected: list[str]) -> None:
    bash_completes(build_parser(), tmp_path, words, expected)


@pytest.mark.parametrize("shell", SHELLS)
def test_scripts_name_every_command_and_parse(shell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    names_every_command_and_parses(build_parser(), shell, script, tmp_path)


def test_help_opens_with_a_command_and_names_the_next(capsys: pytest.CaptureFixture[str]) -> None:
    for command in commands_of(build_parser()):
        with pytest.raises(SystemExit) as stopped:
            main([command.name, "--help"])
        assert stopped.value.code == 0
        out = capsys.readouterr().out
        assert out.startswith(f"usage: labsurvey {command.name}")
        assert "Next: " in out


def test_changes_citation_and_metadata_speak_of_the_same_version() -> None:
    metadata = configparser.ConfigParser()
    metadata.read(ROOT / "setup.cfg", encoding="utf-8")
    version, author = metadata["metadata"]["version"], metadata["metadata"]["author"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (citation["version"], citation["license"]) == (version, metadata["metadata"]["license"])
    assert [a["name"] for a in citation["authors"]] == [author]
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    headings = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
    assert version in headings[:2]
    assert headings[0] in ("Unreleased", version)


def test_every_entry_page_says_how_to_install() -> None:
    pages = [ROOT / "README.md", ROOT / "docs" / "index.md", *(ROOT / "docs" / "tutorials").glob("*.md")]
    pages += [ROOT / "docs" / f"{name}.md" for name in (
        "report", "batch", "capture", "planning", "navigation", "networks", "relay", "formats", "python",
        "observations", "hand-eye")]  # fmt: skip
    assert [p.name for p in pages if "pip install ." not in p.read_text(encoding="utf-8")] == []
