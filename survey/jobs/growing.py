"""The job ``add --live``: pairs go into an adjusted network while they are measured, and each is told at once."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError, listed
from adjust.model.observations import Pair
from adjust.model.survey import Station
from adjust.relay.session import Addition, NetworkSession
from adjust.testing.distributions import chi2
from survey.folder.text import read_text
from survey.jobs.adjusting.warm_start import warm_adjustment
from survey.project import Definition, read
from survey.project.declared.node import read_toml
from survey.project.declared.owners import read_stations
from survey.project.merging import check_new
from survey.project.project import DEFINITION_FILE, OBSERVATIONS_FOLDER
from survey.project.tables.files import read_table
from survey.project.tables.layouts import PAIRS
from survey.project.tables.pairs import read_pairs
from survey.project.tables.references import Names
from survey.solution.earlier.previous import read_previous

_ALPHA = 0.001
_MOST_NAMED = 6


@dataclass(eq=False)
class Growing:
    """A network that is measured: what is new stands in ``new`` and comes row by row.

    pairs: of ``new``, in the session. told: complaints that were made. seen: states of its files at the last look.
    """

    definition: Definition
    new: Path
    session: NetworkSession
    pairs: dict[str, Pair] = field(default_factory=dict)
    told: set[str] = field(default_factory=set)
    seen: tuple[tuple[int, int], ...] = ()

    @classmethod
    def begin(cls, folder: Path, new: Path) -> "Growing":
        """From the last solution of ``folder``. Raises SurveyError, also for what is no network of pairs of poses."""
        check_new(folder, new)
        project = read(folder)
        adjusted, _ = warm_adjustment(project, read_previous(project), False)
        try:
            return cls(project, new, NetworkSession(adjusted))
        except SurveyError as error:
            raise SurveyError(f"{folder}: {error}, without --live") from error

    def look(self) -> Iterator[str]:
        """Take in what has come since the last look; a line for each pair, and for what cannot be taken, once."""
        files = (self.new / DEFINITION_FILE, self.new / OBSERVATIONS_FOLDER / "pairs.csv")
        seen = tuple((status.st_mtime_ns, status.st_size) for p in files if p.is_file() for status in (p.stat(),))
        if seen == self.seen:
            return
        self.seen = seen
        try:
            found = {pair.pair_id: pair for pair in self._measured()}
        except SurveyError as error:
            yield from self._complaint(str(error))
            return
        gone = [i for i in self.pairs if i not in found or not found[i].used]
        if gone:
            self.session.remove([i for i in gone if self.session.uses(i)])
            yield f"taken out: {listed(gone, _MOST_NAMED)}"
            self.pairs = {i: pair for i, pair in self.pairs.items() if i not in gone}
        waiting = [pair for i, pair in found.items() if i not in self.pairs and pair.used]
        for pair in (found[i] for i, before in self.pairs.items() if not _same(found[i], before)):
            yield from self._complaint(f"{pair.pair_id}: has changed; counts as it was until the end")
        yield from self._taken(waiting)

    def _taken(self, waiting: list[Pair]) -> Iterator[str]:
        """What can be placed goes in, in any order; then what is wrong with the rest."""
        while waiting:
            left, reasons = list[Pair](), list[str]()
            for pair in waiting:
                try:
                    _check_ends(pair)
                    addition = self.session.add([pair])
                except SurveyError as error:
                    left.append(pair)
                    reasons.append(f"{pair.pair_id}: {error}")
                else:
                    self.pairs[pair.pair_id] = pair
                    yield _line(pair, addition)
            if len(left) == len(waiting):
                for reason in reasons:
                    yield from self._complaint(reason)
                return
            waiting = left

    def _complaint(self, text: str) -> Iterator[str]:
        if text not in self.told:
            self.told.add(text)
            yield f"! {text}"

    def _measured(self) -> tuple[Pair, ...]:
        """The pairs of ``new`` as they stand; none while a row is only half written."""
        path = self.new / OBSERVATIONS_FOLDER / "pairs.csv"
        if not path.is_file() or not (text := read_text(path)).endswith("\n"):
            return tuple(self.pairs.values())
        survey = self.definition.survey
        names = Names.of(replace(survey, stations=(*survey.stations, *self._stations())))
        return read_pairs(read_table(path, PAIRS, text), names, self.definition.sigmas)

    def _stations(self) -> tuple[Station, ...]:
        """New ones, of which nothing is known."""
        path = self.new / DEFINITION_FILE
        stations = read_stations(read_toml(path)[0].declared_as("root"), (), False) if path.is_file() else ()
        known = {station.station_id for station in self.definition.survey.stations}
        for station in stations:
            where = f"{path}: stations.{station.station_id}:"
            if station.station_id in known:
                raise SurveyError(f"{where} stands already in {self.definition.folder}; give it a name of its own")
            if station.motion != "fixed" or station.world_from_station.treatment != "free":
                raise SurveyError(f"{where} is not placed by pairs alone, as --live needs it; add it without --live")
        return stations


def _check_ends(pair: Pair) -> None:
    other = next((ref.text for ref in (pair.a, pair.b) if ref.kind != "station" or ref.epoch_id is not None), None)
    if other is not None:
        raise SurveyError(f"{other} is no fixed station, as --live needs it; the pair counts once all is added")


def _same(a: Pair, b: Pair) -> bool:
    is_equal = (a.a, a.b) == (b.a, b.b) and a.cov.shape == b.cov.shape and np.array_equal(a.cov, b.cov)
    return is_equal and np.array_equal(a.b_from_a.matrix(), b.b_from_a.matrix())


def _line(pair: Pair, done: Addition) -> str:
    """Who was placed, whether the pair fits, and how far the others went."""
    parts = [f"{pair.pair_id}: {pair.a.frame_id} - {pair.b.frame_id}", *(f"{s} is placed" for s in done.new)]
    for misfit in done.misfit.values():
        n = len(pair.cov)
        fits = "" if chi2.sf(misfit, n) > _ALPHA else ", DOES NOT FIT"
        parts.append(f"v'Pv {misfit:.1f} of {n}{fits}")
    if done.moved:
        farthest = max(done.moved, key=lambda station: done.moved[station][1])
        mm = 1e3 * done.moved[farthest][1]
        parts.append(f"moved: {len(done.moved)}, {farthest} farthest by {mm:.2g} mm")
    return "; ".join(parts)
