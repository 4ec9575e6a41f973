"""Stations joined by measured relative poses or rotations, as arrays, and what defines the datum."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import IndeterminateError, SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, Datum, FloatArray, IntArray, PoseParameter, Survey
from adjust.observations.pair_arrays import PairArrays
from adjust.pose_network.cycles import connected_parts
from adjust.spatial.rigid import nearest_rotation

_FEW = 8


@frozen(eq=False)
class Topology:
    """Who was measured with whom: pair e joins stations ``a_idx[e]`` and ``b_idx[e]``."""

    station_ids: tuple[str, ...]
    pair_ids: tuple[str, ...]
    a_idx: IntArray
    b_idx: IntArray

    @property
    def n_stations(self) -> int:
        """Number of stations."""
        return len(self.station_ids)

    @property
    def n_pairs(self) -> int:
        """Number of measured pairs."""
        return len(self.pair_ids)


@frozen(eq=False)
class PoseNetwork(Topology):
    """N stations and E measured pairs ``b_from_a``; made by :func:`network_of`, which checks everything.

    arrays: the pairs; those out of use are predicted and tested only. station_rotations (N, 3, 3), station_translations
    (N, 3): ``world_from_station`` of the held ones and of those with a prior, start of the others, nan where nothing is
    known. prior_cov: (6, 6) by station position.
    inner: positions of the stations that carry inner constraints (free network), empty where the datum is given.
    survey: that it is of.
    """

    arrays: PairArrays
    station_rotations: FloatArray
    station_translations: FloatArray
    held: IntArray
    prior_cov: Mapping[int, FloatArray]
    inner: IntArray
    survey: Survey

    @property
    def rotations(self) -> FloatArray:
        """Of the pairs (E, 3, 3)."""
        return self.arrays.rotations

    @property
    def translations(self) -> FloatArray:
        """Of the pairs (E, 3) m, nan where only the rotation was measured."""
        return self.arrays.translations

    @property
    def cov(self) -> FloatArray:
        """Of the pairs (E, 6, 6), as :class:`PairArrays` has them."""
        return self.arrays.cov

    @property
    def used(self) -> BoolArray:
        """Which pairs (E,) are in use."""
        return self.arrays.used

    @property
    def is_pose(self) -> BoolArray:
        """Which pairs (E,) measured a translation too."""
        return self.arrays.is_pose

    @cached_property
    def rotation_only(self) -> bool:
        """Whether positions play no part at all: every unknown is a rotation."""
        return not self.is_pose.any() and not any(np.isfinite(c[3, 3]) for c in self.prior_cov.values())

    @property
    def dim(self) -> int:
        """Unknowns of a station: 6, or 3 in a network of rotations."""
        return 3 if self.rotation_only else 6

    @property
    def sizes(self) -> IntArray:
        """Components (E,) that each pair measured."""
        return np.where(self.is_pose, 6, 3)

    @property
    def whitening(self) -> FloatArray:
        """W (E, dim, dim), upper triangular, with W'W the inverse covariance; zero rows where nothing was measured."""
        return self.arrays.whitening[:, : self.dim, : self.dim]

    @cached_property
    def index_of(self) -> dict[str, int]:
        """Position of every station id."""
        return {s: i for i, s in enumerate(self.station_ids)}

    @cached_property
    def anchor(self) -> int | None:
        """The station that a free network is solved against, None where the datum is given."""
        if len(self.held) or self.prior_cov or not len(self.inner):
            return None
        return int(self.inner[0])

    @cached_property
    def as_survey(self) -> Survey:
        """What is solved, all pairs as they were when it was first asked for."""
        return _as_survey(self)

    @cached_property
    def is_held(self) -> BoolArray:
        """Which stations (N,) are held."""
        out = np.zeros(self.n_stations, dtype=np.bool_)
        out[self.held] = True
        return out

    @cached_property
    def constants(self) -> BoolArray:
        """Stations (N,) that are no unknowns of the solution: the held ones, or the anchor."""
        out = self.is_held.copy()
        if self.anchor is not None:
            out[self.anchor] = True
        return out

    def with_used(self, used: BoolArray) -> "PoseNetwork":
        """The same network with other pairs in use; nothing else is computed again."""
        out = replace(self, arrays=self.arrays.with_used(np.asarray(used, dtype=np.bool_)))
        for name in ("rotation_only", "index_of", "as_survey"):
            if name in self.__dict__:
                out.__dict__[name] = self.__dict__[name]
        return out

    def components(self, used: BoolArray | None = None, poses_only: bool = False) -> IntArray:
        """Connected part (N,) of every station over the pairs in use (those with a translation only, if asked)."""
        rows = self.used if used is None else used
        if poses_only:
            rows = rows & self.is_pose
        return connected_parts(self.n_stations, self.a_idx[rows], self.b_idx[rows])


def network_of(
    who: Topology, measured: PairArrays, held: Mapping[int, FloatArray], start: Mapping[int, FloatArray],
    prior: Mapping[int, tuple[FloatArray, FloatArray]], inner: Sequence[int] | None, survey: Survey,
) -> PoseNetwork:  # fmt: skip
    """A checked network.

    held, start: ``world_from_station`` (4, 4) by station position. prior: the same with covariance (6, 6). inner:
    station positions for inner constraints; a network without held, prior or inner stations takes all of them. Raises
    SurveyError naming the first pair or station that is wrong.
    """
    n = who.n_stations
    R, T = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
    known = {**start, **{k: p for k, (p, _) in prior.items()}, **held}
    if known:
        poses = np.array(list(known.values()), dtype=float)
        R[list(known)], T[list(known)] = nearest_rotation(poses[:, :3, :3]), poses[:, :3, 3]
    if inner is None:
        inner = range(n) if not held and not prior else ()
    network = PoseNetwork(
        who.station_ids, who.pair_ids, who.a_idx, who.b_idx, measured, R, T,
        np.array(sorted(held), dtype=np.int64), {k: np.asarray(c, dtype=float) for k, (_, c) in prior.items()},
        np.array(sorted(inner), dtype=np.int64), survey,
    )  # fmt: skip
    check_network(network)
    return network


def check_network(network: PoseNetwork) -> None:
    """Raise SurveyError for what cannot be, naming the pair or station."""
    n = network.n_stations
    for what, ids in (("station", network.station_ids), ("pair", network.pair_ids)):
        if len(set(ids)) != len(ids):
            twice = next(x for i, x in enumerate(ids) if x in ids[:i])
            raise SurveyError(f"{what} id {twice!r} occurs twice; give every {what} a name of its own")
    a, b = network.a_idx, network.b_idx
    if network.n_pairs == 0:
        raise SurveyError("a network needs at least one measured pair")
    _pairs_where(network, (a < 0) | (a >= n) | (b < 0) | (b >= n), "names a station that does not exist")
    _pairs_where(network, a == b, "joins a station with itself")
    off = np.abs(network.rotations @ np.swapaxes(network.rotations, 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = ~(off < 1e-6) | ~(np.linalg.det(network.rotations) > 0.0)
    _pairs_where(network, bad, "has a matrix that is no rotation; normalize its quaternion")
    _pairs_where(network, network.arrays.doubtful, "has a covariance that is not symmetric and positive definite")
    free = [i for i in network.held.tolist() if not np.isfinite(network.station_translations[i]).all()]
    if free:
        raise SurveyError(f"station {network.station_ids[free[0]]!r} is held but has no pose")


def _pairs_where(network: PoseNetwork, wrong: BoolArray, what: str) -> None:
    found = np.flatnonzero(wrong)
    if len(found):
        more = f" (and {len(found) - 1} others)" if len(found) > 1 else ""
        raise SurveyError(f"pair {network.pair_ids[found[0]]!r}{more} {what}")


def check_determined(network: PoseNetwork) -> None:
    """Raise IndeterminateError naming the stations that the pairs in use leave floating."""
    for poses_only in (False, True):
        if poses_only and (network.rotation_only or network.is_pose.all()):
            continue
        part = network.components(poses_only=poses_only)
        known = set(network.held.tolist()) | ({network.anchor} if network.anchor is not None else set())
        known |= {i for i, c in network.prior_cov.items() if np.isfinite(np.diag(c)[: 6 if poses_only else 3]).all()}
        reached = {int(part[i]) for i in known}
        lost = [i for i in range(network.n_stations) if int(part[i]) not in reached]
        if lost:
            ids = tuple(network.station_ids[i] for i in lost)
            what = "the position of " if poses_only else ""
            raise IndeterminateError(
                f"no measured pair ties {what}{listed(ids, _FEW)} to the datum; measure a pair to the rest, "
                "hold a station of that part, or leave it out", ids,
            )  # fmt: skip


def survey_of(network: PoseNetwork) -> Survey:
    """The stations and pairs of a network as the survey that is solved: its datum, and the pairs in use of now.

    Where nothing but rotations was measured, all stations are held in one place.
    """
    survey = network.as_survey
    pairs, given = list(survey.pairs), np.array([p.used for p in survey.pairs], dtype=np.bool_)
    for e in np.flatnonzero(given != network.used).tolist():
        pairs[e] = replace(pairs[e], used=bool(network.used[e]))
    return replace(survey, pairs=tuple(pairs))


def _as_survey(network: PoseNetwork) -> Survey:
    """All stations and pairs of a network, in the datum that it is solved in."""
    inner = network.anchor is not None
    whole = len(network.inner) == network.n_stations
    datum = Datum("inner", (), () if whole else tuple(network.station_ids[i] for i in network.inner.tolist()))
    known, stations = network.survey, network.survey.stations
    if network.rotation_only:
        stations = tuple(replace(s, world_from_station=_turning_only(s.world_from_station)) for s in stations)
    return replace(known, stations=stations, datum=datum if inner else Datum())


def _turning_only(given: PoseParameter) -> PoseParameter:
    """With its position held, which nothing tells; at the origin, for all turn about it."""
    if given.treatment == "held":
        return given
    turn = Rot3() if given.value is None else given.value.rotation()
    return replace(given, value=Pose3(turn, np.zeros(3)), held=("tx", "ty", "tz"))
