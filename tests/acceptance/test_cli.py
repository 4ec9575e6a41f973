"""The command line: usage, messages and exit codes. The jobs behind it are replaced here."""

import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from adjust.model.errors import SurveyError
from capture.cli import main as capture_main
from survey.cli import build_parser, main

ROOT = Path(__file__).resolve().parents[2]


def _run(*arguments, **more):
    return subprocess.run(
        [sys.executable, "-m", "survey", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=60, **more
    )


@dataclass
class _Outcome:
    folder: Path
    fit: str = "fits"
    paths: dict = field(default_factory=dict)

    @property
    def solution(self):
        return {"summary": {"fit": self.fit, "global_test": None}}

    def summary(self):
        return {"summary": {"sigma0": 1.25, "redundancy": 77}}

    def text(self):
        return f"text of {self.folder.name}"


@pytest.fixture
def jobs(monkeypatch):
    """``survey.jobs`` whose result depends on the folder's name."""
    calls = []

    def adjust_job(folder, *, out, progress, redetect, method="joint", report=None, ahead=None):
        calls.append(SimpleNamespace(folder=folder, out=out, progress=progress, redetect=redetect))
        if folder.name == "bad":
            raise SurveyError(f"{folder}/survey.toml:3: no such thing; write another")
        if folder.name == "bug":
            raise ZeroDivisionError("oops")
        if folder.name == "stopped":
            raise KeyboardInterrupt
        if folder.name == "gone":
            raise PermissionError(13, "Permission denied", str(folder / "results"))
        return _Outcome(folder, {"poor": "does_not_fit", "cautious": "cautious"}.get(folder.name, "fits"))

    module = ModuleType("survey.jobs.adjusting.job")
    module.adjust_job = adjust_job
    monkeypatch.setitem(sys.modules, "survey.jobs.adjusting.job", module)
    return calls


@pytest.fixture
def project(tmp_path):
    def make(name):
        (tmp_path / name).mkdir()
        (tmp_path / name / "survey.toml").write_text("format = 1\n")
        return str(tmp_path / name)

    return make


def test_help_opens_with_a_real_command_and_names_the_next():
    result = _run("--help")
    assert result.returncode == 0
    assert result.stdout.startswith("usage: labsurvey adjust lab")
    assert "Next: labsurvey example full-lab lab" in result.stdout


@pytest.mark.parametrize("command", ["adjust", "detect", "plan", "add", "example"])
def test_help_of_commands_does_the_same(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    text = capsys.readouterr().out
    assert stop.value.code == 0
    assert text.startswith(f"usage: labsurvey {command} ")
    assert "Next: " in text


def test_help_loads_nothing_heavy():
    code = (
        "import sys\nfrom survey.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print('LOADED', sorted({'numpy', 'gtsam', 'cv2', 'scipy', 'matplotlib'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert result.stdout.strip().endswith("LOADED []")


@pytest.mark.parametrize(
    "arguments",
    [[], ["adust", "lab"], ["adjust"], ["adjust", "lab", "--nonsense"], ["example", "lab", "x"],
     ["detect", "lab", "--jobs", "0"], ["adjust", "a", "b", "--out", "c"], ["adjust", "a", "./a"],
     ["example", "stereo", "x", "--seed", "-1"]],
)  # fmt: skip
def test_wrong_usage_is_2(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert "error: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["ajust", "lab"], "labsurvey: error: command 'ajust' is unknown; did you mean 'adjust'?"),
        (["example", "full_lab", "x"], "labsurvey example: error: NAME 'full_lab' is unknown; did you mean 'full-lab'"),
        (["adjust", "lab", "--redetct"], "labsurvey adjust: error: unknown flag --redetct; did you mean '--redetect'?"),
        (["--josn", "adjust", "lab"], "unknown flag --josn; did you mean '--json'?"),
        (["adjust"], "labsurvey adjust: error: FOLDER is missing"),
        ([], "labsurvey: error: no command is given; labsurvey --help lists them"),
        (["detect", "lab", "--jobs", "two"], "--jobs: found 'two'; expected a whole number, 1 or more"),
        (["plan", "lab", "--pixels", "few"], "labsurvey plan: error: --pixels: found 'few'; expected a number"),
        (["report", "lab", "--language", "fr"], "--language 'fr' is unknown; one of: en, de"),
        (["report", "lab", "other"], "'other' is one too many"),
    ],
)
def test_wrong_usage_offers_what_was_meant(arguments, expected, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    said = capsys.readouterr().err.splitlines()
    assert stop.value.code == 2
    assert said[0].startswith("usage: labsurvey ")
    assert expected in said[-1]
    assert "(labsurvey COMMAND ...)" not in said[-1]


def test_a_project_is_found_by_its_definition_too(jobs, project):
    folder = project("lab")
    assert main(["adjust", f"{folder}/survey.toml"]) == 0
    assert [call.folder for call in jobs] == [Path(folder)]


def test_a_folder_that_is_not_there_is_sought_nearby(project, capsys):
    folder = Path(project("full-lab"))
    assert main(["adjust", str(folder.with_name("full_lab"))]) == 1
    assert f"no such folder; did you mean {str(folder)!r}?" in capsys.readouterr().err
    (folder / "notes.txt").write_text("x")
    assert main(["adjust", str(folder / "notes.txt")]) == 1
    assert f"is a file; give the folder that holds survey.toml, here {folder}" in capsys.readouterr().err
    assert main(["adjust", str(folder.parent)]) == 1
    assert f"as {folder} does" in capsys.readouterr().err


def test_known_words_are_listed_once(tmp_path, capsys):
    (tmp_path / "survey.toml").write_text('format = 1\n[datum]\nkind = "nonsense"\n')
    assert main(["detect", str(tmp_path)]) == 1
    assert "known:" not in capsys.readouterr().err


def test_an_error_of_the_user_is_one_message_without_traceback(tmp_path):
    result = _run("adjust", str(tmp_path / "nowhere"))
    assert result.returncode == 1
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert "no such folder" in result.stderr
    assert "labsurvey example full-lab lab" in result.stderr


def test_a_folder_without_definition_is_named(tmp_path, capsys):
    assert main(["detect", str(tmp_path)]) == 1
    assert "there is no survey.toml in it" in capsys.readouterr().err


def test_adjust_prints_the_result_and_is_0(jobs, project, capsys):
    assert main(["adjust", project("good"), "--redetect", "--quiet"]) == 0
    assert capsys.readouterr() == ("text of good\n", "")
    assert jobs[0].redetect
    assert not jobs[0].progress
    assert jobs[0].out is None


def test_what_does_not_fit_is_3(jobs, project):
    assert main(["adjust", project("poor")]) == 3


def test_residuals_smaller_than_the_sigmas_mislead_nobody_and_are_0(jobs, project):
    assert main(["adjust", project("cautious")]) == 0


def test_a_survey_error_is_1_and_says_where(jobs, project, capsys):
    folder = project("bad")
    assert main(["adjust", folder]) == 1
    assert capsys.readouterr().err == f"labsurvey: error: {folder}/survey.toml:3: no such thing; write another\n"


def test_a_bug_keeps_its_traceback(jobs, project):
    with pytest.raises(ZeroDivisionError):
        main(["adjust", project("bug")])


def test_a_file_that_cannot_be_written_is_named(jobs, project, capsys):
    assert main(["adjust", project("gone")]) == 1
    assert "gone/results: Permission denied" in capsys.readouterr().err


def test_an_interrupt_is_clean(jobs, project, capsys):
    assert main(["adjust", project("stopped")]) == 130
    assert capsys.readouterr().err.strip() == "labsurvey: interrupted"


@pytest.mark.parametrize("place", ["before", "after"])
def test_json_is_one_object_wherever_the_flag_stands(jobs, project, capsys, place):
    folder = project("good")
    arguments = ["--json", "adjust", folder] if place == "before" else ["adjust", folder, "--json"]
    assert main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["summary"]["redundancy"] == 77


@pytest.mark.parametrize("arguments", [["--help"], ["adjust", "--help"], ["--version"]])
def test_a_reader_that_leaves_is_no_noise(arguments):
    command = [sys.executable, "-m", "survey", *arguments]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(timeout=60) in (0, 1)  # argparse does not mind, our own printing does


def _readme_command_lines():
    text = (ROOT / "README.md").read_text()
    chained = [part for block in re.findall(r"```\n(.*?)```", text, re.S) for part in re.split(r"&&|\n", block)]
    inline = re.findall(r"`(labsurvey [^`]*)`", text)
    lines = [part.strip().removeprefix(".venv/bin/") for part in chained + inline]
    return [line for line in lines if line.startswith("labsurvey ")]


def test_readme_has_exactly_two_set_up_commands():
    text = (ROOT / "README.md").read_text()
    setups = [line for line in text.splitlines() if "-m venv" in line]
    assert len(setups) == 2
    assert setups[0].endswith("labsurvey adjust lab")
    assert setups[1].endswith(".venv/bin/pytest")


@pytest.mark.parametrize("line", _readme_command_lines())
def test_every_command_line_of_the_readme_is_understood(line, capsys):
    arguments = shlex.split(line.replace("NAME", "stereo").replace("SHELL", "bash"))[1:]
    if "--help" in arguments:
        with pytest.raises(SystemExit) as stop:
            build_parser().parse_args(arguments)
        assert stop.value.code == 0
        return
    assert callable(build_parser().parse_args(arguments).run)


def test_every_flag_of_the_readme_exists(capsys):
    flags = set(re.findall(r"`(--?[a-z]+)", (ROOT / "README.md").read_text())) - {"--strict"}
    known = ""
    for command in ("adjust", "report", "plan", "add", "convert", "navigate", "align", "detect", "schema"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        known += capsys.readouterr().out
    with pytest.raises(SystemExit):
        capture_main(["run", "--help"])
    known += capsys.readouterr().out
    assert flags
    assert sorted(flag for flag in flags if flag not in known) == []


def test_the_check_script_is_executable_and_parses():
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
    assert subprocess.run(["bash", "-n", str(ROOT / ".ci" / "run")], timeout=20).returncode == 0
