"""Two epochs that are not congruent: planted names, units, scales, hands, datums are named, motions are not blamed."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gtsam import Rot3

from adjust.adjustment import adjust
from adjust.diagnosis.between import Between, causes_between
from adjust.epochs.congruence import CongruenceOptions, congruence
from adjust.model.survey import Datum, FloatArray, PointParameter, Survey
from survey.cli import main
from survey.project.writing import write_project
from tests.adjust.terrestrial_networks import measured, polar_network

OPTIONS = CongruenceOptions(names=("spring", "autumn"))
Truth = dict[tuple[str, ...], Any]


def network(seed: int, places: Callable[[dict[str, FloatArray]], dict[str, FloatArray]], held: int = 0) -> Survey:
    """Readings of four set-ups between eight points that are where ``places`` says; the first ones held there."""
    survey, truth = polar_network(5, extra=False, datum=Datum("given" if held else "inner"))
    new = places({p.point_id: np.asarray(truth["point", p.point_id]) for p in survey.points})
    truth = truth | {("point", n): x for n, x in new.items()}
    points = tuple(
        replace(p, x_in_world=PointParameter(new[p.point_id], "held") if i < held else PointParameter())
        for i, p in enumerate(survey.points)
    )
    return measured(replace(survey, points=points), truth, seed)


def as_it_was(x: dict[str, FloatArray]) -> dict[str, FloatArray]:
    return x


def exchanged(x: dict[str, FloatArray]) -> dict[str, FloatArray]:
    return x | {"P4": x["P6"], "P6": x["P4"]}


def times(factor: float) -> Callable[[dict[str, FloatArray]], dict[str, FloatArray]]:
    return lambda x: {n: factor * v for n, v in x.items()}


def mirrored(x: dict[str, FloatArray]) -> dict[str, FloatArray]:
    return {n: v * np.array([-1.0, 1.0, 1.0]) for n, v in x.items()}


def elsewhere(x: dict[str, FloatArray]) -> dict[str, FloatArray]:
    R = Rot3.Rz(0.2).matrix()
    return {n: R @ v + np.array([3.0, -1.0, 0.5]) for n, v in x.items()}


def one_moved(x: dict[str, FloatArray]) -> dict[str, FloatArray]:
    return x | {"P5": x["P5"] + np.array([4e-3, -2e-3, 1e-3])}


def causes(places: Any, held: int = 0, seed: int = 2) -> tuple[Between, ...]:
    a, b = adjust(network(1, as_it_was, held)), adjust(network(seed, places, held))
    return causes_between(a, b, congruence(a, b, OPTIONS), OPTIONS)


@pytest.mark.parametrize(
    ("places", "held", "name", "says"),
    [
        (exchanged, 0, "names exchanged", "P4 and P6 are called by each other's names in autumn"),
        (exchanged, 2, "names exchanged", "P4 and P6 are called by each other's names in autumn"),
        (times(1.0 / 25.4), 0, "unit of lengths", "all lengths of autumn are inches, read as millimetres"),
        (times(1e3), 0, "unit of lengths", "all lengths of autumn are millimetres, read as metres"),
        (times(1.0 + 1e-4), 0, "scale", "all lengths of autumn are +"),
        (mirrored, 0, "mirrored", "autumn is the mirror image of spring"),
        (elsewhere, 2, "another datum", "all of autumn (P0, P1, P2, P3 and 4 more) moved as one"),
    ],
)
def test_what_is_wrong_between_epochs_is_named_first(places: Any, held: int, name: str, says: str) -> None:
    found = causes(places, held)
    assert found[0].name == name
    assert found[0].cause.startswith(says)
    assert found[0].statistic < 0.01 * found[0].before
    if name == "scale":
        ppm = float(found[0].cause.split(" are ")[1].split(" ppm")[0])
        assert ppm == pytest.approx(100.0, abs=10.0)


@pytest.mark.parametrize("held", [0, 2])
@pytest.mark.parametrize("places", [as_it_was, one_moved])
def test_motions_and_good_epochs_are_not_blamed(places: Any, held: int) -> None:
    for seed in (2, 3):
        assert causes(places, held, seed) == ()


def test_the_command_says_it_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, survey in (("spring", network(1, as_it_was)), ("autumn", network(2, exchanged))):
        write_project(tmp_path / name, survey)
    folders = [str(tmp_path / n) for n in ("spring", "autumn")]
    assert main(["compare", *folders, "--quiet"]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  ! ")]
    assert said[0].startswith("  ! probable cause: P4 and P6 are called by each other's names in autumn; exchange them")
    assert main(["compare", *folders, "--json", "--quiet"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [(c["name"], c["ids"]) for c in found["diagnosis"]] == [("names exchanged", ["P4", "P6"])]
