"""Cameras that never saw a hand-held target at the same moment, as far as the names of their images say."""

import itertools

from adjust.model.survey import Survey


def separate_epochs(survey: Survey) -> tuple[str, ...]:
    """For people: pairs of cameras of one station that share no epoch although only moving targets join them."""
    moving = {t.target_id for t in survey.targets if t.motion == "epoch"}
    seen: dict[str, set[tuple[str, str]]] = {}
    joined = set()
    for block in survey.image_blocks:
        if block.target_id in moving:
            seen.setdefault(block.camera_id, set()).add((str(block.target_id), block.epoch_id))
        else:
            joined.add(block.camera_id)  # a fixed target or beacons join it to others at any epoch
    station = {c.camera_id: c.station_id for c in survey.cameras}
    found = []
    for a, b in itertools.combinations((c for c in seen if c not in joined), 2):
        if station[a] == station[b] and not seen[a] & seen[b]:
            names = ", ".join(repr(sorted(epoch for _, epoch in seen[c])[0]) for c in (a, b))
            found.append(
                f"cameras {a} and {b} share no epoch (the first are {names}): give images of one moment the same "
                "name, images/<camera_id>/<epoch_id>.png, and detect again"
            )
    return tuple(found)
