"""All poses of the network together: a short least squares on the chains, each weighted by what its view can tell."""

from collections.abc import Mapping

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from adjust.closed_forms import inverse, pose_distance, rigid, rotation_exp, rotation_log
from adjust.closed_forms.absolute_pose import tangent_axes
from adjust.closed_forms.rigid import skew
from adjust.initial.network import ChainObservation, PoseNetwork
from adjust.initial.views import View
from adjust.model import FloatArray
from adjust.unknowns import Chain

_DAMPING = 1e-7  # of the diagonal: what the observations leave open stays where it is
_GROSS_PX = 3.0


def polish(network: PoseNetwork, movable: set[int], views: Mapping[int, View], iterations: int = 6) -> None:
    """Move the movable poses to the minimum of the chains' misfit in px, robustly; nothing else changes.

    Source: pose-graph least squares with each measured pose weighted by the normal matrix of its image points, which is
    the bundle adjustment linearised at the measured poses. The caller's gauge poses are to be left out of ``movable``.
    """
    items = [
        o
        for o in network.observations
        if not o.rotation_only and not network.unknown_links(o.chain) and any(k.slot in movable for k in o.chain)
    ]
    column = {slot: i for i, slot in enumerate(sorted({k.slot for o in items for k in o.chain} & movable))}
    if not column:
        return
    roots = [_root_information(network, o, views.get(o.block_idx)) for o in items]
    best, best_cost = dict(network.known), np.inf
    scale = np.inf
    for _ in range(iterations + 1):
        rows = [_row(network, o, root, column) for o, root in zip(items, roots, strict=True)]
        size = np.array([np.linalg.norm(r) for r, _ in rows])
        # the scale may only shrink: far from the minimum everything counts, near it gross errors do not
        scale = min(scale, max(3.0 * float(np.median(size)), _GROSS_PX))
        cost = float(np.sum(np.log1p((size / scale) ** 2)) * scale**2)
        if not cost < best_cost * (1 - 1e-9):
            break
        best, best_cost = dict(network.known), cost
        _move(network, column, rows, 1.0 / (1.0 + (size / scale) ** 2))
    network.known.update(best)


def _root_information(network: PoseNetwork, observation: ChainObservation, view: View | None) -> FloatArray:
    """Square root (6, 6) of the information of the observed pose against a motion on its left, rms px."""
    if view is None:
        return np.diag([1.0] * 3 + [1.0 / network.lever] * 3) * 1000.0
    pose = observation.poses[0]
    p = view.x @ pose[:3, :3].T + pose[:3, 3]
    depth = np.maximum(np.sum(p * view.rays, axis=1), 1e-9)
    by_point = tangent_axes(view.rays) / depth[:, None, None]
    j = np.concatenate([-by_point @ skew(p), by_point], axis=2).reshape(-1, 6) * view.focal_px
    return np.asarray(np.linalg.qr(j / np.sqrt(len(p)), mode="r"))


def _row(
    network: PoseNetwork, observation: ChainObservation, root: FloatArray, column: Mapping[int, int]
) -> tuple[FloatArray, list[tuple[int, FloatArray]]]:
    """Residual (6,) and its derivatives (6, 6) by the movable poses, each moved on its right."""
    chain: Chain = observation.chain
    poses = [network.link_pose(link.slot, link.inverse) for link in chain]
    before, blocks = np.eye(4), []
    for link, pose in zip(chain, poses, strict=True):
        after = before @ pose
        if link.slot in column:
            blocks.append((column[link.slot], root @ (-_adjoint(before) if link.inverse else _adjoint(after))))
        before = after
    nearest = observation.poses[0]
    if len(observation.poses) > 1:
        nearest = observation.poses[int(np.argmin(pose_distance(observation.poses, before, network.lever)))]
    miss = before @ inverse(nearest)
    return root @ np.concatenate([rotation_log(miss[:3, :3]), miss[:3, 3]]), blocks


def _adjoint(pose: FloatArray) -> FloatArray:
    """Map (6, 6) of motions (turn, shift) from right of a pose to left of it."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = pose[:3, :3]
    out[3:, :3] = skew(pose[:3, 3]) @ pose[:3, :3]
    return out


def _move(
    network: PoseNetwork,
    column: Mapping[int, int],
    rows: list[tuple[FloatArray, list[tuple[int, FloatArray]]]],
    weights: FloatArray,
) -> None:
    """One damped Gauss-Newton step."""
    n = 6 * len(column)
    i6, j6 = np.repeat(np.arange(6), 6), np.tile(np.arange(6), 6)
    values, row_idx, column_idx = [], [], []
    right = np.zeros(n)
    for (residual, blocks), w in zip(rows, weights, strict=True):
        for a, by_a in blocks:
            right[6 * a : 6 * a + 6] += w * (by_a.T @ residual)
            for b, by_b in blocks:
                values.append((w * (by_a.T @ by_b)).ravel())
                row_idx.append(6 * a + i6)
                column_idx.append(6 * b + j6)
    entries = (np.concatenate(values), (np.concatenate(row_idx), np.concatenate(column_idx)))
    normal = csc_array(entries, shape=(n, n))
    diagonal = normal.diagonal()
    damp = csc_array((_DAMPING * diagonal + 1e-12 * diagonal.max(), (np.arange(n), np.arange(n))), shape=(n, n))
    step = -splu(csc_array(normal + damp)).solve(right)
    for slot, i in column.items():
        move = step[6 * i : 6 * i + 6]
        network.known[slot] = network.known[slot] @ rigid(rotation_exp(move[:3]), move[3:])
