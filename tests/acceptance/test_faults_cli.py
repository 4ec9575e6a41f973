"""Every planted fault ends the command with one clear message and no traceback, and leaves the project as it was."""

from pathlib import Path

import pytest

from survey.cli import FAILED, main
from tests.survey.faults import FAULTS, Fault, write_good_project


def _files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_there_are_more_than_forty_faults() -> None:
    assert len(FAULTS) >= 40


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_command_names_the_fault(fault: Fault, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_good_project(tmp_path)
    fault.plant(tmp_path)
    before = _files(tmp_path)
    assert main(["adjust", str(tmp_path), "--quiet"]) == FAILED
    out, err = capsys.readouterr()
    assert err.startswith("labsurvey: error: ")
    assert str(tmp_path) in err
    assert "Traceback" not in out + err
    assert _files(tmp_path) == before
