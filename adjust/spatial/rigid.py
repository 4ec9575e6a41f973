"""Rotations and rigid motions as plain arrays: (..., 3, 3) and (..., 4, 4), all vectorised over the leading axes."""

import numpy as np
from gtsam import Pose3

from adjust.model.survey import FloatArray
from adjust.native.views import turns_by, turns_of

_TINY = 1e-12


def skew(w: FloatArray) -> FloatArray:
    """Cross-product matrix (..., 3, 3) of vectors (..., 3)."""
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    return out - np.swapaxes(out, -1, -2)


def rotation_exp(w: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) of rotation vectors (..., 3) rad (Rodrigues)."""
    w = np.ascontiguousarray(w, dtype=np.float64)
    out = np.empty((*w.shape, 3))
    turns_by(w.reshape(-1, 3), out.reshape(-1, 3, 3))
    return out


def rotation_log(r: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3) rad of rotations (..., 3, 3), through the quaternion: exact up to half a turn."""
    r = np.ascontiguousarray(r, dtype=np.float64)
    out = np.empty(r.shape[:-1])
    turns_of(r.reshape(-1, 3, 3), out.reshape(-1, 3))
    return out


def nearest_rotation(m: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) nearest to matrices in the Frobenius norm (orthogonal Procrustes, Schoenemann 1966)."""
    u, _, vt = np.linalg.svd(m)
    out = u @ vt
    mirrored = np.linalg.det(out) < 0.0
    if mirrored.any():
        u[..., :, 2] *= np.where(mirrored, -1.0, 1.0)[..., None]
        out = u @ vt
    return np.asarray(out)


def rigid(r: FloatArray, t: FloatArray) -> FloatArray:
    """Rigid motions (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    many, shifts = r.shape[:-2], t.shape[:-1]
    out = np.zeros((*(many if many == shifts else np.broadcast_shapes(many, shifts)), 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = r, t, 1.0
    return out


def inverse(m: FloatArray) -> FloatArray:
    """Inverse rigid motions (..., 4, 4)."""
    rt = np.swapaxes(m[..., :3, :3], -1, -2)
    return rigid(rt, -(rt @ m[..., :3, 3, None])[..., 0])


def as_pose3(m: FloatArray) -> Pose3:
    """GTSAM's pose of a motion (4, 4)."""
    return Pose3(np.ascontiguousarray(m))


def transform(m: FloatArray, x: FloatArray) -> FloatArray:
    """Points (..., 3) moved by rigid motions (..., 4, 4)."""
    return np.asarray((m[..., :3, :3] @ x[..., None])[..., 0] + m[..., :3, 3])


def adjoint(m: FloatArray) -> FloatArray:
    """(..., 6, 6): a small motion (rotation, translation) on the right of m (..., 4, 4) as one on its left."""
    R, t = m[..., :3, :3], m[..., :3, 3]
    out = np.zeros((*m.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., 3:, :3] = skew(t) @ R
    return out


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Of two vectors (3,), without what np.cross asks first."""
    (a1, a2, a3), (b1, b2, b3) = a.tolist(), b.tolist()
    return np.array([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1])


def rotation_to(a: FloatArray, b: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that turns direction a (3,) into direction b (3,)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis, cosine = _cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < _TINY:
        if cosine > 0:
            return np.eye(3)
        axis = _cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
        return rotation_exp(np.pi * axis / np.linalg.norm(axis))
    return rotation_exp(axis / sine * float(np.arctan2(sine, cosine)))


def align(x_in_a: FloatArray, x_in_b: FloatArray) -> FloatArray:
    """``a_from_b`` (4, 4) that best moves points (n, 3) of b onto those of a.

    Source: Umeyama, PAMI 13(4), 1991, without scale. Two points leave the turn about their line at its smallest, one
    point leaves the rotation at identity.
    """
    mean_a, mean_b = x_in_a.mean(axis=0), x_in_b.mean(axis=0)
    m = (x_in_a - mean_a).T @ (x_in_b - mean_b)
    scale = np.linalg.svd(m, compute_uv=False)
    if len(x_in_a) < 2 or scale[0] <= _TINY:
        r = np.eye(3)
    elif len(x_in_a) == 2 or scale[1] < 1e-9 * scale[0]:
        u, _, vt = np.linalg.svd(m)
        sign = 1.0 if u[:, 0] @ m @ vt[0] > 0 else -1.0
        r = rotation_to(vt[0], sign * u[:, 0])
    else:
        r = nearest_rotation(m)
    return rigid(r, mean_a - r @ mean_b)
