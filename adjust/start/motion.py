"""Two unknown poses at once, from the known motion between them: the hand-eye and robot-world problems."""


import numpy as np
from scipy.sparse import coo_array

from adjust.frames.unknowns import Chain, Link
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.names import grouped
from adjust.model.survey import FloatArray, IntArray
from adjust.spatial.averaging import pose_distance
from adjust.spatial.rigid import inverse, rotation_log
from adjust.start.chains import ChainObservation
from adjust.start.closed_forms.hand_eye import relative_motions, solve_ax_xb, solve_ax_zb, solve_views
from adjust.start.network import FrameNetwork

_CHOICES = 4
_CLEAR_TURNS = np.deg2rad(20.0)
"""Spread of turns below which the errors of a few views count for much in what they determine."""


@frozen(eq=False)
class _Group:
    """Observations ``first * motions[i] * second = products[i]`` with both ends unknown."""

    first: Link
    second: Link
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
        return _Group(self.second.back, self.first.back, inverse(self.motions), inverse(self.products))


def solve_motion(network: FrameNetwork, degenerate: bool = True) -> str | None:
    """Find what two unknowns and the motion between them determine; a note on what was done, or None.

    Robot-world closed form where a group of observations turns about two axes (where it hardly does, two cameras on one
    body first, as below); else hand-eye from the motions of all groups that share an unknown; else all views together,
    where what a chain lacks on either side may be several poses in a row. Where ``degenerate`` motions will do: two
    cameras on one body, each before targets of its own, from how the body moved between its epochs; with all turns
    about one axis the smallest of the consistent solutions, since a start need only be consistent.
    """
    found = _rows_of_poses(network)
    groups = sorted(_groups(found), key=lambda g: -g.spread())
    if groups and groups[0].spread() < _CLEAR_TURNS and (note := _side_by_side(network)) is not None:
        return note
    for group in groups:
        try:
            second, first, _ = solve_ax_zb(group.motions, group.products)
        except SurveyError:
            continue
        network.set_link(group.second, second)
        network.set_link(group.first, inverse(first))
        return f"{_text(network, group.first)} and {_text(network, group.second)} from {len(group.motions)} motions"
    note = _shared(network, groups, False) or _together(network, found)
    if note is not None or not degenerate:
        return note
    return _side_by_side(network) or _shared(network, groups, True)


def _shared(network: FrameNetwork, groups: list[_Group], minimum_norm: bool) -> str | None:
    """Hand-eye over all groups with the same unknown; also from turns about one axis with ``minimum_norm``."""
    by_second = grouped((g.second, g) for g in groups + [g.swapped() for g in groups] if len(g.motions) >= 2)
    for link, sharing in sorted(by_second.items(), key=lambda item: item[0]):
        found = _hand_eye([relative_motions(g.motions, g.products) for g in sharing], minimum_norm)
        if found is not None:
            network.set_link(link, found[0])
            how = "turns about one axis only: smallest consistent solution" if minimum_norm else f"{found[1]} motions"
            return f"{_text(network, link)} from {how}"
    return None


def _hand_eye(
    motions: list[tuple[FloatArray, FloatArray]], minimum_norm: bool = False
) -> tuple[FloatArray, int] | None:
    """``x`` (4, 4) with a x = x b for all these motions, and how many there are; None where they do not tell it."""
    a, b = (np.concatenate(m) for m in zip(*motions, strict=True))
    try:
        return solve_ax_xb(a, b, minimum_norm)[0], len(a)
    except SurveyError:
        return None


def _side_by_side(network: FrameNetwork) -> str | None:
    """A pose on a moving body from another that is known there: both see the same motions, whatever they look at.

    With ``C_i S_e G_a`` seen of the body's pose S in every epoch e, ``C_i S_e S_f^-1 C_i^-1`` knows nothing of thing a;
    nor does that of j before b, in the same epochs: hand-eye for ``C_i C_j^-1`` over all that either looks at.
    """
    seen: dict[int, list[tuple[Chain, Chain, FloatArray]]] = {}
    for o in network.observations:
        moving = [i for i, link in enumerate(o.chain) if network.names[link.slot][0] == "world_from_station"]
        if len(moving) == 1 and 0 < moving[0] < len(o.chain) - 1 and not o.rotation_only:
            at = moving[0]
            seen.setdefault(o.chain[at].slot, []).append((o.chain[:at], o.chain[at + 1 :], o.poses[0]))
    alike: dict[tuple[Chain, Chain], dict[tuple[Chain, Chain], list[tuple[FloatArray, FloatArray]]]] = {}
    for views in seen.values():
        for before, after, pose in views:
            for other, behind, another in views:
                if not network.open_slots(before) and len(other) == 1 and network.open_slots(other):
                    alike.setdefault((before, other), {}).setdefault((after, behind), []).append((pose, another))
    for (before, other), by_things in sorted(alike.items(), key=lambda item: -sum(map(len, item[1].values()))):
        several = [np.array(both) for both in by_things.values() if len(both) >= 2]
        if not several:
            continue
        found = _hand_eye([relative_motions(inverse(both[:, 0]), inverse(both[:, 1])) for both in several])
        if found is not None:
            network.set_link(other[0], inverse(found[0]) @ network.product(before))
            return f"{_text(network, other[0])} from {found[1]} motions of two on one body"
    return None


@frozen(eq=False)
class _RowsOfPoses:
    """Chains ``before * first * motion * second * after`` that lack a row of poses on either side of a motion.

    first, second: (n,) positions in ``rows``, each the links of such a row in order. products:
    per chain the alternatives (k, 4, 4) of ``first * motion * second``, likeliest first.
    """

    rows: list[Chain]
    first: list[int]
    second: list[int]
    motions: FloatArray
    products: list[FloatArray]


def _together(network: FrameNetwork, every: _RowsOfPoses) -> str | None:
    """Everything on what moves and everything around it at once; a note, or None where that determines nothing."""
    for found in _connected(every):
        first, inside = np.unique(found.first, return_inverse=True)
        second, outside = np.unique(found.second, return_inverse=True)
        alone = [(i, 0) for i in first if len(found.rows[i]) == 1]
        alone += [(i, 1) for i in second if len(found.rows[i]) == 1]
        solved = _solved_views(found, inside, outside, network.lever) if alone else None
        if solved is None:
            continue
        for i, side in alone:
            pose = inverse(solved[0][list(first).index(i)]) if side == 0 else solved[1][list(second).index(i)]
            network.set_link(found.rows[i][0], pose)
        names = " and ".join(_text(network, found.rows[i][0]) for i, _ in alone)
        return f"{names} from {len(found.motions)} views of {len(second)} things by {len(first)} together"
    return None


def _solved_views(
    found: _RowsOfPoses, inside: IntArray, outside: IntArray, lever: float
) -> tuple[FloatArray, FloatArray] | None:
    """The poses on the moving side and around it, from the alternatives that agree with all others."""
    chosen = np.array([p[0] for p in found.products])
    back = inverse(found.motions)
    try:
        for _ in range(_CHOICES):
            x, z, _ = solve_views(back, chosen, inside, outside)
            said = inverse(x)[inside] @ found.motions @ z[outside]
            nearest = [int(np.argmin(pose_distance(p, s, lever))) for p, s in zip(found.products, said, strict=True)]
            again = np.array([p[i] for p, i in zip(found.products, nearest, strict=True)])
            if np.array_equal(again, chosen):
                break
            chosen = again
    except SurveyError:
        return None
    return x, z


def _rows_of_poses(network: FrameNetwork) -> _RowsOfPoses:
    rows: dict[Chain, int] = {}
    split = [(o, ends) for o in network.observations if (ends := _split(network, o)) is not None]
    numbers = [rows.setdefault(o.chain[a:b], len(rows)) for o, ends in split for a, b in ends]
    motions = network.products([o.chain[ends[0][1] : ends[1][0]] for o, ends in split])
    before = inverse(network.products([o.chain[: ends[0][0]] for o, ends in split]))
    after = inverse(network.products([o.chain[ends[1][1] :] for o, ends in split]))
    products = [x @ o.poses @ y for (o, _), x, y in zip(split, before, after, strict=True)]
    return _RowsOfPoses(list(rows), numbers[::2], numbers[1::2], motions, products)


def _split(network: FrameNetwork, observation: ChainObservation) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """Begin and end of the two rows of unknown poses in a chain, with something known between them; None if other."""
    missing = network.unknown_links(observation.chain)
    gaps = [i for i in range(1, len(missing)) if missing[i] > missing[i - 1] + 1]
    if observation.rotation_only or len(gaps) != 1:
        return None
    at = gaps[0]
    return (missing[0], missing[at - 1] + 1), (missing[at], missing[-1] + 1)


def _connected(found: _RowsOfPoses) -> list[_RowsOfPoses]:
    """Its parts that share no row of poses, largest first."""
    if not found.first:
        return []
    from scipy.sparse.csgraph import connected_components  # here: a survey of readings starts without it

    n = len(found.rows)
    joined = coo_array((np.ones(len(found.first)), (found.first, found.second)), shape=(n, n))
    label = connected_components(joined, directed=False)[1]
    of_view = label[np.array(found.first, dtype=np.int64)]
    parts = []
    for part in sorted(set(of_view.tolist()), key=lambda p: -int((of_view == p).sum())):
        mine = np.flatnonzero(of_view == part)
        parts.append(_RowsOfPoses(
            found.rows, [found.first[i] for i in mine], [found.second[i] for i in mine], found.motions[mine],
            [found.products[i] for i in mine],
        ))  # fmt: skip
    return parts


def _groups(found: _RowsOfPoses) -> list[_Group]:
    """Chains that lack the same two single poses, together."""
    ends = [(found.rows[a], found.rows[b]) for a, b in zip(found.first, found.second, strict=True)]
    alike = grouped(((a[0], b[0]), i) for i, (a, b) in enumerate(ends) if len(a) == len(b) == 1)
    groups = []
    for (a, b), mine in sorted(alike.items()):
        clear = [i for i in mine if len(found.products[i]) == 1]
        # views with two near-equal poses only where the clear ones do not suffice
        mine = clear if len(clear) >= max(4, len(mine) // 3) else mine
        groups.append(_Group(a, b, found.motions[mine], np.array([found.products[i][0] for i in mine])))
    return groups


def _text(network: FrameNetwork, link: Link) -> str:
    return " ".join(network.names[link.slot])
