"""Approximate horizontal coordinates, as complex numbers, from directions and distances alone.

Systems of coordinates grow point by point: polar points, intersections, resections and arcs, from what they know.
Where the known system cannot grow, the sets of single stations are joined through two common points into systems of
their own, and these moved into the known one: so traverses without any orientation close.
"""

import cmath
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from adjust.model.names import grouped
from adjust.spatial.averaging import circular_median
from adjust.start.readings.places import positions
from adjust.start.readings.sights import Node, Sights, best_of_places

_SURE = 0.15
"""Sine of the angle between two rays below which they do not intersect well."""


@dataclass(eq=False)
class System:
    """Coordinates and, per set of directions, the turn to be added. absolute: in the world, so that azimuths hold."""

    xy: dict[Node, complex]
    turn: dict[str, float] = field(default_factory=dict)
    absolute: bool = False

    def copy(self) -> "System":
        """An independent copy."""
        return replace(self, xy=dict(self.xy), turn=dict(self.turn))


@dataclass(eq=False)
class PlaneStart:
    """Searches plane coordinates; distance: horizontal ones of ordered pairs of nodes."""

    sights: Sights
    distance: Mapping[tuple[Node, Node], float]

    def __post_init__(self) -> None:
        self.around: dict[Node, dict[Node, None]] = {}  # in the order of the distances, as all that follows
        for a, b in self.distance:
            self.around.setdefault(a, {})[b] = None
        sets = self.sights.directions
        self.sets_at = grouped((a, name) for name, (a, _) in sets.items())
        self.sets_to = grouped((b, name) for name, (_, targets) in sets.items() for b in targets)
        read = [(a, b, value) for (a, b), values in self.sights.azimuths.items() for value in values]
        self.azimuths_to = grouped(way for a, b, z in read for way in ((b, (a, z)), (a, (b, z + np.pi))))
        self.nodes = sorted({*self.sets_at, *self.sets_to, *self.around, *self.azimuths_to})

    def find(self, known: Mapping[Node, complex]) -> System:
        """The system of ``known`` points, or one of its own where nothing is known, with all points that it reaches."""
        main = System(dict(known), absolute=bool(known))
        pieces = self._stations()
        if not known:
            main = max(pieces, key=lambda p: len(p.xy), default=self._seed())
            if len(main.xy) < 2:
                main = self._seed()
            main.absolute = True  # nothing else says where north is: azimuths turn it in the end
            self._turn_by_azimuth(main)
        while True:
            self.grow(main)
            if self._absorb(main, pieces) or self._pieces(pieces, main) or self._guess(main):
                continue
            return main

    # -- systems -----------------------------------------------------------------------------------------------------

    def _stations(self) -> list[System]:
        """One system per set of directions, of its station and the targets whose distance is known."""
        out = []
        for name, (a, targets) in self.sights.directions.items():
            xy = {a: 0j}
            for b, angle in targets.items():
                if (a, b) in self.distance:
                    xy[b] = cmath.rect(self.distance[a, b], angle)
            if len(xy) > 1:
                out.append(System(xy, {name: 0.0}))
        return out

    def _seed(self) -> System:
        pairs = sorted(self.distance.items(), key=lambda item: (-len(self.around[item[0][0]]), item[0]))
        if pairs:
            (a, b), d = pairs[0]
            return System({a: 0j, b: complex(d, 0.0)})
        name = max(self.sights.directions, key=lambda s: len(self.sights.directions[s][1]), default=None)
        if name is None:
            return System({})
        a, targets = self.sights.directions[name]
        b = next(iter(targets))
        return System({a: 0j, b: cmath.rect(1.0, targets[b])}, {name: 0.0})

    def _turn_by_azimuth(self, system: System) -> None:
        for (a, b), values in self.sights.azimuths.items():
            if a in system.xy and b in system.xy and system.xy[a] != system.xy[b]:
                turn = circular_median(np.array(values)) - cmath.phase(system.xy[b] - system.xy[a])
                move(system, cmath.rect(1.0, turn), 0j)
                return

    def _absorb(self, main: System, pieces: list[System]) -> bool:
        """Move into ``main`` every piece that shares two points with it."""
        grew = False
        for piece in list(pieces):
            common = [n for n in piece.xy if n in main.xy]
            if len(common) == len(piece.xy):
                pieces.remove(piece)
            elif len(common) >= 2 and (motion := fit(piece.xy, main.xy, common)) is not None:
                move(piece, *motion)
                for n, z in piece.xy.items():
                    main.xy.setdefault(n, z)
                for name, turn in piece.turn.items():
                    main.turn.setdefault(name, turn)
                pieces.remove(piece)
                grew = True
        return grew

    def _pieces(self, pieces: list[System], main: System) -> bool:
        """Let the other systems grow and join each other; whether any did."""
        for piece in sorted(pieces, key=lambda p: -len(p.xy)):
            before = len(piece.xy)
            self.grow(piece)
            others = [p for p in pieces if p is not piece]
            joined = self._absorb(piece, others)
            if joined or len(piece.xy) > before:
                pieces[:] = [piece, *others]
                return True
        return False

    # -- growing -----------------------------------------------------------------------------------------------------

    def grow(self, system: System) -> None:
        """Add every point that is determined well by what the system knows."""
        waiting = [n for n in self.nodes if n not in system.xy]
        stuck = False
        while waiting and not stuck:
            self._orient(system)
            stuck = True
            for step in (self._polar, self._intersection, self._solved):
                found = {n: z for n in waiting if (z := step(system, n)) is not None}
                if found:
                    system.xy.update(found)
                    waiting = [n for n in waiting if n not in found]
                    stuck = False
                    break
        self._orient(system)

    def _orient(self, system: System) -> None:
        for name, (a, targets) in self.sights.directions.items():
            if name in system.turn or a not in system.xy:
                continue
            turns = [cmath.phase(system.xy[b] - system.xy[a]) - angle for b, angle in targets.items()
                     if b in system.xy and system.xy[b] != system.xy[a]]  # fmt: skip
            if turns:
                system.turn[name] = circular_median(np.array(turns))

    def _rays(self, system: System, node: Node) -> list[tuple[Node, complex, float]]:
        """Points with their places, and directions (rad), of the rays that reach a node."""
        out = []
        for name in self.sets_to.get(node, ()):
            a, targets = self.sights.directions[name]
            if name in system.turn and a in system.xy:
                out.append((a, system.xy[a], targets[node] + system.turn[name]))
        if system.absolute:
            out += [(a, system.xy[a], angle) for a, angle in self.azimuths_to.get(node, ()) if a in system.xy]
        return out

    def _polar(self, system: System, node: Node) -> complex | None:
        far = self.distance
        found = [z + cmath.rect(far[a, node], angle) for a, z, angle in self._rays(system, node) if (a, node) in far]
        return middle(found) if found else None

    def _intersection(self, system: System, node: Node) -> complex | None:
        rays = self._rays(system, node)
        found = []
        for i, (_, p, alpha) in enumerate(rays):
            for _, q, beta in rays[:i]:
                sine = np.sin(beta - alpha)
                if abs(sine) > _SURE:
                    s = ((q - p) * cmath.rect(1.0, -beta)).imag / -np.sin(beta - alpha)
                    t = ((p - q) * cmath.rect(1.0, -alpha)).imag / -np.sin(alpha - beta)
                    if s > 0.0 and t > 0.0:
                        found.append(p + cmath.rect(s, alpha))
        return middle(found) if found else None

    def _solved(self, system: System, node: Node) -> complex | None:
        found = self.candidates(system, node)
        return found[0] if len(found) == 1 else None

    def candidates(self, system: System, node: Node) -> list[complex]:
        """Where a point can be: resection, arcs and their mixtures, by least squares from many sides."""
        rays = [(z, angle) for _, z, angle in self._rays(system, node)]
        circles = [(system.xy[b], self.distance[node, b]) for b in self.around.get(node, ()) if b in system.xy]
        sets = []
        for name in self.sets_at.get(node, ()):
            _, targets = self.sights.directions[name]
            seen = [(system.xy[b], angle) for b, angle in targets.items() if b in system.xy]
            if len(seen) > 1:
                sets.append(seen)
        if len(rays) + len(circles) + sum(len(s) - 1 for s in sets) < 2:
            return []
        return positions(rays, circles, sets)

    def _guess(self, main: System) -> bool:
        """Take the better of two places where nothing is certain: the one from which the rest fits."""

        def grown(node: Node, z: complex) -> System:
            trial = main.copy()
            trial.xy[node] = z
            self.grow(trial)
            return trial

        best = best_of_places(set(self.nodes) - set(main.xy), lambda node: self.candidates(main, node), grown,
                              lambda trial: (-len(trial.xy), self.misfit(trial)))  # fmt: skip
        if best is not None:
            main.xy, main.turn = best.xy, best.turn
        return best is not None

    def misfit(self, system: System) -> float:
        """Robust sum of what distances (m) and directions (m across) miss."""
        total = 0.0
        for (a, b), d in self.distance.items():
            if a < b and a in system.xy and b in system.xy:
                total += min(abs(abs(system.xy[b] - system.xy[a]) - d), 0.1 * d)
        for name, (a, targets) in self.sights.directions.items():
            for b, angle in targets.items():
                if name in system.turn and a in system.xy and b in system.xy:
                    off = (system.xy[b] - system.xy[a]) * cmath.rect(1.0, -system.turn[name] - angle)
                    total += min(abs(off) * abs(cmath.phase(off)), 0.1 * abs(off))
        return total


def fit(
    source: Mapping[Node, complex], goal: Mapping[Node, complex], common: Iterable[Node]
) -> tuple[complex, complex] | None:
    """Turn (unit) and shift that move ``source`` onto ``goal``; None where the common points are too near together."""
    names = list(common)
    p, q = np.array([source[n] for n in names]), np.array([goal[n] for n in names])
    a, b = p - p.mean(), q - q.mean()
    size = np.abs(np.array(list(source.values())) - p.mean()).max()
    if np.abs(a).max() < 0.02 * size or np.abs(b).max() < 1e-9:
        return None
    turn = complex(np.vdot(a, b))
    turn /= abs(turn)
    return turn, complex(q.mean() - turn * p.mean())


def move(system: System, turn: complex, shift: complex) -> None:
    """Turn and shift a system."""
    for n in system.xy:
        system.xy[n] = turn * system.xy[n] + shift
    for name in system.turn:
        system.turn[name] += cmath.phase(turn)


def middle(points: list[complex]) -> complex:
    """The point nearest to all others."""
    if len(points) < 3:
        return points[0]
    z = np.array(points)
    return points[int(np.argmin(np.abs(z[:, None] - z).sum(axis=1)))]
