"""Every planted fault is one SurveyError that names the file, the line and the thing."""

import re
from pathlib import Path

import pytest

from adjust.errors import SurveyError
from survey import files
from tests.survey.faults import DEFINITION_FAULTS, FAULTS, Fault, named_line, write_good_project


def test_good_project_has_no_fault(tmp_path: Path) -> None:
    write_good_project(tmp_path)
    assert len(files.read(tmp_path).survey.image_blocks) == 5


def test_names_of_faults_differ() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_fault_is_named(fault: Fault, tmp_path: Path) -> None:
    write_good_project(tmp_path)
    line = fault.plant(tmp_path)
    with pytest.raises(SurveyError) as caught:
        files.read(tmp_path)
    message = str(caught.value)
    assert str(tmp_path) in message
    assert re.search(fault.expected, message), message
    if line:
        named = named_line(tmp_path, message)
        assert named is not None, message
        assert line.strip() in named or named.strip() in line, f"{message}\nnames: {named}\nexpected: {line}"


@pytest.mark.parametrize("fault", DEFINITION_FAULTS, ids=lambda fault: fault.name)
def test_definition_alone_finds_its_faults(fault: Fault, tmp_path: Path) -> None:
    if fault.name == "unknown group":
        pytest.skip("only the tables say which groups there are")
    write_good_project(tmp_path)
    fault.plant(tmp_path)
    with pytest.raises(SurveyError, match=fault.expected):
        files.read_definition(tmp_path)
