"""An independent adjustment of terrestrial networks: plain dense NumPy, one function per kind of reading.

It shares nothing with the package but the values a reader hands over, and decides who is wrong where two programs
differ. Lengths are metres, angles radians; sigmas are a priori until multiplied by sigma0.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from adjust.model.survey import FloatArray, Survey

NULL_EIGENVALUE = 1e-11


@dataclass(frozen=True, eq=False)
class DenseResult:
    """points (n, 3) and sigmas (n, 3) by point; rows in the order readings, baselines (dx dy dz), coordinates.

    residual_cov (m,): variances of the residuals. decorrelated (m,): the same numbers as GNU Gama forms them, from the
    rows that the Cholesky factor of a correlated cluster has decorrelated; equal where nothing is correlated.
    last_step: m.
    """

    points: dict[str, FloatArray]
    sigmas: dict[str, FloatArray]
    cov: FloatArray
    columns: dict[tuple[str, int], int]
    orientations: dict[str, float]
    observed: FloatArray
    sigma: FloatArray
    residuals: FloatArray
    residual_cov: FloatArray
    decorrelated: FloatArray
    adjusted_sigmas: FloatArray
    omega: float
    redundancy: int
    defect: int
    last_step: float

    @property
    def sigma0(self) -> float:
        return float(np.sqrt(self.omega / self.redundancy)) if self.redundancy else float("nan")

    @property
    def standardized(self) -> FloatArray:
        return self.residuals / np.sqrt(np.maximum(self.residual_cov, 1e-300))


class _Model:
    def __init__(self, survey: Survey, start: dict[str, FloatArray]) -> None:
        self.survey = survey
        self.x = {p.point_id: np.array(start.get(p.point_id, p.x_in_world.value), dtype=float) for p in survey.points}
        self.columns: dict[tuple[str, int], int] = {}
        for point in survey.points:
            for i, axis in enumerate("xyz"):
                if point.x_in_world.treatment != "held" and axis not in point.x_in_world.held:
                    self.columns[point.point_id, i] = len(self.columns)
        turned = [r.setup_id for r in survey.readings if r.kind == "direction"]
        self.orientations = dict.fromkeys(turned)
        self.n_points = len(self.columns)
        self.setup_column = {s: self.n_points + k for k, s in enumerate(self.orientations)}
        self.n = self.n_points + len(self.orientations)

    def bearing(self, d: FloatArray) -> tuple[float, FloatArray]:
        zero, clockwise = self.survey.bearings.zero, self.survey.bearings.clockwise
        sign = -1.0 if clockwise else 1.0
        theta = np.arctan2(d[1], d[0]) - (np.pi / 2 if zero == "y" else 0.0)
        return sign * theta, sign * np.array([-d[1], d[0], 0.0]) / (d[0] ** 2 + d[1] ** 2)

    def offset(self, reading, to, height) -> FloatArray:
        up = np.array([0.0, 0.0, height - reading.instrument_height])
        return self.x[to.point_id] - self.x[reading.at.point_id] + up

    def row(self, r) -> tuple[float, list[tuple[str, FloatArray]], float]:
        """Predicted value, derivatives by points, derivative by the orientation."""
        at, to = r.at.point_id, r.to.point_id
        d = self.offset(r, r.to, r.target_height)
        flat, slope = np.hypot(d[0], d[1]), np.linalg.norm(d)
        if r.kind in ("direction", "azimuth", "angle"):
            value, g = self.bearing(d)
            if r.kind == "angle":
                right, h = self.bearing(self.offset(r, r.second, r.second_height))
                return right - value, [(at, g - h), (to, -g), (r.second.point_id, h)], 0.0
            shift = self.orientations[r.setup_id] if r.kind == "direction" else 0.0
            return value - shift, [(at, -g), (to, g)], -1.0 if r.kind == "direction" else 0.0
        value, g = {
            "horizontal_distance": lambda: (flat, np.array([d[0], d[1], 0.0]) / flat),
            "slope_distance": lambda: (slope, d / slope),
            "height_difference": lambda: (d[2], np.array([0.0, 0.0, 1.0])),
            "zenith": lambda: (
                np.arctan2(flat, d[2]),
                np.array([d[0] * d[2] / flat, d[1] * d[2] / flat, -flat]) / slope**2,
            ),
        }[r.kind]()
        return value, [(at, -g), (to, g)], 0.0

    def orient(self) -> None:
        """Orientations that fit the first direction of each set: linear, so any start will do."""
        for r in self.survey.readings:
            if r.kind == "direction" and self.orientations[r.setup_id] is None:
                self.orientations[r.setup_id] = self.bearing(self.offset(r, r.to, 0.0))[0] - r.value

    def system(self) -> tuple[sparse.csr_array, FloatArray, FloatArray, sparse.csr_array]:
        """Design matrix, observed - predicted, observed, covariance."""
        rows, cols, entries, misclosure, observed = [], [], [], [], []

        def add(value, predicted, parts, angular, extra=None):
            k = len(observed)
            w = value - predicted
            misclosure.append((w + np.pi) % (2 * np.pi) - np.pi if angular else w)
            observed.append(value)
            triples = [(self.columns.get((p, i)), g[i]) for p, g in parts for i in range(3)] + [extra or (None, 0.0)]
            for column, entry in triples:
                if column is not None and entry != 0.0:
                    rows.append(k)
                    cols.append(column)
                    entries.append(entry)

        blocks = []
        for r in self.survey.readings:
            predicted, parts, by_setup = self.row(r)
            extra = (self.setup_column[r.setup_id], by_setup) if by_setup else None
            add(r.value, predicted, parts, r.kind in ("direction", "azimuth", "angle"), extra)
        place = {r.reading_id: k for k, r in enumerate(self.survey.readings)}
        cov = sparse.lil_array(sparse.diags_array(np.array([r.sigma**2 for r in self.survey.readings])))
        for joint in self.survey.reading_covariances:
            idx = [place[i] for i in joint.reading_ids]
            cov[np.ix_(idx, idx)] = joint.cov
        if place:
            blocks.append(cov)
        unit = np.eye(3)
        for o in self.survey.coordinate_differences:
            for at, to, value in zip(o.at, o.to, o.values, strict=True):
                d = self.x[to.point_id] - self.x[at.point_id]
                for i in range(3):
                    add(value[i], d[i], [(at.point_id, -unit[i]), (to.point_id, unit[i])], False)
            blocks.append(o.cov)
        for o in self.survey.coordinates:
            seen = np.flatnonzero(np.isfinite(np.diagonal(o.cov)))
            for k in seen:
                point = o.positions[k // 3].point_id
                add(o.values[k // 3, k % 3], self.x[point][k % 3], [(point, unit[k % 3])], False)
            blocks.append(o.cov[np.ix_(seen, seen)])
        A = sparse.csr_array((entries, (rows, cols)), shape=(len(observed), self.n))
        return A, np.array(misclosure), np.array(observed), sparse.csr_array(sparse.block_diag(blocks))

    def move(self, dx: FloatArray) -> None:
        for (point, i), column in self.columns.items():
            self.x[point][i] += dx[column]
        for setup, column in self.setup_column.items():
            self.orientations[setup] += dx[column]


def _inverse(cov: sparse.csr_array) -> sparse.csr_array:
    if cov.nnz == cov.shape[0]:
        return sparse.csr_array(sparse.diags_array(1.0 / cov.diagonal()))
    return sparse.csr_array(sparse.linalg.inv(sparse.csc_array(cov)))


def _cofactors(model: _Model, N: FloatArray) -> tuple[FloatArray, int]:
    """Covariance of the unknowns and the defect; with inner constraints over the datum's points where there is one."""
    s = 1.0 / np.sqrt(np.diagonal(N))
    scaled = N * np.outer(s, s)
    if model.survey.datum.kind == "given":
        return np.outer(s, s) * cho_solve(cho_factor(scaled), np.eye(len(N))), 0
    values, vectors = np.linalg.eigh(scaled)
    null = values < NULL_EIGENVALUE
    Q = (vectors[:, ~null] / values[~null]) @ vectors[:, ~null].T * np.outer(s, s)
    if not null.any():
        return Q, 0
    H = np.linalg.qr(vectors[:, null] * s[:, None])[0]
    datum = set(model.survey.datum.points) or {p for p, _ in model.columns}
    chosen = np.zeros(len(N))
    chosen[[c for (p, _), c in model.columns.items() if p in datum]] = 1.0
    D = H * chosen[:, None]
    S = np.eye(len(N)) - H @ np.linalg.solve(D.T @ H, D.T)
    return S @ Q @ S.T, int(null.sum())


def _decorrelated(A: sparse.csr_array, Q: FloatArray, cov: sparse.csr_array) -> FloatArray:
    """sigma^2 (1 - q) with q the diagonal of L^-1 A Q A' L^-T, cov = L L'."""
    if cov.nnz == cov.shape[0]:
        return cov.diagonal() - np.einsum("ij,ij->i", A @ Q, A.toarray())
    B = np.linalg.solve(np.linalg.cholesky(cov.toarray()), A.toarray())
    return cov.diagonal() * (1.0 - np.einsum("ij,ij->i", B @ Q, B))


def dense_adjust(survey: Survey, start: dict[str, FloatArray], steps: int = 30, tolerance: float = 1e-9) -> DenseResult:
    """Gauss-Newton from ``start``; with ``steps=1`` one linearisation, as GNU Gama does it."""
    model = _Model(survey, start)
    for _ in range(steps):
        model.orient()
        A, w, observed, cov = model.system()
        P = _inverse(cov)
        N = (A.T @ P @ A).toarray()
        Q, defect = _cofactors(model, N)
        dx = Q @ (A.T @ (P @ w))
        model.move(dx)
        step = float(np.abs(dx[: model.n_points]).max(initial=0.0))
        if step < tolerance:
            break
    v = A @ dx - w
    adjusted_cov = np.einsum("ij,ij->i", A @ Q, A.toarray())
    variances = cov.diagonal()
    sigma = np.sqrt(np.clip(np.diagonal(Q), 0.0, None))
    sigmas = {
        p: np.array([sigma[model.columns[p, i]] if (p, i) in model.columns else 0.0 for i in range(3)]) for p in model.x
    }
    adjusted_sigmas = np.sqrt(np.clip(adjusted_cov, 0.0, None))
    return DenseResult(
        model.x, sigmas, Q, model.columns, dict(model.orientations), observed, np.sqrt(variances), v,
        variances - adjusted_cov, _decorrelated(A, Q, cov), adjusted_sigmas, float(v @ (P @ v)),
        len(observed) - model.n + defect, defect, step,
    )  # fmt: skip


def sparse_sigmas(survey: Survey, points: dict[str, FloatArray], chosen: list[tuple[str, int]]) -> FloatArray:
    """A priori sigmas of some coordinates of a large spatial network, linearised at ``points``.

    The datum is given, or inner over all points: then N is bordered by the motions that the readings do not see, three
    translations and the rotation about z.
    """
    model = _Model(survey, points)
    model.orient()
    A, _, _, cov = model.system()
    N = sparse.csc_array(A.T @ _inverse(cov) @ A)
    scale = 1.0 / np.sqrt(N.diagonal())
    D = sparse.diags_array(scale)
    K = D @ N @ D
    if survey.datum.kind == "inner":
        motions = np.zeros((model.n, 4))
        for (point, i), column in model.columns.items():
            motions[column, i] = 1.0
            motions[column, 3] = (-model.x[point][1], model.x[point][0], 0.0)[i]
        sign = -1.0 if survey.bearings.clockwise else 1.0
        border = np.linalg.qr(motions)[0]  # over the points alone: what the datum sums up
        motions[list(model.setup_column.values()), 3] = sign
        assert np.abs(A @ motions).max() < 1e-9 * np.abs(motions).max(), "no motion that the readings do not see"
        B = sparse.csc_array(border * scale[:, None])
        K = sparse.block_array([[K, B], [B.T, None]])
    factors = sparse.linalg.splu(sparse.csc_array(K))
    out = []
    for name in chosen:
        column = model.columns[name]
        unit = np.zeros(K.shape[0])
        unit[column] = 1.0
        out.append(scale[column] * np.sqrt(factors.solve(unit)[column]))
    return np.array(out)


def gradient_at(
    survey: Survey, points: dict[str, FloatArray], orientations: dict[str, float]
) -> tuple[FloatArray, FloatArray]:
    """A'P (observed - predicted) and the diagonal of A'PA; the first is zero at the least squares solution."""
    model = _Model(survey, points)
    model.orientations = {setup: orientations[setup] for setup in model.orientations}
    A, w, _, cov = model.system()
    P = _inverse(cov)
    return A.T @ (P @ w), (A.T @ P @ A).diagonal()
