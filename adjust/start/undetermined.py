"""What is left without a value, by name, and what is missing."""

from adjust.model.result import ParameterName
from adjust.model.survey import Survey
from adjust.start.network import FrameNetwork
from adjust.start.points import PointField


def undetermined(survey: Survey, network: FrameNetwork, points: PointField) -> str:
    """One line for each pose and point without a value; empty where there is none."""
    lines = [
        f"{' '.join(name)}: {_missing_pose(network, points, name, slot)}"
        for slot, name in sorted(network.names.items())
        if slot not in network.known
    ]
    needed = ~points.known
    lines += [
        f"point {p.point_id}: {_missing_point(network, points, i)}" for i, p in enumerate(survey.points) if needed[i]
    ]
    if not lines:
        return ""
    shown = lines[:20] + ([f"... and {len(lines) - 20} more"] if len(lines) > 20 else [])
    return "no start value can be found for " + str(len(lines)) + " parameter(s):\n  " + "\n  ".join(shown)


def _missing_pose(network: FrameNetwork, points: PointField, name: ParameterName, slot: int) -> str:
    seen = [o for o in network.observations if any(link.slot == slot for link in o.chain)]
    if seen:
        others = sorted(
            {" ".join(network.names[o.chain[i].slot]) for o in seen for i in network.unknown_links(o.chain)}
        )
        together = ", ".join(o for o in others if o != " ".join(name)) or "itself only"
        return (
            f"{len(seen)} observation(s) reach it, but only together with {together}, also unknown; hold or measure one"
            " of them, or add images that connect it"
        )
    sights = [s for s in points.sights if any(link.slot == slot for link in s.chain)]
    if sights:
        most = max(int(points.known[s.rows].sum()) for s in sights)
        return (
            f"no target and at most {most} known point(s) in one image (3 needed, 4 for a single solution);"
            " give coordinates of more points, or show it a target"
        )
    epoch = f" in epoch {name[2]!r}" if len(name) == 3 else " in any epoch"
    if name[0] == "station_from_camera":
        return f"camera {name[1]!r} sees no target and no known point{epoch}; add images or give its pose"
    return f"no trusted image or pair reaches it{epoch}; add an observation or give its pose"


def _missing_point(network: FrameNetwork, points: PointField, row: int) -> str:
    seen = [s for s in points.sights if row in s.rows]
    if not seen:
        return "no image shows it and it has no coordinates; give them, or take it out of the survey"
    ready = sum(not network.unknown_links(s.chain) for s in seen)
    return (
        f"seen in {len(seen)} image(s), {ready} of them from a known pose; two from different directions are needed:"
        " add images, or give its coordinates"
    )
