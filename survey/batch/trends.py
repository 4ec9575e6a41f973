"""The numbers of all folders of a batch as series over the epochs, and their control charts."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from adjust.model.frozen import frozen
from adjust.testing.criteria import sidak
from adjust.testing.distributions import norm
from survey.batch.common_datum import Moved, in_common_datum, incomparable, scale_is_open
from survey.batch.control import WIDTH, Chart, Run, Series, chart
from survey.batch.record import FAILED, Number, Record, Turn
from survey.solution.quantities import ARCSEC_PER_RAD

LEVEL = 0.05
"""Error probability of all charts together, for the tests of agreement and of slopes."""


@frozen
class Finding:
    """What is wrong with a chart: ``disagrees``, ``drifts``, ``outside`` of own sigmas, or the kind of a run.

    epochs: positions in the batch, of those outside or from the first to the last of a run.
    """

    kind: str
    epochs: tuple[int, ...] = ()


@frozen(eq=False)
class Trends:
    """Charts of all numbers that two epochs or more have, most alarming first.

    level: of a single test, so that all together have ``LEVEL``. n_points: of all charts. expected: points outside of
    limits that chance alone would make of normally distributed numbers. notes: what could not be compared, and why.
    """

    charts: tuple[Chart, ...]
    level: float
    n_points: int
    notes: tuple[str, ...] = ()

    @property
    def expected(self) -> float:
        """0.27 % of the points lie beyond three sigmas."""
        return 0.0026998 * self.n_points

    def disagrees(self, c: Chart) -> bool:
        """Whether epochs differ by more than their sigmas say."""
        return c.p < self.level

    def drifts(self, c: Chart) -> bool:
        """Whether there is a slope over the epochs."""
        return bool(c.p_slope < self.level)

    def strays(self, c: Chart) -> bool:
        """Whether a single epoch is further off than chance makes one of all points of all charts."""
        bound = float(norm.isf(0.5 * sidak(LEVEL, max(self.n_points, 1))))
        return bool((np.abs(c.deviation) > bound).any())

    def unlikely(self, run: Run) -> bool:
        """Whether chance makes a run as long or longer in all charts together at most as often as ``LEVEL`` says.

        Of n points 2^-k n begin a run of k or more on one side of the mean (the one before is on the other side), and
        2 n k / (k + 1)! a run of k or more steadily up or down (Levene and Wolfowitz 1944).
        """
        k = run.last - run.first + 1
        share = 2.0**-k if run.kind == "one_side" else 2.0 * k / math.factorial(k + 1)
        return self.n_points * share < LEVEL

    def is_alarming(self, c: Chart) -> bool:
        """Whether a person should look: a test of all charts together fails, or a run is too long for chance."""
        return self.disagrees(c) or self.drifts(c) or self.strays(c) or any(self.unlikely(run) for run in c.runs)

    @property
    def alarming(self) -> list[Chart]:
        """The charts that a person should look at."""
        return [c for c in self.charts if self.is_alarming(c)]

    def findings(self, c: Chart) -> list[Finding]:
        """What every form of the overview says of a chart, in this order."""
        tests = (("disagrees", self.disagrees(c)), ("drifts", self.drifts(c)))
        outside = tuple(c.series.epoch[c.outside].tolist())
        runs = (Finding(r.kind, tuple(c.series.epoch[r.first : r.last + 1].tolist())) for r in c.runs)
        return [*(Finding(kind) for kind, fails in tests if fails), *([Finding("outside", outside)] if outside else []),
                *runs]  # fmt: skip


def trends_of(records: Sequence[Record]) -> Trends:
    """Series of all numbers that are there in two epochs or more, and their charts."""
    records, notes = comparable(records)
    charts = [chart(s) for s in all_series(records) if len(s.value) >= 2]
    level = sidak(LEVEL, max(2 * len(charts), 1))
    made = Trends((), level, sum(len(c.series.value) for c in charts))
    charts.sort(key=lambda c: (not made.is_alarming(c), -_alarm(c)))
    return Trends(tuple(charts), level, made.n_points, notes)


def comparable(records: Sequence[Record]) -> tuple[tuple[Record, ...], tuple[str, ...]]:
    """The records with the world of epochs that have free datums in a common one; what is not comparable is left out.

    Also says what was left out, and why.
    """
    solved = [i for i, r in enumerate(records) if r.state != FAILED]
    bad = {solved[k]: why for k, why in incomparable([records[i].free_datum for i in solved]).items()}
    out, notes = list(records), []
    for why in dict.fromkeys(bad.values()):
        names = [records[i].folder for i in bad if bad[i] == why]
        listed = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
        notes.append(f"coordinates and poses in the world are not compared with those of the other epochs: {listed}: "
                     f"{why}")  # fmt: skip
    for i in bad:
        out[i] = _without_world(records[i])
    free = [i for i in solved if i not in bad and records[i].free_datum is not None]
    data = [d for i in free if (d := records[i].free_datum) is not None]
    for i, datum, moved in zip(free, data, in_common_datum(data) if data else [], strict=True):
        out[i] = _moved(records[i], moved, scale_is_open(datum))
    if any(map(scale_is_open, data)):
        notes.append(
            "the observations do not determine the scale: lengths are in that of all epochs together, and those that "
            "a camera, a station or a table has in itself are not compared"
        )
    return tuple(out), tuple(notes)


_WORLD = ("point/", "world_from_")


def _without_world(record: Record) -> Record:
    return replace(
        record, numbers=tuple(n for n in record.numbers if not n.name.startswith(_WORLD)),
        turns=tuple(t for t in record.turns if not t.name.startswith(_WORLD)),
    )  # fmt: skip


def _moved(record: Record, moved: Mapping[str, Moved], without_lengths: bool) -> Record:
    """The record with its world moved; without lengths of bodies where the scale is open."""
    numbers = _moved_numbers(record.numbers, moved)
    if without_lengths:
        numbers = (n for n in numbers if n.unit != "mm" or n.name.startswith(_WORLD))
    return replace(record, numbers=tuple(numbers), turns=tuple(_moved_turns(record.turns, moved)))


def _moved_numbers(numbers: Sequence[Number], moved: Mapping[str, Moved]) -> Iterator[Number]:
    """Numbers of a record, those of the world in the common datum."""
    for number in numbers:
        path, _, axis = number.name.rpartition("/")
        place = moved.get(path)
        if place is None or axis not in ("x", "y", "z"):
            yield number
        else:
            k = "xyz".index(axis)
            yield replace(number, value=place.x_mm[k], sigma=place.sigmas_mm[k])


def _moved_turns(turns: Sequence[Turn], moved: Mapping[str, Moved]) -> Iterator[Turn]:
    """Rotations of a record, those of the world in the common datum."""
    for turn in turns:
        place = moved.get(turn.name)
        if place is None or place.wxyz is None or place.sigmas_arcsec is None:
            yield turn
        else:
            yield replace(turn, wxyz=place.wxyz, sigmas_arcsec=place.sigmas_arcsec)


def _alarm(c: Chart) -> float:
    """How far the worst of a chart is beyond its limits, in sigmas."""
    deviation = np.abs(c.series.value - c.mean)
    own = float(np.max(WIDTH * deviation / np.maximum(c.by_sigma, 1e-300)))
    return max(own, abs(c.slope) / c.slope_sigma if c.slope_sigma > 0.0 else 0.0)


def all_series(records: Sequence[Record]) -> Iterator[Series]:
    """sigma0, groups, then every number and rotation, in the order in which the first epoch has them."""
    rows: dict[tuple[str, str], list[tuple[int, float, float]]] = {}
    freedom = np.array([_freedom(record) for record in records])
    for epoch, record in enumerate(records):
        for name, unit, value, sigma in (*_quality(record), *((n.name, n.unit, n.value, n.sigma)
                                                              for n in record.numbers)):  # fmt: skip
            if np.isfinite(value) and np.isfinite(sigma) and sigma > 0.0:
                rows.setdefault((name, unit), []).append((epoch, value, sigma))
    for name, unit, epoch, value, sigma in _turns(records):
        rows.setdefault((name, unit), []).append((epoch, value, sigma))
    for (name, unit), found in rows.items():
        epochs, values, sigmas = (np.array(column) for column in zip(*found, strict=True))
        at, known = epochs.astype(np.int64), name == "sigma0" or name.startswith("group/")
        if known:  # sigma over value is known: with each its own, small values would count more
            sigmas = sigmas / values * float(np.median(values))
        free = np.full(len(at), np.inf) if known else freedom[at]
        yield Series(name, unit, at, values.astype(float), sigmas.astype(float), free)


def _freedom(record: Record) -> float:
    """Of the sigma0 that scales all sigmas of an epoch; infinite where they are a priori."""
    redundancy = record.summary.get("redundancy") or 0
    return float(redundancy) if record.summary.get("sigmas") == "a_posteriori" and redundancy > 0 else float("inf")


def _quality(record: Record) -> Iterator[tuple[str, str, float, float]]:
    """sigma0 and the scale of each group, with their own sigmas s / sqrt(2 r) (Koch 1999, section 3.2)."""
    r, sigma0 = record.summary.get("redundancy") or 0, record.summary.get("sigma0")
    if r > 0 and sigma0:
        yield "sigma0", "", sigma0, sigma0 / np.sqrt(2.0 * r)
    for name, group in record.groups.items():
        scale, freedom = group.get("sigma_scale"), group.get("redundancy") or 0.0
        # a group hardly controlled has no scale worth a chart
        if len(record.groups) > 1 and scale and freedom > 5.0:
            yield f"group/{name}/sigma_scale", "", scale, scale / np.sqrt(2.0 * freedom)


def _turns(records: Sequence[Record]) -> Iterator[tuple[str, str, int, float, float]]:
    """Rotations against the first epoch that has them: a rotation vector about the axes of b, arcsec."""
    first: dict[str, Rotation] = {}
    for epoch, record in enumerate(records):
        for turn in record.turns:
            w, x, y, z = turn.wxyz
            now = Rotation.from_quat([x, y, z, w])
            vector = ARCSEC_PER_RAD * (first.setdefault(turn.name, now).inv() * now).as_rotvec()
            for axis, value, sigma in zip(("rx", "ry", "rz"), vector, turn.sigmas_arcsec, strict=True):
                if np.isfinite(sigma) and sigma > 0.0:
                    yield f"{turn.name}/{axis}", "arcsec", epoch, float(value), sigma
