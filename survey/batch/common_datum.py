"""Epochs with a free datum each, brought to a common one: else their coordinates differ by the motion of the whole.

The inner constraints of an epoch hold about its own start values, and these are not the same in two epochs. Each is
moved, along the motions that its observations leave open, onto the median of all by least squares over the points and
stations that carry its datum. That is the S-transformation (Baarda 1973) to the inner datum about those coordinates:
covariances, already those of an inner datum over the same names, only turn and grow along.

What has moved in an epoch must not carry its datum, or the others seem to move too: while a carrier fails its test, the
worst is taken out (Niemeier 2008, 13). The motion of the whole then gains ``(G_s' G_s)^-1 G_m' d_m`` of those that are
out; epochs come without covariances between their points, so the sigma of this is added to that of a coordinate, which
is more than both have together. Epochs whose datum is carried by other names, or leaves other motions open, are not
comparable; they are left out by name.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gtsam import Pose3, Rot3

from adjust.epochs.states import differences_of, laid_onto, origin
from adjust.model.errors import listed
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.spatial.motions import values_motions
from adjust.spatial.rotation_forms import quaternion_wxyz
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2
from survey.solution.covariances import read_estimates
from survey.solution.quantities import ARCSEC_PER_RAD, sigmas_in

_Kind = tuple[tuple[bool, ...], frozenset[str]]
"""The motions that a free datum leaves open, and what carries it."""
_PLACED = ("point", "world_from_station", "world_from_table", "carrier_from_target")
_TURNED = 1e-6
_SCALE = 6
_LEVEL = 0.01
_DETERMINED = 1e-9


@frozen
class Place:
    """A point or pose in the world: x_mm, quaternion w x y z (of a pose), covariance row by row in its tangent, SI."""

    name: str
    x_mm: tuple[float, ...]
    wxyz: tuple[float, ...] | None
    cov: tuple[float, ...]

    @property
    def value(self) -> Pose3 | FloatArray:
        """As the mathematics takes it."""
        x = 1e-3 * np.array(self.x_mm)
        return x if self.wxyz is None else Pose3(Rot3.Quaternion(*self.wxyz), x)


@frozen
class FreeDatum:
    """Of an epoch: open_motions (k, 7) t, rotation vector, ln scale; names that carry it; everything in the world."""

    open_motions: tuple[tuple[float, ...], ...]
    carried_by: tuple[str, ...]
    places: tuple[Place, ...]


@frozen
class Moved:
    """A place in the common datum: x_mm and sigmas_mm (3,), and of a pose its quaternion and sigmas (arcsec)."""

    x_mm: tuple[float, ...]
    sigmas_mm: tuple[float, ...]
    wxyz: tuple[float, ...] | None
    sigmas_arcsec: tuple[float, ...] | None


def free_datum(solution: Mapping[str, Any], covariances: Path) -> FreeDatum | None:
    """Of a solution, as ``solution.json`` and ``covariance.npz`` hold it; None where its datum is given.

    Raises OSError or ValueError for what is no ``covariance.npz``.
    """
    datum = solution.get("free_datum")
    if datum is None:
        return None
    factor, places = float(solution["summary"]["sigma_factor"]), []
    for (kind, *ids), e in read_estimates(covariances).items():
        world = "world_from_target" if kind == "carrier_from_target" else kind
        on_station = kind == "carrier_from_target" and "station" in solution["targets"][ids[0]]
        if kind in _PLACED and len(ids) == 1 and not on_station:
            wxyz = quaternion_wxyz(e.value.rotation()) if isinstance(e.value, Pose3) else None
            cov = tuple((factor**2 * e.cov).ravel().tolist())
            places.append(Place(f"{world}/{ids[0]}", tuple((1e3 * origin(e.value)).tolist()), wxyz, cov))
    motions = tuple(tuple(float(x) for x in row) for row in datum["open_motions"])
    return FreeDatum(motions, tuple(datum["carried_by"]), tuple(places))


def incomparable(data: Sequence[FreeDatum | None]) -> dict[int, str]:
    """Epochs whose world is in no common datum with that of the others, and why; None stands for a given datum."""
    kinds: dict[_Kind | None, list[int]] = {}
    for i, datum in enumerate(data):
        kinds.setdefault(None if datum is None else (_span(datum), frozenset(datum.carried_by)), []).append(i)
    if len(kinds) < 2:
        return {}
    most = max(kinds, key=lambda kind: (len(kinds[kind]), -kinds[kind][0]))
    out: dict[int, str] = {}
    for kind, epochs in kinds.items():
        if kind != most:
            out |= dict.fromkeys(epochs, _why(kind, most))
    return out


def _why(kind: _Kind | None, most: _Kind | None) -> str:
    if kind is None or most is None:
        return "its datum is given" if kind is None else "its datum is free"
    if kind[0] != most[0]:
        return "its observations leave other motions open"
    lost, more = sorted(most[1] - kind[1]), sorted(kind[1] - most[1])
    said = [f"without {listed(lost, 3)}"] if lost else []
    said += [f"with {listed(more, 3)}"] if more else []
    return "its datum is carried by other points or stations, " + " and ".join(said)


def _span(datum: FreeDatum) -> tuple[bool, ...]:
    """Which of the seven motions are open."""
    size = np.abs(np.array(datum.open_motions).reshape(-1, 7)).max(axis=0, initial=0.0)
    return tuple((size > _TURNED * size.max(initial=0.0)).tolist())


def scale_is_open(datum: FreeDatum) -> bool:
    """Whether lengths themselves are not determined."""
    return _span(datum)[_SCALE]


def in_common_datum(data: Sequence[FreeDatum]) -> list[dict[str, Moved]]:
    """The world of all epochs in one datum; their datums have the same carriers and open motions."""
    first = data[0]
    target = {p.name: p.value for p in first.places}
    carriers = [n for n in first.carried_by if all(n in {p.name for p in d.places} for d in data)]
    epochs = [_Epoch(d, np.array(first.open_motions).reshape(-1, 7).T) for d in data]
    for epoch in epochs:
        epoch.align(target, carriers)
    middle = {n: _median(target[n], [e.values[n] for e in epochs]) for n in carriers}
    level = sidak(_LEVEL, len(carriers) * len(epochs))
    return [epoch.moved(middle, carriers, level, 1.0 + 0.5 * np.pi / len(epochs)) for epoch in epochs]


def _median(about: Pose3 | FloatArray, values: Sequence[Pose3 | FloatArray]) -> Pose3 | FloatArray:
    """Component by component, of poses in the tangent of the first."""
    d = np.median([differences_of(about, v) for v in values], axis=0)
    return about.retract(d) if isinstance(about, Pose3) else about + d


class _Epoch:
    """An epoch on its way: values by name, and what they were mapped by. directions: (7, k)."""

    def __init__(self, datum: FreeDatum, directions: FloatArray) -> None:
        self.datum, self.directions = datum, directions
        self.values = {p.name: p.value for p in datum.places}
        self.places = {p.name: p for p in datum.places}
        self.L, self.scale = np.eye(3), 1.0

    def align(self, target: Mapping[str, Pose3 | FloatArray], stable: Sequence[str]) -> None:
        """Move onto the target by least squares over the stable ones."""
        names, values, held_to = list(self.values), tuple(self.values.values()), frozenset(stable)
        kept = np.repeat([n in held_to for n in names], [6 if isinstance(v, Pose3) else 3 for v in values])
        there = [target.get(n, v) for n, v in self.values.items()]
        values, L, scale = laid_onto(there, values, self.directions, kept)
        self.values, self.L, self.scale = dict(zip(names, values, strict=True)), L @ self.L, scale * self.scale

    def _motions(self, target: Mapping[str, Pose3 | FloatArray], names: Sequence[str]) -> FloatArray:
        return values_motions([target[n] for n in names]) @ self.directions

    def moved(
        self, target: Mapping[str, Pose3 | FloatArray], carriers: Sequence[str], level: float, spread: float
    ) -> dict[str, Moved]:
        """In the datum of the carriers that stayed. spread: variance of a difference over that of the epoch."""
        stable, limit = list(carriers), {size: float(chi2.isf(level, size)) for size in (3, 6)}
        self.align(target, stable)
        while 2 * (len(stable) - 1) >= len(carriers):
            tests = {n: self._test(target, n) / spread for n in stable}
            limits = {n: limit[self._size(n)] for n in stable}
            worst = max(tests, key=lambda n: tests[n] / limits[n])
            rest = [n for n in stable if n != worst]
            short = np.linalg.matrix_rank(self._motions(target, rest)) < self.directions.shape[1]
            if tests[worst] <= limits[worst] or short:
                break
            stable = rest
            self.align(target, stable)
        out = [n for n in carriers if n not in stable]
        return {n: self._place(n, self._gained(target, stable, out, n)) for n in self.places}

    def cov(self, name: str) -> FloatArray:
        """Covariance as it turned and grew along, in the tangent of a pose."""
        n = self._size(name)
        J = self.L if n == 3 else np.diag([1.0] * 3 + [self.scale] * 3)
        return np.asarray(J @ np.array(self.places[name].cov).reshape(n, n) @ J.T)

    def _size(self, name: str) -> int:
        return 3 if self.places[name].wxyz is None else 6

    def _test(self, target: Mapping[str, Pose3 | FloatArray], name: str) -> float:
        d, C = differences_of(target[name], self.values[name]), self.cov(name)
        sigma = np.sqrt(np.diag(C))
        seen = np.isfinite(d) & (sigma > 0.0)
        rho = C[np.ix_(seen, seen)] / np.outer(sigma[seen], sigma[seen])
        z = d[seen] / sigma[seen]
        return float(z @ np.linalg.pinv(rho, rcond=_DETERMINED, hermitian=True) @ z)

    def _gained(
        self, target: Mapping[str, Pose3 | FloatArray], stable: Sequence[str], out: Sequence[str], name: str
    ) -> FloatArray:
        """Sigmas (3 or 6,) of what the motion of the whole gained, in the tangent of a pose."""
        total = np.zeros(self._size(name))
        if not out:
            return total
        G = self._motions(target, stable)
        own = values_motions((self.values[name],)) @ self.directions @ np.linalg.inv(G.T @ G)
        for m in out:
            B = own @ self._motions(target, [m]).T
            total += sigmas_in(B @ self.cov(m) @ B.T)
        return total

    def _place(self, name: str, gained: FloatArray) -> Moved:
        value, cov = self.values[name], self.cov(name)
        axes = value.rotation().matrix() if isinstance(value, Pose3) else np.eye(3)
        own = sigmas_in(axes @ cov[-3:, -3:] @ axes.T) + np.abs(axes) @ gained[-3:]
        x, sigmas = tuple((1e3 * origin(value)).tolist()), tuple((1e3 * own).tolist())
        if not isinstance(value, Pose3):
            return Moved(x, sigmas, None, None)
        turned = ARCSEC_PER_RAD * (sigmas_in(cov)[:3] + gained[:3])
        return Moved(x, sigmas, quaternion_wxyz(value.rotation()), tuple(turned.tolist()))
