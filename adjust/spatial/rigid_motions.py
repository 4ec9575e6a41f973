"""Many rotations or rigid motions at once, as arrays, with GTSAM's tangents.

A tangent is (3,) rad, or (6,) rad and m with the rotation first, applied on the right: ``X Exp(d)``. The derivatives of
Exp and Log follow Sola, Deray and Atchuthan (2018, "A micro Lie theory", eqs. 143-146, 174-180) and Barfoot (2017,
"State Estimation for Robotics", eq. 7.86 for the coupling block).
"""

from collections.abc import Sequence

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.pairs import right_jacobians
from adjust.spatial.rigid import adjoint, rigid, rotation_exp, rotation_log


@frozen(eq=False)
class Motions:
    """n rotations (translation None) or rigid motions: rotation (n, 3, 3), translation (n, 3) m."""

    rotation: FloatArray
    translation: FloatArray | None = None

    @property
    def dim(self) -> int:
        """3 for rotations, 6 for rigid motions."""
        return 3 if self.translation is None else 6

    @staticmethod
    def of(matrices: FloatArray) -> "Motions":
        """Rigid motions of matrices (n, 4, 4)."""
        return Motions(matrices[:, :3, :3].copy(), matrices[:, :3, 3].copy())

    @staticmethod
    def joined(parts: Sequence["Motions"]) -> "Motions":
        """One after the other."""
        shifts = [p.translation for p in parts if p.translation is not None]
        return Motions(np.concatenate([p.rotation for p in parts]), np.concatenate(shifts) if shifts else None)

    def in_dim(self, dim: int) -> "Motions":
        """These, or with 3 their rotations alone."""
        return Motions(self.rotation) if dim == 3 else self

    @property
    def shifts(self) -> FloatArray:
        """Translations (n, 3) m of rigid motions. Raises ValueError for rotations alone."""
        if self.translation is None:
            raise ValueError("a rotation alone is no pose")
        return self.translation

    def matrices(self) -> FloatArray:
        """The same (n, 4, 4) of rigid motions."""
        return rigid(self.rotation, self.shifts)

    def rescaled(self, factor: float | FloatArray) -> "Motions":
        """Rigid motions with their lengths times a factor, or times one of each (n,)."""
        return Motions(self.rotation, self.shifts * np.reshape(factor, (-1, 1)))

    def __len__(self) -> int:
        return len(self.rotation)

    def __getitem__(self, index: IntArray | BoolArray | slice) -> "Motions":
        t = self.translation
        return Motions(self.rotation[index], None if t is None else t[index])

    def __matmul__(self, other: "Motions") -> "Motions":
        rotation = self.rotation @ other.rotation
        if self.translation is None or other.translation is None:
            return Motions(rotation)
        return Motions(rotation, (self.rotation @ other.translation[..., None])[..., 0] + self.translation)

    def inverse(self) -> "Motions":
        """The motions the other way round."""
        back = np.swapaxes(self.rotation, -1, -2)
        if self.translation is None:
            return Motions(back)
        return Motions(back, -(back @ self.translation[..., None])[..., 0])

    def where(self, mask: BoolArray, other: "Motions") -> "Motions":
        """These where ``mask`` (n,) holds, the others elsewhere."""
        rotation = np.where(mask[:, None, None], self.rotation, other.rotation)
        if self.translation is None or other.translation is None:
            return Motions(rotation)
        return Motions(rotation, np.where(mask[:, None], self.translation, other.translation))

    def retract(self, delta: FloatArray) -> "Motions":
        """Moved by tangents (n, dim) on the right."""
        return self @ exp(delta)

    def log(self) -> FloatArray:
        """Tangents (n, dim) at identity."""
        omega = rotation_log(self.rotation)
        if self.translation is None:
            return omega
        back = right_jacobian_inverse(-omega)  # the left Jacobian's inverse
        return np.concatenate([omega, (back @ self.translation[..., None])[..., 0]], axis=-1)

    def adjoint(self) -> FloatArray:
        """Ad (n, dim, dim): ``X Exp(d) X^-1 = Exp(Ad d)``."""
        if self.translation is None:
            return self.rotation
        return adjoint(self.matrices())


def identities(n: int, dim: int) -> Motions:
    """As many identities."""
    return Motions(np.broadcast_to(np.eye(3), (n, 3, 3)).copy(), None if dim == 3 else np.zeros((n, 3)))


def exp(delta: FloatArray) -> Motions:
    """Motions of tangents (n, 3) or (n, 6)."""
    omega = delta[..., :3]
    if delta.shape[-1] == 3:
        return Motions(rotation_exp(omega))
    left = right_jacobian(-omega)
    return Motions(rotation_exp(omega), (left @ delta[..., 3:, None])[..., 0])


def right_jacobian(delta: FloatArray) -> FloatArray:
    """Jr (n, dim, dim): ``Exp(d + e) = Exp(d) Exp(Jr e)`` to first order."""
    return right_jacobians(delta, False)


def right_jacobian_inverse(delta: FloatArray) -> FloatArray:
    """Jr^-1 (n, dim, dim), the derivative of Log: ``Log(Exp(d) Exp(e)) = d + Jr^-1 e`` to first order."""
    return right_jacobians(delta, True)
