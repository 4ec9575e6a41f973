"""Every planted fault is one SurveyError that names the file, the line and the thing."""

import random
import re
from pathlib import Path

import pytest

from adjust.model.errors import SurveyError
from survey import project as files
from tests.sizes import size
from tests.survey.faults import DEFINITION_FAULTS, FAULTS, Fault, named_line, write_good_project

NEEDS_TABLES = "unknown group"  # only the tables say which groups there are
DEBRIS = ["", *"\"',\n=[]{}\0\ré@/:0", "-1", "nan", "1e999", "..", "B1"]


def test_good_project_has_no_fault(tmp_path: Path) -> None:
    write_good_project(tmp_path)
    assert len(files.read(tmp_path).survey.image_blocks) == 5


def test_names_of_faults_differ() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("fault", [f for f in DEFINITION_FAULTS if f.name != NEEDS_TABLES], ids=lambda f: f.name)
def test_definition_alone_finds_its_faults(fault: Fault, tmp_path: Path) -> None:
    write_good_project(tmp_path)
    fault.plant(tmp_path)
    with pytest.raises(SurveyError, match=fault.expected):
        files.read_definition(tmp_path)


def test_debris_gives_no_other_error(tmp_path: Path) -> None:
    """Random damage to any file either reads or is a SurveyError with a line."""
    write_good_project(tmp_path)
    paths = sorted(path for path in tmp_path.rglob("*") if path.suffix in (".csv", ".toml"))
    rng = random.Random(7)
    messages = []
    for _ in range(size(300)):
        path = rng.choice(paths)
        text = path.read_text(encoding="utf-8")
        start = rng.randrange(len(text))
        path.write_text(text[:start] + rng.choice(DEBRIS) + text[start + rng.randrange(4) :], encoding="utf-8")
        try:
            files.read(tmp_path)
        except SurveyError as error:
            messages.append(str(error))
        path.write_text(text, encoding="utf-8")
    assert len(messages) > size(300) // 3 - 5
    assert [message for message in messages if not re.search(r":\d+: ", message)] == []
