"""What no observation can tell: where a frame lies that only unknown poses reach. One is set, the rest follow."""

from typing import TypeVar

from adjust.model.result import ParameterName
from adjust.model.survey import Survey
from adjust.start.chains import ChainObservation
from adjust.start.network import IDENTITY, FrameNetwork, partial_pose

Node = tuple[str, ...]
End = tuple[int, bool]  # a slot and its side: False the frame on the left of its name, True the one on the right
_BOUND: End = (-1, False)
_POINTS: End = (-2, False)
_T = TypeVar("_T")


class _Classes:
    """Union-find over slot ends that a chain joins, with the known slots it passes in between."""

    def __init__(self) -> None:
        self.parent: dict[End, End] = {}
        self.between: dict[End, set[int]] = {}

    def join(self, a: End, b: End, known: list[int]) -> None:
        a, b = sorted((found(self.parent, a), found(self.parent, b)))
        self.parent[b] = a
        passed = self.between.pop(b, set())
        self.between.setdefault(a, set()).update(passed, known)


def found(parent: dict[_T, _T], member: _T) -> _T:
    """The member that stands for the class of another, which is its own where it is new."""
    root = parent.setdefault(member, member)
    while parent[root] != root:
        root = parent[root]
    parent[member] = root
    return root


def fix_one_gauge(network: FrameNetwork, observations: list[ChainObservation]) -> int | None:
    """Set one pose of one frame that floats, at identity or at the mean of its incomplete prior; its slot, or None.

    Source: a transformation of a frame's coordinates changes every pose that leads to it and no observation, so the
    start may choose it. Ends of unknown poses between which chains pass by known poses belong to one such frame, unless
    an observation ends there, or the known poses between form a ring (as a turning table does): then it is observable.
    """
    classes = _Classes()
    for observation in observations:
        _join_chain(classes, network, observation)
    members: dict[End, set[End]] = {}
    for end in list(classes.parent):
        members.setdefault(found(classes.parent, end), set()).add(end)
    free = []
    for root, ends in members.items():
        slots = sorted({slot for slot, _ in ends if slot >= 0})
        bound = _BOUND in ends
        if slots and not bound and not _has_ring(network, classes.between.get(root, set())):
            free += [(_rank(network, slot), slot) for slot in slots]
    if not free:
        return None
    slot = min(free)[1]
    value = partial_pose(network.parameters.get(network.names[slot]))
    network.set(slot, IDENTITY if value is None else value)
    network.gauged.append(slot)
    return slot


def _join_chain(classes: _Classes, network: FrameNetwork, observation: ChainObservation) -> None:
    previous: End = _BOUND if observation.ends[0] else _POINTS
    known: list[int] = []
    open_links = network.unknown_links(observation.chain)
    if not open_links:  # an image with a known pose binds the points that it sees
        classes.join(previous, _BOUND if observation.ends[1] else _POINTS, [])
        return
    for i, link in enumerate(observation.chain):
        if i not in open_links:
            known.append(link.slot)
            continue
        # a_from_b taken forwards is entered from a
        classes.join(previous, (link.slot, link.inverse), known)
        previous, known = (link.slot, not link.inverse), []
    classes.join(previous, _BOUND if observation.ends[1] else _POINTS, known)


def _has_ring(network: FrameNetwork, slots: set[int]) -> bool:
    parent: dict[Node, Node] = {}
    for slot in sorted(slots):
        left, right = (found(parent, node) for node in frames_of(network, network.names[slot]))
        if left == right:
            return True
        parent[left] = right
    return False


def frames_of(network: FrameNetwork, name: ParameterName) -> tuple[Node, Node]:
    """The frames on the left and on the right of a pose's name."""
    kind, owner = name[0], name[1]
    frames = network.frames
    if kind == "station_from_camera":
        return ("station", frames.cameras[owner].station_id), ("camera", owner)
    if kind == "world_from_station":
        return ("world",), ("station", owner)
    if kind == "mount_from_station":
        return ("mount", frames.stations[owner].table_id or ""), ("station", owner)
    if kind == "world_from_table":
        return ("world",), ("table", owner)
    if kind == "table_motion":
        return ("table", owner), ("mount", owner)
    carrier = frames.targets[owner].station_id
    return ("world",) if carrier is None else ("station", carrier), ("target", owner)


def _rank(network: FrameNetwork, slot: int) -> int:
    """What is set first: a pose with some prior, a fixed target in the world, the mount, a fixed station, a camera."""
    name = network.names[slot]
    if partial_pose(network.parameters.get(name)) is not None:
        return 0
    if name[0] == "carrier_from_target" and network.frames.targets[name[1]].station_id is None and len(name) == 2:
        return 1
    order = {"mount_from_station": 2, "world_from_station": 3, "station_from_camera": 4, "world_from_table": 5}
    return order.get(name[0], 6) + (3 if len(name) == 3 else 0)


def world_is_free(network: FrameNetwork, survey: Survey) -> bool:
    """Whether nothing given holds the world, so that it may still be moved as a whole."""
    touching = [s for s, name in enumerate(network.names) if ("world",) in frames_of(network, name)]
    held = bool(network.fixed[touching].any())
    return not held and not any(p.x_in_world.value is not None for p in survey.points)
