"""The steps from a project to its adjustment: in order, each once, each under its name."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from adjust.model.errors import SurveyError
from survey.cli import main
from survey.examples import write_example
from survey.jobs.adjusting.steps import STEPS, adjust_project
from survey.project import read


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("steps") / "net"
    write_example("alignment", place)
    return place


def test_steps_run_in_order_and_only_those_that_concern(folder: Path) -> None:
    ran: list[str] = []

    @contextmanager
    def timed(name: str) -> Iterator[None]:
        ran.append(name)
        yield

    result = adjust_project(read(folder), False, timed=timed)
    assert result.converged
    assert ran == ["unobserved", "adjust", "causes"]
    names = [step.name for step in STEPS]
    assert [n for n in names if n in ran] == ran
    assert len(set(names)) == len(names)


def test_a_step_that_fails_is_the_last(folder: Path) -> None:
    ran: list[str] = []

    @contextmanager
    def timed(name: str) -> Iterator[None]:
        ran.append(name)
        yield

    def no_start(_survey: object) -> None:
        raise SurveyError("no start today")

    with pytest.raises(SurveyError, match="no start today"):
        adjust_project(read(folder), False, no_start, timed)
    assert ran == ["unobserved", "adjust"]


def test_the_log_names_every_step(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["adjust", str(folder), "-v"]) in (0, 3)
    said = capsys.readouterr().err
    for name in ("read", "unobserved", "adjust", "causes", "statistics", "report"):
        assert f"\n{name}: " in said
