"""When things were observed: the times of epochs, and clocks that are late, drift, or read rows one after the other.

What a camera, a turntable or a robot observed at an epoch of time t it observed at

    t + offset + drift (t - middle of the session) + line_time (row - (height - 1) / 2) + its own deviation

so that a positive offset is a clock that is late. Rows are those of a camera's image points, (height - 1) / 2 its
middle one; line_time is positive where the upper rows are read first. Where everything is between the epochs follows
from where it is at them (:mod:`adjust.observations.clocks`).
"""

from collections.abc import Iterator, Mapping

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.names import natural_key
from adjust.model.result import ParameterName
from adjust.model.survey import Clock, Survey

CLOCK: Mapping[str, str] = {"offset": "s", "drift": "1", "line_time": "s"}
"""Components of a clock and their units; without times of the epochs, of which it counts the intervals, not seconds."""
INTERVALS = "interval"
CLOCKS: Mapping[str, tuple[str, ...]] = {
    "camera_clock": tuple(CLOCK), "table_clock": ("offset", "drift"), "pose_clock": ("offset", "drift"),
}  # fmt: skip
"""Whose clocks there are, of images, of readings of tables, of measured poses, and what they have."""


def clocks_of(survey: Survey) -> Iterator[tuple[ParameterName, Clock]]:
    """The clocks of cameras, of tables' readings and of stations' measured poses, by name.

    Raises SurveyError for components that there are not, or ties.
    """
    owners: list[tuple[str, str, Clock | None]] = [
        *(("camera_clock", c.camera_id, c.clock) for c in survey.cameras),
        *(("table_clock", t.table_id, t.clock) for t in survey.tables),
        *(("pose_clock", s.station_id, s.clock) for s in survey.stations),
    ]
    for kind, owner, clock in owners:
        if clock is None:
            continue
        known = CLOCKS[kind]
        name = (kind, owner)
        if wrong := set(clock.parameters.names) - set(known):
            raise SurveyError(f"clock of {clock_text(name)}: has no {sorted(wrong)}; it has {', '.join(known)}")
        if clock.parameters.ties:
            raise SurveyError(f"clock of {clock_text(name)}: its components cannot be tied to each other")
        yield name, clock


def clock_text(name: ParameterName) -> str:
    """Whose clock it is, as people say it."""
    return {"camera_clock": "camera {}", "table_clock": "table {}", "pose_clock": "the poses of station {}"}[
        name[0]].format(name[1])  # fmt: skip


@frozen
class EpochTimes:
    """By epoch its time, s, or its number where the unit is ``INTERVALS``. middle: of the session."""

    of: Mapping[str, float]
    unit: str

    @property
    def middle(self) -> float:
        """Half way between the first and the last epoch."""
        return 0.5 * (min(self.of.values()) + max(self.of.values())) if self.of else 0.0


def epoch_times(survey: Survey) -> EpochTimes:
    """The times of all epochs of a survey: given, or evenly spaced in the order of their names (numbers by value).

    Raises SurveyError where only some are given.
    """
    frames = [f for p in survey.pairs for f in (p.a, p.b)]
    names = {b.epoch_id for b in survey.image_blocks} | {r.epoch_id for r in survey.table_readings}
    names |= {f.epoch_id for f in frames if f.epoch_id is not None}
    order = sorted(names, key=natural_key)
    if not survey.times:
        step = survey.epoch_interval
        return EpochTimes({e: i * (step or 1.0) for i, e in enumerate(order)}, INTERVALS if step is None else "s")
    if missing := [e for e in order if e not in survey.times]:
        raise SurveyError(f"epoch {missing[0]!r} has no time, but others have; give it under times_s")
    return EpochTimes(dict(survey.times), "s")
