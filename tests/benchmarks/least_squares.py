"""The same calibration as anybody would write it with numpy and scipy: vectorised residuals, analytic sparse Jacobian.

Unknowns in one vector: lenses (8 each), cameras but the first (rotation vector, translation), boards (the same).
"""

import numpy as np
from scipy import sparse
from scipy.optimize import least_squares
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from adjust.model.survey import FloatArray
from tests.benchmarks.data import Calibration, matrix


def cross(v: FloatArray) -> FloatArray:
    """Matrices (..., 3, 3) of the cross product with v (..., 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return np.asarray(out - np.swapaxes(out, -1, -2))


def right_jacobian(w: FloatArray) -> FloatArray:
    """Exp(w + dw) = Exp(w) Exp(J dw), for rotation vectors (n, 3)."""
    angle = np.maximum(np.linalg.norm(w, axis=1), 1e-8)[:, None, None]
    W = cross(w)
    return np.asarray(np.eye(3) - (1 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * W @ W)


def distorted(q: FloatArray, lens: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Image points (n, 2) of points q (n, 3), with derivatives by the lens (n, 2, 8) and by q (n, 2, 3)."""
    fx, fy, u0, v0, k1, k2, p1, p2 = (lens[:, i] for i in range(8))
    x, y = q[:, 0] / q[:, 2], q[:, 1] / q[:, 2]
    r2 = x * x + y * y
    d, dd = 1 + r2 * (k1 + r2 * k2), k1 + 2 * k2 * r2
    xd, yd = x * d + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * d + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    by_lens = np.zeros((len(q), 2, 8))
    by_lens[:, 0, 0], by_lens[:, 0, 2], by_lens[:, 1, 1], by_lens[:, 1, 3] = xd, 1.0, yd, 1.0
    by_lens[:, 0, 4:] = fx[:, None] * np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x], axis=1)
    by_lens[:, 1, 4:] = fy[:, None] * np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y], axis=1)
    xx = fx * (d + 2 * x * x * dd + 2 * p1 * y + 6 * p2 * x)
    mixed = 2 * x * y * dd + 2 * p1 * x + 2 * p2 * y
    yy = fy * (d + 2 * y * y * dd + 6 * p1 * y + 2 * p2 * x)
    by_q = np.empty((len(q), 2, 3))
    by_q[:, 0, 0], by_q[:, 0, 1] = xx / q[:, 2], fx * mixed / q[:, 2]
    by_q[:, 1, 0], by_q[:, 1, 1] = fy * mixed / q[:, 2], yy / q[:, 2]
    by_q[:, :, 2] = -(by_q[:, :, 0] * x[:, None] + by_q[:, :, 1] * y[:, None])
    return np.stack([fx * xd + u0, fy * yd + v0], axis=1), by_lens, by_q


class Model:
    """Residuals and Jacobian, whitened, of a calibration."""

    def __init__(self, case: Calibration) -> None:
        self.case = case
        self.n_cameras, self.n_boards = len(case.lens), len(case.head_from_board)
        n = len(case.board)
        self.camera, self.epoch = np.repeat(case.camera, n), np.repeat(case.epoch, n)
        self.x = np.tile(case.board, (len(case.camera), 1))
        self.uv = case.uv.reshape(-1, 2)
        self.first_pose = 8 * self.n_cameras
        self.first_board = self.first_pose + 6 * (self.n_cameras - 1)
        self.n = self.first_board + 6 * self.n_boards
        self._pattern()

    def _pattern(self) -> None:
        moved = self.camera > 0
        rows, columns = [], []
        row = 2 * np.arange(len(self.x))[:, None, None] + np.arange(2)[None, :, None]
        for first, width, which in (
            (8 * self.camera, 8, np.ones_like(moved)),
            (self.first_pose + 6 * (self.camera - 1), 6, moved),
            (self.first_board + 6 * self.epoch, 6, np.ones_like(moved)),
        ):
            column = first[:, None, None] + np.arange(width)[None, None, :]
            shape = (len(self.x), 2, width)
            rows.append(np.broadcast_to(row, shape)[which].ravel())
            columns.append(np.broadcast_to(column, shape)[which].ravel())
        self.rows, self.columns, self.moved = np.concatenate(rows), np.concatenate(columns), moved

    def start(self) -> FloatArray:
        """The rough start as a vector."""
        poses = list(self.case.camera_from_head[1:]) + list(self.case.head_from_board)
        vectors = [np.concatenate([Rotation.from_matrix(m[:3, :3]).as_rotvec(), m[:3, 3]]) for m in poses]
        return np.concatenate([self.case.lens.ravel(), *vectors])

    def _evaluate(self, p: FloatArray) -> tuple[FloatArray, ...]:
        lens = p[: self.first_pose].reshape(-1, 8)
        cameras = np.vstack([np.zeros(6), p[self.first_pose : self.first_board].reshape(-1, 6)])
        boards = p[self.first_board :].reshape(-1, 6)
        Rc, Rb = Rotation.from_rotvec(cameras[:, :3]).as_matrix(), Rotation.from_rotvec(boards[:, :3]).as_matrix()
        head = np.einsum("nij,nj->ni", Rb[self.epoch], self.x) + boards[self.epoch, 3:]
        q = np.einsum("nij,nj->ni", Rc[self.camera], head) + cameras[self.camera, 3:]
        uv, by_lens, by_q = distorted(q, lens[self.camera])
        return (uv - self.uv) / self.case.sigma_px, by_lens, by_q, Rc, Rb, cameras, boards, head

    def residuals(self, p: FloatArray) -> FloatArray:
        return np.asarray(self._evaluate(p)[0].ravel())

    def jacobian(self, p: FloatArray) -> sparse.csr_matrix:
        return self.both(p)[1]

    def both(self, p: FloatArray) -> tuple[FloatArray, sparse.csr_matrix]:
        r, by_lens, by_q, Rc, Rb, cameras, boards, head = self._evaluate(p)
        by_head = by_q @ Rc[self.camera]
        turn_board = -(Rb[self.epoch] @ cross(self.x)) @ right_jacobian(boards[:, :3])[self.epoch]
        by_board = np.concatenate([by_head @ turn_board, by_head], axis=2)
        m = self.moved
        turn_camera = -cross(head[m]) @ right_jacobian(cameras[:, :3])[self.camera[m]]
        by_camera = np.concatenate([by_head[m] @ turn_camera, by_q[m]], axis=2)
        data = np.concatenate([by_lens.ravel(), by_camera.ravel(), by_board.ravel()]) / self.case.sigma_px
        return r.ravel(), sparse.csr_matrix((data, (self.rows, self.columns)), shape=(r.size, self.n))

    def unpack(self, p: FloatArray) -> dict[str, FloatArray]:
        """Lenses and poses (4, 4) of a vector of unknowns."""
        cameras = np.vstack([np.zeros(6), p[self.first_pose : self.first_board].reshape(-1, 6)])
        return {
            "lens": p[: self.first_pose].reshape(-1, 8),
            "camera_from_head": np.array([matrix(v[:3], v[3:]) for v in cameras]),
            "head_from_board": np.array([matrix(v[:3], v[3:]) for v in p[self.first_board :].reshape(-1, 6)]),
        }


def trust_region(case: Calibration, evaluations: int) -> tuple[dict[str, FloatArray], str]:
    """``scipy.optimize.least_squares``: trf with the sparse analytic Jacobian, as its documentation advises."""
    model = Model(case)
    found = least_squares(
        model.residuals, model.start(), model.jacobian, method="trf", x_scale="jac", tr_solver="lsmr",
        ftol=1e-15, xtol=1e-15, gtol=1e-12, max_nfev=evaluations,
    )  # fmt: skip
    return model.unpack(found.x), f"{found.nfev} evaluations" + ("" if found.status > 0 else ", cut off")


def gauss_newton(case: Calibration) -> tuple[dict[str, FloatArray], str]:
    """Normal equations from the sparse Jacobian, factorised by SuperLU."""
    model = Model(case)
    p, moved, step = model.start(), np.inf, 0
    while moved > 1e-6 and step < 50:
        r, J = model.both(p)
        d = splu((J.T @ J).tocsc()).solve(-(J.T @ r))
        moved, step, p = float(np.linalg.norm(J @ d)), step + 1, p + d
    return model.unpack(p), f"{step} steps"
