"""All poses of the network together: a short least squares on the chains, each weighted by what its view can tell."""


import numpy as np
from scipy.sparse import csc_array

from adjust.graph.elimination import positive_definite_lu
from adjust.model.frozen import frozen
from adjust.model.memory import content, once
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.spatial.averaging import pose_distance
from adjust.spatial.rigid import adjoint, inverse, rigid, rotation_exp, rotation_log, skew
from adjust.start.chains import ChainObservation, Chains
from adjust.start.network import FrameNetwork
from adjust.start.views import View, Views

_DAMPING = 1e-7  # of the diagonal: what the observations leave open stays where it is
_GROSS_PX = 3.0


@frozen(eq=False)
class _Misfits:
    """n observations as arrays, chains padded to L links and alternatives to k; a pose behind all others is identity.

    columns: (n, L) number of the movable pose, -1 for none. measured: (n, k, 4, 4), the likeliest repeated as padding.
    roots: (n, 6, 6).
    """

    chains: Chains
    columns: IntArray
    measured: FloatArray
    roots: FloatArray


def polish(network: FrameNetwork, movable: BoolArray, views: Views, iterations: int = 6) -> None:
    """Move the movable poses to the minimum of the chains' misfit in px, robustly; nothing else changes.

    Source: pose-graph least squares with each measured pose weighted by the normal matrix of its image points, which is
    the bundle adjustment linearised at the measured poses. The caller's gauge poses are to be left out of ``movable``.
    From the same views, poses and observations it is done once.
    """
    s = views.sights
    seen = s.block_idx, s.x, s.rays, s.ptr, s.focal_px
    state = content(*network.state, movable, iterations, *seen)

    def polished() -> FloatArray:
        _polish(network, movable, views, iterations)
        return network.pose.copy()

    network.pose[:] = once(("polished", state), polished)


def _polish(network: FrameNetwork, movable: BoolArray, views: Views, iterations: int) -> None:
    items = network.whole()
    chains, of_block = items.chains, {v.block_idx: v for v in views}
    items = items.part(np.flatnonzero(((chains.slots >= 0) & movable[chains.slots]).any(axis=1)))
    if not len(items):
        return
    chains = items.chains
    moving = np.unique(chains.slots[chains.slots >= 0])
    moving = moving[movable[moving]]
    number = np.full(len(network.has) + 1, -1)
    number[moving] = np.arange(len(moving))
    roots = np.array([_root_information(network.lever, o, of_block.get(o.block_idx)) for o in items])
    most = max(len(o.poses) for o in items)
    measured = np.array([np.concatenate([o.poses, np.tile(o.poses[:1], (most - len(o.poses), 1, 1))]) for o in items])
    misfits = _Misfits(chains, number[chains.slots], measured, roots)
    poses = np.concatenate([network.pose, np.eye(4)[None]])
    network.pose[moving] = _minimise(misfits, poses, moving, network.lever, iterations)[moving]


def _root_information(lever: float, observation: ChainObservation, view: View | None) -> FloatArray:
    """Square root (6, 6) of the information of the observed pose against a motion on its left, rms px."""
    if view is None:
        return np.diag([1.0] * 3 + [1.0 / lever] * 3) * 1000.0
    pose = observation.poses[0]
    p = view.x @ pose[:3, :3].T + pose[:3, 3]
    depth = np.maximum(np.sum(p * view.rays, axis=1), 1e-9)
    by_point = _tangent_axes(view.rays) / depth[:, None, None]
    j = np.concatenate([-by_point @ skew(p), by_point], axis=2).reshape(-1, 6) * view.focal_px
    return np.asarray(np.linalg.qr(j / np.sqrt(len(p)), mode="r"))


def _tangent_axes(rays: FloatArray) -> FloatArray:
    """Two unit vectors (..., 2, 3) across each unit ray (..., 3) (Duff et al., J. Comput. Graph. Techn. 6(1), 2017)."""
    x, y, z = np.moveaxis(rays, -1, 0)
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first, second = (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)
    return np.stack([np.stack(first, axis=-1), np.stack(second, axis=-1)], axis=-2)


def _minimise(misfits: _Misfits, poses: FloatArray, places: IntArray, lever: float, iterations: int) -> FloatArray:
    """Gauss-Newton with Cauchy weights on the poses at ``places``, as long as it lowers the misfit."""
    best, best_cost, scale = poses, np.inf, np.inf
    for _ in range(iterations + 1):
        residuals, jacobians = _residuals(misfits, poses, lever)
        size = np.linalg.norm(residuals, axis=1)
        # the scale may only shrink: far from the minimum everything counts, near it gross errors do not
        scale = min(scale, max(3.0 * float(np.median(size)), _GROSS_PX))
        cost = float(np.sum(np.log1p((size / scale) ** 2)) * scale**2)
        if not cost < best_cost * (1 - 1e-6):
            break
        best, best_cost = poses, cost
        step = _step(misfits.columns, residuals, jacobians, 1.0 / (1.0 + (size / scale) ** 2), len(places))
        poses = poses.copy()
        poses[places] = poses[places] @ rigid(rotation_exp(step[:, :3]), step[:, 3:])
    return best


def _residuals(misfits: _Misfits, poses: FloatArray, lever: float) -> tuple[FloatArray, FloatArray]:
    """Residuals (n, 6) and derivatives (n, L, 6, 6) by each link's pose, moved on its right."""
    chains = misfits.chains
    n, longest = chains.slots.shape
    backwards = inverse(poses)
    before = np.tile(np.eye(4), (n, 1, 1))
    jacobians = np.empty((n, longest, 6, 6))
    for j in range(longest):
        turned = chains.inverted[:, j, None, None]
        after = before @ np.where(turned, backwards[chains.slots[:, j]], poses[chains.slots[:, j]])
        jacobians[:, j] = np.where(turned, -adjoint(before), adjoint(after))
        before = after
    nearest = np.argmin(pose_distance(misfits.measured, before[:, None], lever), axis=1)
    miss = before @ inverse(misfits.measured[np.arange(n), nearest])
    residuals = np.concatenate([rotation_log(miss[:, :3, :3]), miss[:, :3, 3]], axis=1)
    return (misfits.roots @ residuals[:, :, None])[..., 0], misfits.roots[:, None] @ jacobians


def _step(
    columns: IntArray, residuals: FloatArray, jacobians: FloatArray, weights: FloatArray, n_moving: int
) -> FloatArray:
    """One damped Gauss-Newton step (n_moving, 6)."""
    size = 6 * n_moving
    weighted = np.swapaxes(jacobians, 2, 3) * weights[:, None, None, None]
    right = np.zeros((n_moving, 6))
    inside = columns >= 0
    np.add.at(right, columns[inside], (weighted @ residuals[:, None, :, None])[..., 0][inside])
    blocks, row_idx, column_idx = [], [], []
    for a in range(columns.shape[1]):
        for b in range(columns.shape[1]):
            both = inside[:, a] & inside[:, b]
            blocks.append((weighted[both, a] @ jacobians[both, b]).ravel())
            row, column = 6 * columns[both, a], 6 * columns[both, b]
            row_idx.append((row[:, None, None] + np.arange(6)[:, None] + np.zeros(6, dtype=np.int64)).ravel())
            column_idx.append((column[:, None, None] + np.zeros((6, 1), dtype=np.int64) + np.arange(6)).ravel())
    entries = (np.concatenate(blocks), (np.concatenate(row_idx), np.concatenate(column_idx)))
    normal = csc_array(entries, shape=(size, size))
    diagonal = normal.diagonal()
    damping = _DAMPING * diagonal + 1e-12 * float(diagonal.max())
    damped = csc_array(normal + csc_array((damping, (np.arange(size), np.arange(size))), shape=(size, size)))
    return np.asarray(-positive_definite_lu(damped).solve(right.ravel()).reshape(-1, 6))
