"""Completion and help of ``labcapture``, as those of ``labsurvey``."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from capture.cli import build_parser, main
from survey.commands.completion import SHELLS, commands_of, completion_script
from tests.completion_checks import bash_completes, names_every_command_and_parses


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["labcapture", "ru"], ["run"]),
        (["labcapture", "ex"], ["export"]),
        (["labcapture", "run", "plan.toml", "--dr"], ["--dry-run"]),
        (["labcapture", "--quiet", "view", "--al"], ["--allow-move"]),
        (["labcapture", "completion", "z"], ["zsh"]),
        (["labcapture", "run", "pl"], []),
    ],
)
def test_bash_completes(tmp_path: Path, words: list[str], expected: list[str]) -> None:
    bash_completes(build_parser(), tmp_path, words, expected)


@pytest.mark.parametrize("shell", SHELLS)
def test_scripts_name_every_command_and_parse(shell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "labsurvey" not in script
    names_every_command_and_parses(build_parser(), shell, script, tmp_path)


def test_fish_completes(tmp_path: Path) -> None:
    if not shutil.which("fish"):
        pytest.skip("there is no fish here")
    (tmp_path / "s").write_text(completion_script(build_parser(), "fish"))
    for line, expected in (("labcapture ru", "run"), ("labcapture view --al", "--allow-move")):
        code = f"source {tmp_path / 's'}; complete -C '{line}'"
        done = subprocess.run(["fish", "--no-config", "-c", code], capture_output=True, text=True, check=True)
        assert expected in [found.split("\t")[0] for found in done.stdout.splitlines()]


def test_help_opens_with_a_command_and_names_the_next(capsys: pytest.CaptureFixture[str]) -> None:
    for command in commands_of(build_parser()):
        with pytest.raises(SystemExit) as stopped:
            main([command.name, "--help"])
        assert stopped.value.code == 0
        out = capsys.readouterr().out
        assert out.startswith(f"usage: labcapture {command.name}")
        assert "Next: " in out
        assert "--json" in out
        assert "--quiet" in out


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--version"])
    assert re.fullmatch(r"labcapture (\d+\.\d+.*|, run from .*)\n", capsys.readouterr().out)
