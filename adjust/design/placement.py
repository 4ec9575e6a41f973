"""Where to put beacons for navigation: greedy choice with exchange, for all attitudes the head will take.

At every pose the unknowns are the pose and the errors of the calibration, which are common to all images of an epoch;
a beacon's own error, where it is not exact, is eliminated with its rows. Then the information of beacons adds up, and
the pose covariance after one more follows by Woodbury's formula, for all candidates at once. Beacons that are there
already are lit from the start, with their own errors and what these share with the calibration's.
"""

from collections.abc import Sequence

import numpy as np
import scipy.linalg
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.navigation.model import Beacons, Head
from adjust.navigation.system import System, evaluate, in_view, make_system, visible

_START = np.array([3.0] * 3 + [10.0] * 3)  # rad and m: what an attitude and a place can be off at all
_LEAST_GAIN = 1e-6


@frozen
class PlacementOptions:
    """What a good set of beacons is.

    required_rotation (rad), required_translation (m): the precision of a component that counts as one; ``worst`` or
    ``mean`` of the poses decides. at_least: beacons every pose has to see. exchanges: sweeps in which every chosen
    beacon may be replaced. sigma_px: of a spot. spacing: m, closest two beacons may be.
    """

    criterion: str = "worst"
    required_rotation: float = float(np.radians(0.17))
    required_translation: float = 1e-3
    at_least: int = 3
    exchanges: int = 3
    sigma_px: float = 0.2
    spacing: float = 0.0


@frozen(eq=False)
class Placement:
    """Beacons chosen, in the order of choice, beside those that are there.

    chosen: (k,) of the candidates. measure: (k,) worst or mean pose variance after each, in units of the required one
    (infinite where poses are open). exchanged: replacements made afterwards. final: the measure at the end. per_pose:
    (q,) at the end; seen: (q,) beacons seen from every pose, with those that are there.
    """

    chosen: tuple[int, ...]
    measure: FloatArray
    exchanged: int
    final: float
    per_pose: FloatArray
    seen: tuple[int, ...]


def place_beacons(
    head: Head, poses: Sequence[Pose3], x_in_world: FloatArray, sigma: float, n: int, options: PlacementOptions,
    there: Beacons | None = None,
) -> Placement:  # fmt: skip
    """Choose ``n`` of the candidate places (m, 3) m, each to be surveyed with ``sigma`` (m) per component.

    there: beacons that stay where they are and count as placed. Raises SurveyError where some pose cannot see
    ``at_least`` beacons even with all candidates lit, or ``n`` are too few for that.
    """
    board = _Board(head, poses, x_in_world, sigma, options, there)
    state = _State(board)
    board.check(n)
    measure = []
    for _ in range(min(n, len(x_in_world))):
        best = state.best_addition()
        if best is None:
            break
        state.add(best)
        measure.append(state.value())
    exchanged = state.exchange(options.exchanges)
    short = [k for k, s in enumerate(state.counts) if s < options.at_least]
    if short:
        beside = f" beside {len(board.x_there)} that are there" if len(board.x_there) else ""
        raise SurveyError(
            f"{len(state.chosen)} beacons{beside} are too few: {len(short)} of {len(poses)} poses see fewer than "
            f"{options.at_least} (pose {short[0] + 1} sees {state.counts[short[0]]}); allow more beacons or fewer poses"
        )
    seen = tuple(state.counts.tolist())
    return Placement(tuple(state.chosen), np.array(measure), exchanged, state.value(), state.per_pose(), seen)


class _Board:
    """The rows of every candidate at every pose, whitened, over the pose and the calibration's errors.

    Q_there: (q, 6 + r, 6 + r) covariance of these with the beacons that are there; seen_there: (q,) how many are seen.
    """

    def __init__(
        self, head: Head, poses: Sequence[Pose3], x: FloatArray, sigma: float, options: PlacementOptions,
        there: Beacons | None,
    ) -> None:  # fmt: skip
        m = len(x)
        ids = tuple(f"c{i}" for i in range(m))
        self.options, self.m, self.x = options, m, x
        system = make_system(head, Beacons(ids, x, np.zeros((3 * m, 3 * m))))
        self.r = system.F.shape[1]
        self.dim = 6 + self.r
        self.seen = np.array([visible(system, p.matrix()).any(axis=0) for p in poses])
        most = max(int(visible(system, p.matrix()).sum(axis=0).max(initial=0)) for p in poses)
        self.rows = np.zeros((len(poses), m, 2 * max(most, 1), self.dim))
        for k, pose in enumerate(poses):
            self._fill(k, system, pose.matrix(), sigma)
        self._light(system, poses, there)
        weight = np.array([options.required_rotation] * 3 + [options.required_translation] * 3)
        self.weight = 1.0 / (6.0 * weight**2)

    def _light(self, system: System, poses: Sequence[Pose3], there: Beacons | None) -> None:
        """What the beacons that are there do at every pose; their errors are not asked for any more then."""
        self.Q_there = np.tile(np.diag(np.concatenate([_START**2, np.ones(self.r)])), (len(poses), 1, 1))
        self.seen_there: IntArray = np.zeros(len(poses), dtype=np.int64)
        self.x_there = np.zeros((0, 3))
        if there is None:
            return
        self.x_there, old = np.asarray(there.x_in_world), make_system(system.head, there)
        p, start = len(system.head.cov), np.concatenate([_START**2, np.ones(old.F.shape[1])])
        kept = scipy.linalg.block_diag(np.eye(6), system.F_inverse[:, :p] @ old.F[:p])
        for k, pose in enumerate(poses):
            camera, beacon = in_view(old, pose.matrix())
            J = np.hstack(evaluate(old, pose.matrix(), camera, beacon)[1:])
            QJ = start[:, None] * J.T
            S = self.options.sigma_px**2 * np.eye(len(J)) + J @ QJ
            self.Q_there[k] = kept @ (np.diag(start) - QJ @ np.linalg.solve(S, QJ.T)) @ kept.T
            self.seen_there[k] = len(np.unique(beacon))

    def _fill(self, k: int, system: System, pose: FloatArray, sigma: float) -> None:
        camera, beacon = in_view(system, pose)
        if not len(camera):
            return
        _, H, M = evaluate(system, pose, camera, beacon)
        J = np.hstack([H, M]).reshape(len(camera), 2, self.dim)
        # px/m by the beacon: moving the head by d in its own frame is moving the beacon by -R d
        by_point = -J[:, :, 3:6] @ pose[:3, :3].T
        for b in np.unique(beacon).tolist():
            mine = np.flatnonzero(beacon == b)
            own = np.concatenate(by_point[mine])
            noise = self.options.sigma_px**2 * np.eye(len(own)) + sigma**2 * own @ own.T
            rows = np.linalg.solve(np.linalg.cholesky(noise), np.concatenate(J[mine]))
            self.rows[k, b, : len(rows)] = rows

    def check(self, n: int) -> None:
        """Raise where a pose cannot be served."""
        counts = self.seen.sum(axis=1) + self.seen_there
        poor = np.flatnonzero(counts < self.options.at_least)
        if len(poor):
            raise SurveyError(
                f"pose {int(poor[0]) + 1} sees {int(counts[poor[0]])} of all {self.m} places for beacons"
                f"{f' and {len(self.x_there)} beacons that are there' if len(self.x_there) else ''}, but "
                f"{self.options.at_least} are needed ({len(poor)} such poses); offer more places, or turn the head less"
            )
        if n + len(self.x_there) < self.options.at_least:
            raise SurveyError(f"{n} beacons in all; every pose has to see {self.options.at_least}: allow more")


class _State:
    """The poses' covariances with what has been chosen."""

    def __init__(self, board: _Board) -> None:
        self.board = board
        self.set([])

    def set(self, chosen: Sequence[int]) -> None:
        """Light these beacons alone; the covariances are built anew, which loses no digits."""
        self.Q = self.board.Q_there
        self.counts: IntArray = self.board.seen_there
        self.chosen: list[int] = []
        for i in chosen:
            self.add(i)

    def add(self, i: int) -> None:
        """Light a beacon."""
        J = self.board.rows[:, i]
        QJ = self.Q @ J.transpose(0, 2, 1)
        self.Q = self.Q - QJ @ np.linalg.solve(np.eye(J.shape[1]) + J @ QJ, QJ.transpose(0, 2, 1))
        self.counts = self.counts + self.board.seen[:, i]
        self.chosen.append(i)

    def per_pose(self) -> FloatArray:
        """(q,) mean variance of a pose's components in units of the required ones."""
        return np.asarray(np.diagonal(self.Q, axis1=1, axis2=2)[:, :6] @ self.board.weight)

    def value(self) -> float:
        """The measure of the set."""
        return self._measure(self.per_pose())

    def _measure(self, per_pose: FloatArray) -> float:
        return float(per_pose.max() if self.board.options.criterion == "worst" else per_pose.mean())

    def _score(self, per_pose: FloatArray, counts: IntArray) -> FloatArray:
        """Smaller is better, along the last axis: first what is missing to see enough, then the logarithmic mean.

        Early on the worst pose is open whatever is added, which makes the plain measure blind; the mean logarithm of
        the variances goes down with every beacon that helps some pose, and the measure itself decides once all is seen.
        """
        options = self.board.options
        missing = np.maximum(options.at_least - counts, 0).sum(axis=-1)
        fine = per_pose.max(axis=-1) if options.criterion == "worst" else per_pose.mean(axis=-1)
        return np.asarray(1e6 * missing + np.where(missing > 0, np.log(per_pose).mean(axis=-1), np.log(fine)))

    def candidates(self) -> BoolArray:
        """(m,) which places are free, far enough from what is chosen."""
        free = np.ones(self.board.m, dtype=np.bool_)
        for x in (*self.board.x_there, *self.board.x[self.chosen]):
            free &= np.linalg.norm(self.board.x - x, axis=1) > self.board.options.spacing
        free[self.chosen] = False
        return free

    def scores(self) -> FloatArray:
        """(m,) score of the set with each candidate added."""
        J = self.board.rows
        variance = np.diagonal(self.Q, axis1=1, axis2=2)[:, :6]
        per_pose = np.empty((len(J), self.board.m))
        for k in range(len(J)):
            QJ = J[k] @ self.Q[k]  # (m, rows, dim): Q is symmetric
            S = np.eye(J.shape[2]) + np.einsum("mrd,msd->mrs", QJ, J[k])
            less = np.einsum("mrd,mrd->md", QJ[..., :6], np.linalg.solve(S, QJ[..., :6]))
            per_pose[k] = np.maximum(variance[k] - less, 1e-30) @ self.board.weight
        counts = self.counts[:, None] + self.board.seen
        return self._score(per_pose.T, counts.T)

    def score(self) -> float:
        """Of the set as it is."""
        return float(self._score(self.per_pose(), self.counts))

    def best_addition(self) -> int | None:
        """The candidate to add next; None where none is left."""
        free = self.candidates()
        if not free.any():
            return None
        return int(np.argmin(np.where(free, self.scores(), np.inf)))

    def exchange(self, sweeps: int) -> int:
        """Replace chosen beacons one by one where that is better (Fedorov 1972); how many were."""
        done = 0
        for _ in range(sweeps):
            before = done
            for i in list(self.chosen):
                old = self.score()
                order = list(self.chosen)
                self.set([c for c in order if c != i])
                best = self.best_addition()
                new = i if best is None else best
                self.add(new)
                if new == i or self.score() > old - _LEAST_GAIN:
                    self.set(order)
                else:
                    done += 1
            if done == before:
                break
        return done
