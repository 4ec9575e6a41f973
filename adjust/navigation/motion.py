"""What is known of a pose before its spots are seen: from the table's angles, or from the motion so far.

The errors of beacons and calibration are the same at all epochs, so a filter that took each epoch for new information
about them would become surer than it may. The filter here carries them beside its own error (a consider filter,
Schmidt 1966): the error of its state is ``e + B eta``, and every step transforms both parts exactly.
"""


import numpy as np
from gtsam import Pose3

from adjust.frames.tables import table_motions
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.navigation.fit import PoseFit, Prior, local, local_derivative
from adjust.navigation.model import Motion, NavigationEpoch, PosePrior
from adjust.navigation.system import System
from adjust.spatial.rigid import rigid


def given_prior(prior: PosePrior, system: System) -> Prior:
    """A prior as the fit takes it; its error has nothing to do with the calibration's."""
    rows = np.flatnonzero(np.isfinite(np.diag(prior.cov)))
    cov = np.zeros((6, 6))
    cov[np.ix_(rows, rows)] = prior.cov[np.ix_(rows, rows)]
    return Prior(prior.world_from_station.matrix(), cov, np.zeros((6, system.F.shape[1])), rows)


def table_prior(system: System, epoch: NavigationEpoch) -> Prior | None:
    """The pose by the table's angles at an epoch, None where there is no table or no reading.

    ``world_from_station = world_from_table * table_from_mount(angles) * mount_from_station``; the calibration errors of
    the table hang together with those of the cameras, through the joint covariance of the head.
    """
    table = system.head.table
    if table is None or epoch.table_angles is None:
        return None
    (R,), (t,), (D,) = table_motions(table.axes, table.geometry, np.array([epoch.table_angles], dtype=float))
    mount = table.mount_from_station
    motion = Pose3(rigid(R, t))
    pose = table.world_from_table * motion * mount
    by_base, by_motion = (motion * mount).inverse().AdjointMap(), mount.inverse().AdjointMap()
    at, k = system.table_at, len(table.axes)
    end = at + 6 + len(table.geometry)
    B = by_base @ system.F[at : at + 6] + by_motion @ D[:, k:] @ system.F[at + 6 : end]
    by_angles = by_motion @ D[:, :k]
    reading = np.zeros((k, k)) if epoch.table_cov is None else epoch.table_cov
    return Prior(pose.matrix(), by_angles @ reading @ by_angles.T, B + system.F[end : end + 6], np.arange(6))


@frozen(eq=False)
class MotionState:
    """Pose (4, 4) and body rates (6,) at a time; errors ``e + B eta``, e of covariance P (12, 12), B (12, r)."""

    time_s: float
    pose: FloatArray
    rate: FloatArray
    P: FloatArray
    B: FloatArray

    @property
    def prior(self) -> Prior:
        """What it says of the pose."""
        return Prior(self.pose, self.P[:6, :6], self.B[:6], np.arange(6))


def started(fit: PoseFit, time_s: float, motion: Motion) -> MotionState:
    """At rest, as well as that is known, at a pose."""
    P = np.zeros((12, 12))
    P[:6, :6] = fit.own_cov
    P[6:9, 6:9] = np.eye(3) * motion.sigma_angular_rate**2
    P[9:, 9:] = np.eye(3) * motion.sigma_speed**2
    return MotionState(time_s, fit.pose, np.zeros(6), P, np.vstack([fit.B, np.zeros_like(fit.B)]))


def predicted(state: MotionState, time_s: float, motion: Motion) -> MotionState:
    """The state at another time (later or earlier), under white accelerations."""
    dt = time_s - state.time_s
    step = state.rate * dt
    right = np.zeros((6, 6), order="F")
    move = Pose3.Expmap(step, right)
    A = np.eye(12)
    A[:6, :6] = move.inverse().AdjointMap()
    A[:6, 6:] = dt * right
    S = np.diag([motion.sigma_angular_acceleration**2] * 3 + [motion.sigma_acceleration**2] * 3)
    span = abs(dt)
    Q = np.block([[S * span**3 / 3, S * span * dt / 2], [S * span * dt / 2, S * span]])
    return MotionState(time_s, state.pose @ move.matrix(), state.rate, A @ state.P @ A.T + Q, A @ state.B)


def updated(state: MotionState, fit: PoseFit) -> MotionState:
    """The state after a fit that had ``state.prior`` as its prior.

    The rates follow the pose by their correlation with it; whatever that gain, the errors pass through it exactly.
    """
    step = local(state.pose, fit.pose)
    K = np.linalg.solve(state.P[:6, :6] + state.B[:6] @ state.B[:6].T,
                        (state.P[6:, :6] + state.B[6:] @ state.B[:6].T).T).T  # fmt: skip
    # the prior's rows are -(e + B eta), turned from the prior's tangent into that of the fit
    n, J = 2 * len(fit.used), local_derivative(step)
    G, A_pose = fit.gain[:, :n], -fit.gain[:, n:]
    A = np.zeros((12, 12))
    A[:6, :6] = A_pose
    A[6:, :6] = K @ (J @ A_pose - np.eye(6))
    A[6:, 6:] = np.eye(6)
    N = np.vstack([G, K @ J @ G])
    B = np.vstack([fit.B, state.B[6:] + K @ (J @ fit.B - state.B[:6])])
    P = A @ state.P @ A.T + N @ fit.R[:n, :n] @ N.T
    return MotionState(state.time_s, fit.pose, state.rate + K @ step, 0.5 * (P + P.T), B)
