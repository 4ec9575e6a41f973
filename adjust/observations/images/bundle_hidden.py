"""What follows from the interface of a bundle: poses and points that its batch has reduced, and their covariances."""

import numpy as np
import scipy

from adjust.model.survey import FloatArray, IntArray
from adjust.native.blocks import run_split
from adjust.native.bundles import (
    PointCovariances,
    between_poses,
    direct_influence,
    fill_upper,
    of_points,
    point_from_local,
    reduced_influence,
    with_lenses,
    with_poses,
)
from adjust.native.lenses import MAX_LENS
from adjust.observations.images.bundles import BundleBatch


class BundleHidden:
    """The hidden unknowns of a batch that is prepared with Jacobians, and stays so."""

    def __init__(self, batch: BundleBatch) -> None:
        self.batch = batch
        self._given_interface: tuple[FloatArray, FloatArray] | None = None
        self.keys = [*batch.hidden_poses, *(batch.point_key[i] for i in batch.reduced)]
        """What is hidden, in the order of stacked vectors of it: poses, then points."""

    @property
    def n(self) -> int:
        """Length of a stacked vector of what is hidden."""
        return self.batch.n_hidden + 3 * len(self.batch.reduced)

    def rows_along(self, V: FloatArray) -> FloatArray:
        """Whitened Jacobian times directions V (n_interface, k) as rows (2K, k), what is hidden following best.

        From the rows themselves: their normal equations would hide anything below the root of rounding.
        """
        b = self.batch
        nh, k = b.n_hidden, V.shape[1]
        d = np.vstack([np.zeros((nh, k)), V])
        if nh:
            right = np.asfortranarray(b.Y[:, :-1] @ (V * b.scale[nh:, None]))
            d[:nh] = -scipy.linalg.lapack.dtrtrs(b.C, right, lower=0)[0] / b.scale[:nh, None]
        local = np.asarray(b.G @ d)
        points = np.zeros((len(b.point_ids), 3, k))
        points[b.reduced] = b.points_following(local, np.zeros((len(b.reduced), 3, k)))
        for i, at in b.tied_at.items():
            points[i] = local[at : at + 3]
        poses = local[b.first_pose : b.first_pose + 6 * len(b.blocks)].reshape(-1, 6, k)
        by_pose, by_point = b.A[:, :, MAX_LENS : MAX_LENS + 6], b.A[:, :, MAX_LENS + 3 : MAX_LENS + 6]
        out = by_pose @ poses[b.block] + by_point @ points[b.point]
        for camera in sorted(set(b.camera_of.tolist())):
            mine, free = b.camera_of == camera, int(b.state.lenses.n_free[camera])
            out[mine] += b.A[mine, :, :free] @ local[b.lens_at[camera] : b.lens_at[camera] + free]
        return np.asarray(out.reshape(-1, k))

    def _hidden_poses_given_interface(self) -> tuple[FloatArray, FloatArray]:
        """Hidden poses by the interface (n_hidden, n_interface), and their covariance when that is known."""
        b = self.batch
        if self._given_interface is None:
            nh = b.n_hidden
            scale = b.scale[:nh]
            T = -scipy.linalg.lapack.dtrtrs(b.C, b.Y[:, :-1], lower=0)[0]
            P = scipy.linalg.lapack.dpotri(b.C, lower=0)[0].T  # in C's order the lower triangle
            fill_upper(P)
            P /= scale
            P /= scale[:, None]
            self._given_interface = T / scale[:, None] * b.scale[nh:], P
        return self._given_interface

    def covariances(self, Q_interface: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Covariances of everything hidden, from the interface's joint covariance (order ``interface``).

        Returns that of all poses and tied points (order ``order``), of the reduced points (P, 3, 3), and the whitened
        A Q A' (K, 3) of every image point (sorted order). The batch must be prepared with Jacobians at the solution.
        """
        b = self.batch
        nh, n = b.n_hidden, b.n_keys
        Q = np.empty((n, n))
        Q[nh:, nh:] = Q_interface
        if nh:
            T, P = self._hidden_poses_given_interface()
            Q[:nh, nh:] = T @ Q_interface
            Q[nh:, :nh] = Q[:nh, nh:].T
            np.matmul(Q[:nh, nh:], T.T, out=Q[:nh, :nh])
            Q[:nh, :nh] += P
        b.evaluate_rows(b.W_all)
        return Q, *self._of_points_and_rows(self._local_covariance(Q))

    def _local_covariance(self, Q: FloatArray) -> FloatArray:
        """G Q G' (n_local, n_local)."""
        b = self.batch
        nh = b.n_hidden
        if not b.alone:
            return np.ascontiguousarray(b.G @ (b.G @ Q).T)
        out = np.zeros((b.n_local, b.n_local))
        between_poses(Q, b.own_at, b.chains.C[b.own_links], False, False, out)
        to_interface = b.G[:, nh:]
        mine = np.flatnonzero(np.diff(to_interface.indptr))
        across = np.asarray(to_interface[mine] @ (b.G @ np.ascontiguousarray(Q[:, nh:])).T)
        out[mine], out[:, mine] = across, across.T
        return out

    def _of_points_and_rows(self, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Covariances (P, 3, 3) of the reduced points, A Q A' (K, 3) of all image points. Q: of the local unknowns."""
        b = self.batch
        Y, YL = np.empty_like(b.W3), np.zeros_like(b.WL)
        point_from_local(b.arrays, b.of_reduced, Y, YL)
        points = PointCovariances(np.empty_like(b.W3), np.zeros_like(b.WL), np.zeros((len(b.reduced), 3, 3)))
        run_split(with_poses, b.runs, b.arrays, Q, Y, YL, points.B)
        with_lenses(b.arrays, b.Vi, Q, Y, YL, points)
        influence = np.zeros((len(b.point), 3))
        run_split(reduced_influence, b.runs, b.arrays, b.A, Q, points, influence)
        direct_influence(b.n_reduced, len(b.point), b.arrays, b.A, Q, influence)
        return points.C, influence

    def on_poses(self, right: FloatArray) -> FloatArray:
        """Right-hand sides of what is hidden (n, k) as such (n_keys, k) on its poses and the interface."""
        b = self.batch
        nh, k = b.n_hidden, right.shape[1]
        local = np.zeros((b.n_local, k))
        points = right[nh:].reshape(len(b.reduced), 3, k)
        seen, own = np.flatnonzero(points.any(axis=(1, 2))), np.zeros(points.shape)
        own[seen] = b.Vi[seen] @ points[seen]
        of_points(b.arrays, b.of_reduced, own, local)
        out = np.asarray(b.G.T @ local)
        out[:nh] += right[:nh]
        return out

    def on_interface(self, on_poses: FloatArray) -> FloatArray:
        """The same on the interface alone (n_interface, k)."""
        nh = self.batch.n_hidden
        return on_poses[nh:] + self._hidden_poses_given_interface()[0].T @ on_poses[:nh] if nh else on_poses

    def multiply(self, x: FloatArray, interface: FloatArray, some: IntArray, on_poses: FloatArray) -> None:
        """Covariance times right-hand sides x (n, k) of what is hidden, in place, and that of the interface (., k).

        on_poses: what :meth:`on_poses` makes of the columns ``some`` of x; the others are zero. The batch is prepared.
        """
        b = self.batch
        nh = b.n_hidden
        d = np.concatenate([np.zeros((nh, interface.shape[1])), interface])
        if nh:
            T, P = self._hidden_poses_given_interface()
            d[:nh] = T @ interface
            d[:nh, some] += P @ on_poses[:nh]
        x[:nh] = d[:nh]
        np.negative(x[nh:], out=x[nh:])
        points = x[nh:].reshape(len(b.reduced), 3, interface.shape[1])
        b.points_following(np.asarray(b.G @ d), points)

    def drawn(self, interface: FloatArray, w: FloatArray) -> FloatArray:
        """Errors of what is hidden (n, k) with those of the interface (n_interface, k); w (n, k): independent, unit."""
        b = self.batch
        nh, k = b.n_hidden, interface.shape[1]
        d = np.vstack([np.zeros((nh, k)), interface])
        if nh:
            own = scipy.linalg.lapack.dtrtrs(b.C, w[:nh], lower=0)[0]
            d[:nh] = self._hidden_poses_given_interface()[0] @ interface + own / b.scale[:nh, None]
        own = np.linalg.cholesky(b.Vi) @ w[nh:].reshape(-1, 3, k)
        dX = b.points_following(np.asarray(b.G @ d), np.zeros_like(own)) + own
        return np.concatenate([d[:nh], dX.reshape(-1, k)])

    def half(self, right: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Of rows over what is hidden, right (n, m): U (k, m) with U'U = A Q A' were the interface held.

        Before it which (k,) of all n rows of U these are, after it what they are over the interface (m, n_interface).
        """
        b, m = self.batch, right.shape[1]
        nh, points = b.n_hidden, right[b.n_hidden :].reshape(-1, 3, m)
        u, seen = self.on_poses(right), np.flatnonzero(points.any(axis=(1, 2)))
        half = (np.swapaxes(np.linalg.cholesky(b.Vi[seen]), 1, 2) @ points[seen]).reshape(-1, m)
        rows = (nh + 3 * seen[:, None] + np.arange(3)).ravel()
        if nh:
            of_poses = scipy.linalg.lapack.dtrtrs(b.C, u[:nh] / b.scale[:nh, None], lower=0, trans=1)[0]
            rows, half = np.concatenate([np.arange(nh), rows]), np.concatenate([of_poses, half])
        return rows, half, self.on_interface(u).T
