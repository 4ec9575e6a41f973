"""Measured pairs as arrays: rotations, translations and covariances of all at once, checked and whitened."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import Pair, frame_text
from adjust.model.survey import BoolArray, FloatArray
from adjust.spatial.rigid_motions import Motions


@frozen(eq=False)
class PairArrays:
    """E measured ``b_from_a``: rotations (E, 3, 3), translations (E, 3) m, nan where only the rotation was measured.

    cov: (E, 6, 6) in the tangent of the frame on the right (a), infinite variance where nothing was measured.
    """

    rotations: FloatArray
    translations: FloatArray
    cov: FloatArray
    used: BoolArray

    def with_used(self, used: BoolArray) -> "PairArrays":
        """The same with other pairs in use; nothing else is computed again."""
        out = replace(self, used=used)
        out.__dict__.update({n: v for n, v in self.__dict__.items() if n not in out.__dict__})
        return out

    def with_sigmas_times(self, by: FloatArray) -> "PairArrays":
        """The same with all sigmas times ``by`` (E, 6); what is known of the motions is not computed again."""
        out = replace(self, cov=by[:, :, None] * self.cov * by[:, None, :])
        kept = {n: v for n, v in self.__dict__.items() if n in ("is_pose", "shifts", "motions", "poses", "logs")}
        out.__dict__.update(kept, whitening=self.whitening / by[:, None, :])
        return out

    @cached_property
    def is_pose(self) -> BoolArray:
        """Which pairs (E,) measured a translation too."""
        return np.isfinite(self.cov[:, 3, 3])

    @cached_property
    def whitening(self) -> FloatArray:
        """W (E, 6, 6), upper triangular, with W'W the inverse covariance; zero rows where nothing was measured."""
        out = np.zeros((len(self.used), 6, 6))
        for rows, n in ((self.is_pose, 6), (~self.is_pose, 3)):
            if rows.any():
                out[np.ix_(rows, np.arange(n), np.arange(n))] = whitening(self.cov[rows][:, :n, :n])
        return out

    @cached_property
    def doubtful(self) -> BoolArray:
        """Which pairs (E,) have a covariance that is not finite, symmetric, positive definite, by its correlations."""
        wrong = np.zeros(len(self.used), dtype=np.bool_)
        for rows, k in ((self.is_pose, 6), (~self.is_pose, 3)):
            C = self.cov[rows][:, :k, :k]
            scale = np.sqrt(np.maximum(np.diagonal(C, axis1=1, axis2=2), 1e-300))
            correlation = C / scale[:, :, None] / scale[:, None, :]
            finite = np.asarray(np.isfinite(correlation).all(axis=(1, 2)), dtype=np.bool_)
            whole = np.where(finite[:, None, None], correlation, -1.0)
            fine = np.full(len(whole), _all_above(whole, 1e-12))
            if not fine.all():
                fine = np.asarray(np.linalg.eigvalsh(whole).min(axis=1, initial=1.0) > 1e-12)
            fine = fine & (np.abs(whole - np.swapaxes(whole, 1, 2)).max(axis=(1, 2), initial=0.0) < 1e-6)
            wrong[np.flatnonzero(rows)[~fine]] = True
        return wrong

    @cached_property
    def shifts(self) -> FloatArray:
        """Translations (E, 3), zero where none was measured."""
        return np.nan_to_num(self.translations)

    @cached_property
    def motions(self) -> Motions:
        """All of them; translations that were not measured count as zero."""
        return Motions(self.rotations, self.shifts)

    @cached_property
    def poses(self) -> list[Pose3]:
        """The same one by one."""
        return [Pose3(Rot3(R), t) for R, t in zip(self.rotations, self.shifts, strict=True)]

    @cached_property
    def logs(self) -> FloatArray:
        """Logarithms (E, 6), of rotations the first three components."""
        return self.motions.log()


def _all_above(matrices: FloatArray, least: float) -> bool:
    """Whether all eigenvalues of all matrices (n, k, k) are clearly above: those that are not have no such Cholesky."""
    try:
        np.linalg.cholesky(matrices - 2.0 * least * np.eye(matrices.shape[-1]))
    except np.linalg.LinAlgError:
        return False
    return True


def whitening(cov: FloatArray) -> FloatArray:
    """Upper triangular W (E, dim, dim) with W'W = cov^-1, as GTSAM's noise models have it."""
    # a Cholesky of the reversed matrix: cov = U U' with U upper triangular, W = U^-1
    flipped = np.linalg.cholesky(cov[..., ::-1, ::-1])[..., ::-1, ::-1]
    return np.linalg.inv(flipped)


def upper_inverse(of: FloatArray) -> FloatArray:
    """Inverses of upper triangular matrices (E, dim, dim), column by column of all at once."""
    out = np.zeros(of.shape)
    for j in range(of.shape[-1]):
        out[:, j, j] = 1.0 / of[:, j, j]
        for i in range(j - 1, -1, -1):
            row = np.einsum("nk,nk->n", of[:, i, i + 1 : j + 1], out[:, i + 1 : j + 1, j])
            out[:, i, j] = -row / of[:, i, i]
    return out


@lru_cache(2)  # of a survey as it was given, and as it is solved
def pair_arrays(pairs: tuple[Pair, ...]) -> PairArrays:
    """Pairs as arrays, which are not to be changed: those of the same pairs are made once."""
    cov, size = np.zeros((len(pairs), 6, 6)), np.array([len(p.cov) for p in pairs], dtype=np.int64)
    cov[size == 3, 3:, 3:] = np.diag([np.inf] * 3)
    for k in (3, 6):
        alike = np.flatnonzero(size == k)
        cov[alike, :k, :k] = np.array([pairs[e].cov for e in alike.tolist()]).reshape(-1, k, k)
    measured = [p.b_from_a for p in pairs]
    M = np.full((len(pairs), 4, 4), np.nan)
    for e, m in enumerate(measured):
        if isinstance(m, Pose3):
            M[e] = m.matrix()
        else:
            M[e, :3, :3] = m.matrix()
    return PairArrays(M[:, :3, :3].copy(), M[:, :3, 3].copy(), cov, np.array([p.used for p in pairs], dtype=np.bool_))


def checked_arrays(pairs: Sequence[Pair]) -> PairArrays:
    """Pairs as arrays; raises SurveyError for the first whose covariance cannot be."""
    for p in pairs:
        n = 3 if isinstance(p.b_from_a, Rot3) else 6
        if np.shape(p.cov) != (n, n):
            raise SurveyError(f"{_said(p)}: its covariance has shape {np.shape(p.cov)}, expected ({n}, {n})")
    found = pair_arrays(tuple(pairs))
    wrong = np.flatnonzero(found.doubtful | ~np.array([np.isfinite(p.cov).all() for p in pairs], dtype=np.bool_))
    if len(wrong):
        raise SurveyError(
            f"{_said(pairs[int(wrong[0])])}: its covariance is not symmetric and positive definite; give every "
            "direction a sigma"
        )
    return found


def _said(pair: Pair) -> str:
    return f"pair {pair.pair_id!r} ({frame_text(pair.a)} to {frame_text(pair.b)})"
