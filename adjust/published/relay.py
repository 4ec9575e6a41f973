"""The relay-station paper's own iteration (Chao et al. 2011, eqs. 3-30), as a reference for the rigorous forms.

Unknowns are the Euler angles (zyx) of every measured pair. Every loop gives the 9 elements of ``I - M``, M the product
round it, linear in the corrections of the angles: ``C dX = B``; dX is the Moore-Penrose solution, unweighted (eq. 27)
or with ``P^-1 = D / sigma0^2`` (eqs. 29, 30); the angles move on until all corrections are below 1".

Its limits: C P^-1 C' of the nine equations is singular, so that the inverse of eqs. 27 and 30 has to be a generalised
one; each step is the least in itself, not the sum of all steps, so that the result differs from the least squares one
in second order; equal weights mean equal sigmas of Euler angles; near gimbal lock the angles cannot be corrected.
"""


import numpy as np
import scipy.linalg

from adjust.model.errors import NotConvergedError, SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.pose_network.loops import evaluate_loops, loop_vectors
from adjust.relay.loops import LoopBasis, loop_basis
from adjust.relay.network import MeasuredPairs
from adjust.spatial.rigid import skew
from adjust.spatial.rigid_motions import Motions, exp, right_jacobian
from adjust.spatial.rotation_forms import euler_cov_from_tangent, euler_from_matrix, euler_jacobian, matrix_from_euler

ARCSECOND = np.pi / (180.0 * 3600.0)
# [u]x = sum over l of u_l CROSS[:, l, :]
CROSS = np.swapaxes(skew(np.eye(3)), 0, 1)


@frozen(eq=False)
class PaperOptions:
    """How the paper's iteration runs.

    euler_cov: D (E, 3, 3) rad^2 of the measured Euler angles, None for equal weights; sigma0 cancels out of the
    corrections. tolerance: rad.
    """

    euler_cov: FloatArray | None = None
    tolerance: float = ARCSECOND
    max_iterations: int = 20


@frozen(eq=False)
class PaperSolution:
    """What the iteration found.

    angles: adjusted Euler angles (E, 3) rad. corrections: the largest of each iteration; misclosure: what is left, rad.
    b_from_a: the adjusted pairs as rotations.
    """

    angles: FloatArray
    b_from_a: Motions
    basis: LoopBasis
    corrections: tuple[float, ...]
    misclosure: float

    @property
    def iterations(self) -> int:
        """Iterations until all corrections were below the tolerance, that one included."""
        return len(self.corrections)


def paper_iteration(network: MeasuredPairs, options: PaperOptions = PaperOptions()) -> PaperSolution:
    """Iterate the corrections of Euler angles. Raises SurveyError (poses, gimbal lock), NotConvergedError."""
    if network.dim != 3:
        raise SurveyError("the paper's iteration adjusts rotations alone; take the rotation part of the network")
    basis = loop_basis(network.topology)
    angles = euler_from_matrix(network.b_from_a.rotation)
    root = _weight_root(options, network.topology.n_pairs)
    corrections: list[float] = []
    while len(corrections) < options.max_iterations:
        C, B = loop_equations(basis, angles)
        # P^-1/2 (C P^-1/2)^+ B is eq. 30 with the generalised inverse that its singular C P^-1 C' needs
        step = root @ np.linalg.lstsq(C @ root, B, rcond=1e-10)[0]
        angles = angles + step.reshape(-1, 3)
        corrections.append(float(np.abs(step).max(initial=0.0)))
        if corrections[-1] < options.tolerance:
            X = Motions(matrix_from_euler(angles))
            left = float(np.abs(loop_vectors(basis, X)).max(initial=0.0))
            return PaperSolution(angles, X, basis, tuple(corrections), left)
    worst = int(np.argmin(np.abs(np.cos(angles[:, 1]))))
    raise NotConvergedError(
        f"Euler angles still move by {corrections[-1] / ARCSECOND:.3g} arcsec after {options.max_iterations} "
        f"iterations; pair {network.topology.pair_ids[worst]!r} is nearest to gimbal lock "
        f"(y = {np.degrees(angles[worst, 1]):.2f} deg); use the condition or the parametric form"
    )


def loop_equations(basis: LoopBasis, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """C (9 L, 3 E) and B (9 L,) of all loops, eqs. 4-26.

    A pair's angle q turns M into ``M [u]x``, u the tangent of the angle seen from the loop's first station.
    """
    w, blocks = evaluate_loops(basis, Motions(matrix_from_euler(angles)))
    by_angle = blocks @ euler_jacobian(angles)[basis.pair_idx]
    loop = np.repeat(np.arange(len(basis)), basis.lengths)
    M = exp(w).rotation
    u = right_jacobian(w)[loop] @ by_angle
    C = np.zeros((len(basis), 9, basis.topology.n_pairs, 3))
    C[loop, :, basis.pair_idx] = np.einsum("kij,jlm,klq->kimq", M[loop], CROSS, u).reshape(-1, 9, 3)
    return C.reshape(9 * len(basis), -1), (np.eye(3) - M).reshape(-1)


def adjusted_covariances(found: PaperSolution, options: PaperOptions, cov: FloatArray) -> FloatArray:
    """(E, 3, 3) rad^2 of the adjusted pairs in their tangents that the errors of the measured pairs cause.

    cov: (E, 3, 3) of the measured pairs in their tangents, whatever the weights were. First order at the solution: the
    corrections are G (B - C dX), G the generalised inverse of eq. 30, so that errors come through I - G C.
    """
    n = found.basis.topology.n_pairs
    C, _ = loop_equations(found.basis, found.angles)
    root = _weight_root(options, n)
    through = np.eye(3 * n) - root @ np.linalg.pinv(C @ root, rcond=1e-10) @ C
    J = euler_jacobian(found.angles)
    inverse = np.linalg.inv(J)
    D = scipy.linalg.block_diag(*(inverse @ cov @ np.swapaxes(inverse, -1, -2)))
    at = np.arange(n)
    out = (through @ D @ through.T).reshape(n, 3, n, 3)[at, :, at, :]
    return np.asarray(J @ out @ np.swapaxes(J, -1, -2))


def euler_covariances(network: MeasuredPairs) -> FloatArray:
    """D (E, 3, 3) rad^2 of the measured Euler angles. Raises SurveyError at gimbal lock."""
    return euler_cov_from_tangent(euler_from_matrix(network.b_from_a.rotation), network.cov)


def _weight_root(options: PaperOptions, n_pairs: int) -> FloatArray:
    """P^-1/2 (3 E, 3 E), block diagonal; eq. 29."""
    if options.euler_cov is None:
        return np.eye(3 * n_pairs)
    return np.asarray(scipy.linalg.block_diag(*np.linalg.cholesky(options.euler_cov)))
