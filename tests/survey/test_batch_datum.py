"""Control charts of epochs whose datums are free: calm on noise, alarmed by a move, silent where none is common."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.epochs.states import aligned, epoch_state
from adjust.model.survey import FloatArray, Point, PointParameter, Survey
from survey.batch.record import Record, record_from
from survey.batch.tables import overview_json, trend_lines
from survey.batch.trends import Trends, comparable, trends_of
from survey.batch.worker import adjust_task
from survey.project import write_project
from tests.adjust.test_congruence import free_hall
from tests.adjust.test_deformation import chain, measured

N = 12


def night(k: int, shift: dict[str, FloatArray] | None = None) -> Survey:
    """An epoch with noise of its own, and start values as somebody's tape gave them that night."""
    survey, start = free_hall(500 + k, shift)
    rng = np.random.default_rng(k)
    turn, offset = rng.normal() * 0.02, rng.normal(size=3) * 0.05
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    x = {n: R @ v + offset + rng.normal(size=3) * 0.01 for n, v in start.points.items()}
    return replace(survey, points=tuple(Point(n, PointParameter(v)) for n, v in x.items()))


def recorded(place: Path, surveys: list[Survey], first: int = 0) -> list[Record]:
    out = []
    for i, survey in enumerate(surveys, first):
        folder = place / f"n{i:02d}"
        write_project(folder, survey)
        out.append(adjust_task({"folder": folder.name, "path": str(folder), "redetect": False}))
    return out


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> list[Record]:
    return recorded(tmp_path_factory.mktemp("free"), [night(k) for k in range(N)])


def alarming(trends: Trends) -> list[str]:
    return [c.series.name for c in trends.charts if trends.is_alarming(c)]


@pytest.mark.slow
def test_noise_raises_no_alarm_where_every_epoch_has_its_own_free_datum(records: list[Record]) -> None:
    trends = trends_of(records)
    assert alarming(trends) == []
    assert trends.notes == ()
    points = [c for c in trends.charts if c.series.name.startswith("point/")]
    assert len(points) == 45
    # every coordinate has its own sigma; 41 of 45 are independent, 11 times: three sigmas of their mean square
    assert abs(np.mean([c.ratio**2 for c in points]) - 1.0) < 3.0 * np.sqrt(2.0 / 451)
    # as they stand the epochs differ by the motions of the whole
    as_they_are = trends_of([replace(r, free_datum=None) for r in records])
    assert len(alarming(as_they_are)) > 20


@pytest.mark.slow
def test_false_alarms_come_at_their_rate() -> None:
    """Many batches, epochs drawn from the covariance of one, without solving each again."""
    from survey.batch.common_datum import FreeDatum, Place
    from survey.batch.record import DONE, Number

    state = epoch_state(adjust(*free_hall(1, noise=False)))
    values, vectors = np.linalg.eigh(state.cov)
    rng = np.random.default_rng(3)
    names = [f"point/{n[1]}" for n in state.names]

    def epoch(i: int) -> Record:
        d = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=len(values)))
        turn, offset = rng.normal() * 0.02, rng.normal(size=3) * 0.05
        R = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
        places, numbers = [], []
        for k, name in enumerate(names):
            rows = slice(3 * k, 3 * k + 3)
            x = 1e3 * (R @ (np.asarray(state.values[k]) + d[rows]) + offset)
            C = R @ state.cov[rows, rows] @ R.T
            places.append(Place(name, tuple(x), None, tuple(C.ravel())))
            numbers += [Number(f"{name}/{a}", "mm", x[j], 1e3 * np.sqrt(C[j, j])) for j, a in enumerate("xyz")]
        free = FreeDatum(tuple(map(tuple, state.directions.T)), tuple(names), tuple(places))
        return Record(f"e{i}", DONE, numbers=tuple(numbers), free_datum=free)

    false = sum(bool(alarming(trends_of([epoch(i) for i in range(10)]))) for _ in range(40))
    # tests and runs at 5 % each; their sum bounds the rate at 10 %: 4 expected at most, 9 within three sigmas
    assert false <= 9


@pytest.mark.slow
def test_a_point_that_moved_is_found(records: list[Record], tmp_path: Path) -> None:
    found = list(records)
    found[8:9] = recorded(tmp_path, [night(8, {"P5": np.array([0.004, 0.0, 0.0])})], 8)
    trends = trends_of(found)
    assert trends.charts[0].series.name == "point/P5/x"
    assert trends.is_alarming(trends.charts[0])
    assert trends.charts[0].outside.tolist() == [k == 8 for k in range(N)]
    assert any("outside: n08" in line for line in trend_lines(trends, found))
    # it carries the datum of that night no more, or the others would see a fifteenth of it
    assert {name.split("/")[1] for name in alarming(trends)} == {"P5"}


@pytest.mark.slow
def test_epochs_without_a_common_datum_are_left_out_by_name(records: list[Record], tmp_path: Path) -> None:
    survey = night(3)
    lost = {r.reading_id for r in survey.readings if r.to.point_id == "P12"}
    survey = replace(survey, points=tuple(p for p in survey.points if p.point_id != "P12"),
                     readings=tuple(r for r in survey.readings if r.reading_id not in lost))  # fmt: skip
    (other,) = recorded(tmp_path, [survey])
    mixed = [*records[:4], replace(other, folder="few"), *records[4:]]
    trends = trends_of(mixed)
    assert alarming(trends) == []
    (note,) = trends.notes
    assert note.endswith("few: its datum is carried by other points or stations, without point/P12")
    assert len(next(c for c in trends.charts if c.series.name == "point/P5/x").series.value) == N
    assert len(next(c for c in trends.charts if c.series.name == "sigma0").series.value) == N + 1
    assert any(note in line for line in trend_lines(trends, mixed))
    assert json.loads(overview_json(mixed, trends))["trends"]["notes"] == [note]
    # a given datum beside free ones
    assert trends_of([*records, replace(other, folder="held", free_datum=None)]).notes[0].endswith(
        "held: its datum is given"
    )


def test_the_common_datum_is_that_of_the_comparison_of_two_epochs(records: list[Record]) -> None:
    (one, two), _ = comparable(records[:2])
    first, second = (epoch_state(adjust(night(k))) for k in (0, 1))
    after = aligned(first, second, first.directions, range(len(first.names)))
    d, before = ({n.name: n.value for n in r.numbers} for r in (two, one))
    shown = np.array([[d[f"point/{n[1]}/{a}"] - before[f"point/{n[1]}/{a}"] for a in "xyz"] for n in first.names])
    expected = np.array(after.values) - np.array(first.values)
    # both are differences in the inner datum over all points; its frame turned by the milliradians between two nights
    np.testing.assert_allclose(np.linalg.norm(shown, axis=1), 1e3 * np.linalg.norm(expected, axis=1), rtol=1e-3)


def test_a_record_with_a_free_datum_comes_back_from_the_journal(records: list[Record]) -> None:
    assert record_from(json.loads(json.dumps(records[0].plain()))) == records[0]
    broken = json.loads(json.dumps(records[0].plain()))
    broken["free_datum"]["open_motions"][0] = [1.0]
    with pytest.raises(ValueError, match="free_datum"):
        record_from(broken)


def a_priori(record: Record) -> Record:
    """With a priori sigmas: those of a redundancy of 12 are themselves too uncertain for limits of normal numbers."""
    s, free = record.summary["sigma0"], record.free_datum
    assert free is not None
    return replace(
        record, numbers=tuple(replace(n, sigma=n.sigma / s) for n in record.numbers),
        turns=tuple(replace(t, sigmas_arcsec=tuple(x / s for x in t.sigmas_arcsec)) for t in record.turns),
        free_datum=replace(free, places=tuple(replace(p, cov=tuple(c / s**2 for c in p.cov)) for p in free.places)),
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("rotations", [False, True])
def test_free_networks_of_pairs_are_calm_on_noise_too(tmp_path: Path, rotations: bool) -> None:
    rng = np.random.default_rng(21)
    surveys = []
    for _ in range(8):
        poses, turn = chain(), np.eye(4)
        turn[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn[:3, :3] *= np.sign(np.linalg.det(turn[:3, :3]))
        turn[:3, 3] = rng.normal(size=3)
        surveys.append(measured(turn @ poses, rng, held=None, rotations=rotations))
    trends = trends_of([a_priori(r) for r in recorded(tmp_path, surveys)])
    assert [name for name in alarming(trends) if name != "sigma0"] == []
    world = [c for c in trends.charts if c.series.name.startswith("world_from_station/")]
    assert len(world) == (18 if rotations else 36)
