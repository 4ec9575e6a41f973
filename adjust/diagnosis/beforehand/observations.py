"""Names that appear once, points that nothing checks, epochs that join nothing."""

from collections import Counter
from collections.abc import Iterator, Mapping

from adjust.diagnosis.hypothesis import Finding
from adjust.diagnosis.table.unseen import unseen_readings
from adjust.model.errors import listed
from adjust.model.names import grouped
from adjust.model.observations import CoordinateDifferences, Coordinates
from adjust.model.result import Adjustment
from adjust.model.subsets import positions_of
from adjust.model.survey import Survey


def observed(survey: Survey, expected: Adjustment | None) -> Iterator[Finding]:
    """All of them. expected: precision at the start values, where there is one."""
    used = _usage(survey)
    yield from _lonely_ids(survey, used)
    yield from _lonely_targets(survey)
    yield from _points(survey, used, expected)
    yield from _epochs(survey)


def _usage(survey: Survey) -> Counter[str]:
    """How many observed components world points have, by id: two for an image point, three for coordinates."""
    out: Counter[str] = Counter()
    for block in survey.image_blocks:
        for i in block.point_idx[block.mask].tolist() if block.target_id is None else ():
            out[survey.points[i].point_id] += 2
    for o in (o for kind in survey.others.values() for o in kind if o.used):
        for ref in (ref for ref in positions_of(o) if ref.frame is None):
            out[str(ref.point_id)] += 3 if isinstance(o, Coordinates | CoordinateDifferences) else 1
    return out


def _lonely_ids(survey: Survey, used: Mapping[str, int]) -> Iterator[Finding]:
    """Free points that a single sight names: often a name typed wrongly."""
    sights: Counter[str] = Counter()
    for r in survey.readings:
        sights.update({str(x.point_id) for x in positions_of(r) if x.frame is None})
    for b in survey.image_blocks:
        if b.target_id is None:
            sights.update(survey.points[i].point_id for i in b.point_idx.tolist())
    for p in survey.points:
        if p.x_in_world.treatment == "free" and sights[p.point_id] == 1 and used.get(p.point_id, 0) <= 2:
            yield Finding("problem", "id appears once", (p.point_id,), f"point {p.point_id} is observed a single time",
                          "look for a name typed wrongly, or observe it from another place")  # fmt: skip


def _lonely_targets(survey: Survey) -> Iterator[Finding]:
    """Targets at a place of their own that a single image shows: nothing is gained by them, or their name is wrong."""
    sights = Counter(b.target_id for b in survey.image_blocks if b.n_used)
    named = {r.frame.frame_id for d in survey.distances for r in positions_of(d) if r.frame is not None}
    named |= {r.frame_id for p in survey.pairs for r in (p.a, p.b)} | {s.target_id for s in survey.laser_spots}
    named |= {x.frame.frame_id for x in survey.levels} | {r.frame_id for x in survey.alignments for r in (x.a, x.b)}
    for t in survey.targets:
        free = t.motion == "fixed" and t.carrier_from_target.treatment == "free"
        if free and sights[t.target_id] == 1 and t.target_id not in named and len(survey.targets) > 1:
            yield Finding("weak", "id appears once", (t.target_id,), f"target {t.target_id} is in a single image",
                          "look for a name typed wrongly, or take images that show it with others")  # fmt: skip


def _points(survey: Survey, used: Mapping[str, int], expected: Adjustment | None) -> Iterator[Finding]:
    """Points with no more components than unknowns: a gross error there cannot be found."""
    bare = [p.point_id for p in survey.points if p.x_in_world.treatment == "free"
            and 0 < used.get(p.point_id, 0) <= 3 - len(p.x_in_world.held)]  # fmt: skip
    if bare and expected is not None:
        yield Finding("weak", "no redundancy", tuple(bare), f"points without redundancy: {listed(bare, 6)}",
                      "observe each once more, best from another direction: an error there shows nowhere")  # fmt: skip


def _epochs(survey: Survey) -> Iterator[Finding]:
    """Epochs that join nothing: one camera alone sees something that is there at this epoch alone."""
    movers = {s.station_id for s in survey.stations if s.motion == "epoch"}
    hand_held = {t.target_id for t in survey.targets if t.motion == "epoch"}
    station_of = {c.camera_id: c.station_id for c in survey.cameras}
    seen = grouped((b.epoch_id, b) for b in survey.image_blocks)
    loose = {e for e, of in seen.items()
             if all(b.target_id in hand_held or station_of[b.camera_id] in movers for b in of)}  # fmt: skip
    tied = {r.epoch_id for p in survey.pairs for r in (p.a, p.b)}
    lonely = [e for e, of in seen.items() if e in loose - tied and len({b.camera_id for b in of}) == 1]
    cameras = {b.camera_id for b in survey.image_blocks}
    rig = len({station_of[c] for c in cameras}) < len(cameras)
    if rig and lonely and len(lonely) > 0.5 * len(seen):
        yield Finding("weak", "epochs without partners", tuple(lonely),
                      f"{len(lonely)} of {len(seen)} epochs are seen by one camera alone: {listed(lonely, 6)}",
                      "they join no cameras; check the names of files, or take epochs that two see")  # fmt: skip
    yield from unseen_readings(survey)
