"""The ways in which a measured pose or rotation is misread, each with the words for it and what was meant."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.diagnosis.hypothesis import ChangeColumns, Edit, ExchangeColumns
from adjust.diagnosis.units.conventions import ANGLE_RATIOS, LENGTH_RATIOS, UNKNOWN, Written
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import Pair
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.spatial.rotation_forms import euler_from_matrix, matrix_from_euler, quaternion_wxyz

Motion = Pose3 | Rot3
_QUATERNION, _SHIFT = ("qw", "qx", "qy", "qz"), ("tx_mm", "ty_mm", "tz_mm")
_EULER = ("euler_x_deg", "euler_y_deg", "euler_z_deg")


@frozen
class Convention:
    """name: of the kind of mistake. said: what is wrong. remedy: in pairs.csv. mend: the motion as it was meant.

    columns: the numbers of pairs.csv that change, and by which matrix, where that mends it. shifts: what the lengths of
    shifts are multiplied by. angles: what Euler angles are, as they stand there; 0 where nothing is done to them.
    by_hand: whether it may happen to any of the pairs, as they are typed row by row.
    """

    name: str
    said: str
    remedy: str
    mend: Callable[[Motion], Motion | None]
    columns: tuple[tuple[str, ...], FloatArray] | None = None
    shifts: float = 1.0
    angles: float = 0.0
    by_hand: bool = False

    def meant(self, pair: Pair, written: Written) -> Motion | None:
        """The motion of a pair as it was meant; None where it cannot have been misread so."""
        if not self.angles:
            return self.mend(pair.b_from_a)
        read = written.euler.get(pair.pair_id)
        if read is None:
            return None
        R = Rot3.RzRyRx(*(self.angles * read).tolist())
        return Pose3(R, pair.b_from_a.translation()) if isinstance(pair.b_from_a, Pose3) else R


def rotation_of(m: Motion) -> FloatArray:
    """(3, 3)."""
    return np.asarray((m.rotation() if isinstance(m, Pose3) else m).matrix())


def _numbers(
    name: str, said: str, remedy: str, columns: tuple[str, ...], matrix: FloatArray, shifts: float = 1.0
) -> Convention:
    """Other numbers in these columns: ``matrix`` times those that stand there."""
    at = [(_QUATERNION + _SHIFT).index(c) for c in columns]

    def mend(m: Motion) -> Motion | None:
        R, t = (m.rotation(), m.translation()) if isinstance(m, Pose3) else (m, None)
        if t is None and min(at) >= len(_QUATERNION):
            return None
        numbers = np.append(quaternion_wxyz(R), np.zeros(3) if t is None else t)
        numbers[at] = matrix @ numbers[at]
        R = Rot3.Quaternion(*numbers[:4])
        return R if t is None else Pose3(R, numbers[4:])

    return Convention(name, said, remedy, mend, (columns, matrix), shifts)


def _of_shifts(said: str, columns: tuple[str, ...] = _SHIFT) -> Convention:
    factor = LENGTH_RATIOS[f"are {said}"]
    if columns is _SHIFT:
        told = f"have shifts in {said}", f"multiply tx, ty, tz by {factor:g}"
    else:
        told = f"have {columns[0]} in {said}", f"multiply {columns[0]} by {factor:g}"
    return _numbers("unit of shifts", *told, columns, factor * np.eye(len(columns)), factor)


def _of_angles(said: str) -> Convention:
    factor, columns = ANGLE_RATIOS[f"are {said}"], ", ".join(_EULER)
    return Convention("unit of Euler angles", f"have Euler angles in {said}", f"multiply {columns} by {factor:.9g}",
                      lambda m: m, (_EULER, factor * np.eye(3)), angles=factor, by_hand=True)  # fmt: skip


def _inverted(m: Motion) -> Motion:
    return m.inverse()


def _origin_of_a(m: Motion) -> Motion | None:
    """The shift stands in the axes of a: ``-R t`` was meant for ``t``."""
    return Pose3(m.rotation(), -(rotation_of(m) @ m.translation())) if isinstance(m, Pose3) else None


def _by_euler(meant: Callable[[FloatArray], FloatArray]) -> Callable[[Motion], Motion | None]:
    """Of the angles about z, y, x as which the rotation was read; None at gimbal lock, where they are not known."""

    def mend(m: Motion) -> Motion | None:
        try:
            R = Rot3(meant(euler_from_matrix(rotation_of(m), "zyx")))
        except SurveyError:
            return None
        return Pose3(R, m.translation()) if isinstance(m, Pose3) else R

    return mend


CONVENTIONS: tuple[Convention, ...] = (
    Convention("pairs inverted", "are a_from_b, read as b_from_a", "exchange a_id and b_id", _inverted, by_hand=True),
    replace(_of_shifts("metres, read as millimetres"), by_hand=True),
    _of_shifts("millimetres, read as metres"),
    _of_shifts("inches, read as millimetres"),
    *(_of_shifts("metres, read as millimetres", (column,)) for column in _SHIFT),
    *(replace(_numbers("order of quaternions", f"have quaternions in the order {meant}, read as {read}",
                       f"put the {which} of the four numbers {where}", _QUATERNION, np.roll(np.eye(4), by, axis=0)),
              by_hand=True) for meant, read, which, where, by in (("x y z w", "w x y z", "last", "first", 1),
                                                                 ("w x y z", "x y z w", "first", "last", -1))),
    _numbers("rotations inverted", "have the rotation of a_from_b beside the shift of b_from_a",
             "negate qx, qy and qz", _QUATERNION[1:], -np.eye(3)),
    Convention("shift in other axes", "have the origin of b in a, read as that of a in b",
               "replace the shifts t by -R t", _origin_of_a),
    Convention("order of Euler angles", "have Euler angles about x, y, z, read as about z, y, x",
               "give them in the order of the columns", _by_euler(lambda a: matrix_from_euler(-a, "zyx").T)),
    Convention("order of Euler angles", "have Euler angles of order 2-1-3, read as z, y, x",
               "name the columns by that order", _by_euler(lambda a: matrix_from_euler(a, "213"))),
    _numbers("left-handed frames", "are of frames whose z axis points the other way (left-handed)",
             "negate qx, qy and tz", ("qx", "qy", "tz_mm"), -np.eye(3)),
    _of_angles("gon, read as degrees"),
    _of_angles("radians, read as degrees"),
)  # fmt: skip


def mended(
    survey: Survey, rows: IntArray, convention: Convention, written: Written = UNKNOWN
) -> Survey | None:
    """The survey with these pairs as they were meant; None where they cannot have been misread so.

    The covariance is in the tangent of the motion as it is written; rotation and shift keep their sigmas.
    """
    pairs = {i: survey.pairs[i] for i in rows.tolist()}
    new = {i: replace(p, b_from_a=m) for i, p in pairs.items() if (m := convention.meant(p, written)) is not None}
    return with_rows(survey, "pairs", new) if len(new) == len(pairs) else None


def edits_of(survey: Survey, rows: IntArray, convention: Convention) -> tuple[Edit, ...]:
    """The change of these pairs in ``pairs.csv``; none where that is no matter of its columns."""
    where = {"pair_id": tuple(survey.pairs[i].pair_id for i in rows)}
    if convention.mend is _inverted:
        return (ExchangeColumns("pairs", ("a_id", "b_id"), where),)
    if convention.columns is None:
        return ()
    columns, matrix = convention.columns
    return (ChangeColumns("pairs", columns, matrix, np.zeros(len(columns)), where),)


def miss(motion: Motion, other: FloatArray) -> FloatArray:
    """(k,) rad and m: logarithm from a motion to the one with this logarithm (6,), of rotations alone (3,)."""
    if isinstance(motion, Pose3):
        return np.asarray(Pose3.Logmap(motion.between(Pose3.Expmap(other))))
    return np.asarray(Rot3.Logmap(motion.between(Rot3.Expmap(other))))
