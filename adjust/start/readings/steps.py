"""Readings, distances and baselines as steps of the search: points and stations from what is known by now."""

import numpy as np

from adjust.frames.unknowns import Chain
from adjust.model.survey import Survey
from adjust.start.positions import Positions, given_points
from adjust.start.readings.sights import ties
from adjust.start.readings.start import find_points
from adjust.start.readings.tilted import TiltedSetups


class Readings:
    """What the readings of a survey can still place."""

    def __init__(self, survey: Survey, positions: Positions) -> None:
        self.survey, self.positions = survey, positions
        self.given = given_points(survey)
        self.tilted = TiltedSetups(survey, positions)
        self._before: tuple[int, int] | None = None
        refs = [*survey.reading_refs, *(ref for d in survey.distances for ref in (d.a, d.b))]
        refs += [ref for a, b, _ in ties(survey) for ref in (a, b)]
        mentioned = {ref.point_id for ref in refs if ref.frame is None}
        self.concerned = np.array([p.point_id in mentioned for p in survey.points], dtype=np.bool_)
        """Which points (n,) any reading, distance or baseline starts from or ends at."""
        self._observed = bool(refs)
        self._in_frames = list(dict.fromkeys(ref for ref in refs if ref.frame is not None))

    def advance(self, firm: bool = True) -> bool:
        """One step; whether there was one. firm: see :meth:`adjust.start.points.Positions.put`."""
        if self.tilted.advance():
            self.positions.put(self.tilted.known, firm)
            return True
        return self._levelled(firm)

    def waiting(self) -> list[Chain]:
        """Of stations without a pose on which set-ups stand that are not levelled."""
        chains = [self.positions.chain(ref.frame) for ref in self.tilted.sights if ref.frame is not None]
        return [chain for chain in chains if self.positions.network.open_slots(chain)]

    def _levelled(self, firm: bool) -> bool:
        """Points from levelled set-ups, distances and baselines, where anything is new since the last time."""
        points, network = self.positions.points, self.positions.network
        whole = np.isfinite(points.x).all(axis=1)
        now = int(whole.sum()), int(network.has.sum())
        if not self._observed or whole.all() or now == self._before:
            return False
        self._before = now
        ids = [p.point_id for p in self.survey.points]
        known = {**self.given, **{ids[i]: points.x[i] for i in np.flatnonzero(whole).tolist()}}
        return self.positions.put(find_points(self.survey, known, self.positions.of(self._in_frames)), firm)
