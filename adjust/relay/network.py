"""A network of stations and the pairs measured between them, as arrays.

A station is here any frame that carries an eye: a camera, a marker block, a whole relay station. A measured pair is
``b_from_a``; its covariance is in the tangent on the right, that is in frame a.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import chain

import gtsam
import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import Pair, frame_text
from adjust.model.survey import FloatArray
from adjust.observations.factors import gaussian
from adjust.observations.pair_arrays import checked_arrays
from adjust.pose_network.network import Topology
from adjust.spatial.rigid_motions import Motions


@frozen(eq=False)
class MeasuredPairs:
    """Measured pairs ``b_from_a`` with covariances ``cov`` (E, dim, dim); all rotations, or all rigid motions."""

    topology: Topology
    b_from_a: Motions
    cov: FloatArray

    @property
    def dim(self) -> int:
        """3 for rotations, 6 for poses."""
        return self.b_from_a.dim


def topology(pairs: Iterable[tuple[str, str, str]], stations: Sequence[str] = ()) -> Topology:
    """From (pair id, a id, b id); ``stations`` names those that stand first, measured or not.

    Raises SurveyError for an id that comes twice and for a pair of a station with itself.
    """
    rows = list(pairs)
    pair_ids, *ends = zip(*rows, strict=True) if rows else ((), (), ())
    for what, ids in (("pair", pair_ids), ("station", tuple(stations))):
        if len(set(ids)) < len(ids):
            twice = next(i for i, n in Counter(ids).items() if n > 1)
            raise SurveyError(f"{what} {twice!r} is there twice; give every {what} an id of its own")
    station_ids = tuple(dict.fromkeys(chain(stations, chain.from_iterable(zip(*ends, strict=True)))))
    index = {station: i for i, station in enumerate(station_ids)}
    a, b = (np.array([index[end] for end in of], dtype=np.int64) for of in ends)
    alone = np.flatnonzero(a == b)
    if len(alone):
        raise SurveyError(f"pair {pair_ids[alone[0]]!r} joins {ends[0][alone[0]]!r} with itself; correct a or b")
    return Topology(station_ids, pair_ids, a, b)


def network_from_pairs(pairs: Sequence[Pair], rotations_only: bool = False) -> MeasuredPairs:
    """The network of the pairs in use; its stations are named as ``kind:id@epoch``.

    rotations_only: take of poses their rotation alone, as where some pairs have no translation.
    Raises SurveyError for mixed kinds, and for covariances of a wrong shape or not positive definite.
    """
    used = [p for p in pairs if p.used]
    if not used:
        raise SurveyError("no measured pair is in use; a relay network needs pairs")
    rotations = [p for p in used if isinstance(p.b_from_a, Rot3)]
    if rotations and len(rotations) < len(used) and not rotations_only:
        raise SurveyError(
            f"pair {rotations[0].pair_id!r} is a rotation while others are poses; adjust the rotations alone, or "
            "measure its translation"
        )
    dim = 3 if rotations or rotations_only else 6
    top, found = topology((p.pair_id, frame_text(p.a), frame_text(p.b)) for p in used), checked_arrays(used)
    # of a pose the rotation comes first in the tangent, and its share of the covariance stands by itself
    cov = found.cov[:, :dim, :dim]
    return MeasuredPairs(top, found.motions.in_dim(dim), 0.5 * (cov + np.swapaxes(cov, 1, 2)))


def gtsam_motion(motions: Motions, idx: int) -> Rot3 | Pose3:
    """One motion as GTSAM's type."""
    rotation = Rot3(motions.rotation[idx])
    return rotation if motions.translation is None else Pose3(rotation, motions.translation[idx])


def station_values(motions: Motions) -> gtsam.Values:
    """Values with one rotation or pose per station, under the station's number as key."""
    values = gtsam.Values()
    for i in range(len(motions)):
        values.insert(i, gtsam_motion(motions, i))
    return values


def prior_factor(key: int, motion: Rot3 | Pose3, cov: FloatArray) -> gtsam.NonlinearFactor:
    """A rotation or pose known with covariance in its tangent."""
    if isinstance(motion, Rot3):
        return gtsam.PriorFactorRot3(key, motion, gaussian(cov))
    return gtsam.PriorFactorPose3(key, motion, gaussian(cov))
