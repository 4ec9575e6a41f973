"""Two unknown poses at once, from the known motion between them: the hand-eye and robot-world problems."""

from dataclasses import dataclass

import numpy as np

from adjust.closed_forms import inverse, relative_motions, rotation_log, solve_ax_xb, solve_ax_zb
from adjust.errors import SurveyError
from adjust.initial.network import PoseNetwork
from adjust.model import FloatArray
from adjust.result import ParameterName


@dataclass(frozen=True, eq=False)
class _Group:
    """Observations ``first * motions[i] * second = products[i]`` with both ends unknown; a link is (slot, inverse)."""

    first: tuple[int, bool]
    second: tuple[int, bool]
    motions: FloatArray
    products: FloatArray

    def spread(self) -> float:
        """Second singular value of the turns: how well two axes are given, rad."""
        if len(self.motions) < 3:
            return 0.0
        turns = rotation_log(np.swapaxes(self.motions[:1, :3, :3], -1, -2) @ self.motions[1:, :3, :3])
        return float(np.linalg.svd(turns, compute_uv=False)[1])

    def swapped(self) -> "_Group":
        """The same the other way round, so that each unknown comes second once."""
        (a, a_inverse), (b, b_inverse) = self.first, self.second
        return _Group((b, not b_inverse), (a, not a_inverse), inverse(self.motions), inverse(self.products))


def solve_motion(network: PoseNetwork) -> str | None:
    """Find what two unknowns and the motion between them determine; a note on what was done, or None.

    Robot-world closed form where a group of observations turns about two axes; else hand-eye from the motions of all
    groups that share an unknown; with all turns about one axis the smallest of the consistent solutions is taken, since
    a start need only be consistent.
    """
    groups = _groups(network)
    if not groups:
        return None
    for group in sorted(groups, key=lambda g: -g.spread()):
        try:
            second, first, _ = solve_ax_zb(group.motions, group.products)
        except SurveyError:
            continue
        _set(network, group.second, second)
        _set(network, group.first, inverse(first))
        return f"{_text(network, group.first)} and {_text(network, group.second)} from {len(group.motions)} motions"
    return _shared(network, groups)


def _shared(network: PoseNetwork, groups: list[_Group]) -> str | None:
    """Hand-eye over all groups with the same unknown; the degenerate solution only where no unknown has a better."""
    by_second: dict[tuple[int, bool], list[_Group]] = {}
    for group in groups + [g.swapped() for g in groups]:
        if len(group.motions) >= 2:
            by_second.setdefault(group.second, []).append(group)
    for minimum_norm in (False, True):
        for link, sharing in sorted(by_second.items(), key=lambda item: item[0]):
            a, b = (
                np.concatenate(m) for m in zip(*[relative_motions(g.motions, g.products) for g in sharing], strict=True)
            )
            try:
                x, _ = solve_ax_xb(a, b, minimum_norm)
            except SurveyError:
                continue
            _set(network, link, x)
            how = "turns about one axis only: smallest consistent solution" if minimum_norm else f"{len(a)} motions"
            return f"{_text(network, link)} from {how}"
    return None


def _groups(network: PoseNetwork) -> list[_Group]:
    found: dict[tuple[tuple[int, bool], tuple[int, bool]], list[tuple[FloatArray, FloatArray, bool]]] = {}
    for observation in network.observations:
        chain = observation.chain
        missing = network.unknown_links(chain)
        if len(missing) != 2 or observation.rotation_only:
            continue
        i, j = missing
        motion = network.product(chain[i + 1 : j])
        outer = inverse(network.product(chain[:i])), inverse(network.product(chain[j + 1 :]))
        key = ((chain[i].slot, chain[i].inverse), (chain[j].slot, chain[j].inverse))
        product = outer[0] @ observation.poses[0] @ outer[1]
        found.setdefault(key, []).append((motion, product, len(observation.poses) == 1))
    groups = []
    for (first, second), rows in sorted(found.items()):
        clear = [r for r in rows if r[2]]
        # views with two near-equal poses only where the clear ones do not suffice
        rows = clear if len(clear) >= max(4, len(rows) // 3) else rows
        groups.append(_Group(first, second, np.array([r[0] for r in rows]), np.array([r[1] for r in rows])))
    return groups


def _set(network: PoseNetwork, link: tuple[int, bool], value: FloatArray) -> None:
    slot, inverted = link
    network.known[slot] = inverse(value) if inverted else value


def _text(network: PoseNetwork, link: tuple[int, bool]) -> str:
    name: ParameterName = network.names[link[0]]
    return " ".join(name)
