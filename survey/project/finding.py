"""The names of observations as people write them, and what to say of a name that nothing has."""

from collections.abc import Iterable

from adjust.model.errors import SurveyError, listed
from adjust.model.observations import ImageBlock, position_text
from survey.folder.text import suggestion
from survey.project.exclusions import WHAT, Name, name_problem
from survey.project.observed import CALLED, Observed
from survey.project.tables.kinds import KINDS


def known(observed: Observed, what: str) -> list[str]:
    """Ids that there are of a kind; for messages."""
    blocks, world = observed.survey.image_blocks, observed.points[None]
    targets = {t: points for t, points in observed.points.items() if t is not None}
    if what == "reading":
        return list(observed.readings)
    if what == "image_point":
        return [f"{b.camera_id}/{b.epoch_id}/{f'{b.target_id}/' if b.target_id else ''}{p}"
                for b in blocks for p in _names_in(observed, b)]  # fmt: skip
    places = [*((b.camera_id, b.epoch_id) for b in blocks), *((s.camera_id, s.epoch_id) for s in observed.spots)]
    found: dict[str, Iterable[str]] = {
        "image": (f"{c}/{e}" for c, e in places),
        "target": (*targets, *(f"{b.camera_id}/{b.epoch_id}/{b.target_id}" for b in blocks if b.target_id)),
        "point": (*world, *(f"{t}/{p}" for t, points in targets.items() for p in points)),
        "epoch": (*(e for _, e in places), *(r.epoch_id for r in observed.survey.table_readings)),
        "camera": (c.camera_id for c in observed.survey.cameras),
        "spot": (f"{s.camera_id}/{s.epoch_id}/{one}" for s in observed.spots for one in s.spot_ids),
    }
    return list(dict.fromkeys(found[what]))


def _names_in(observed: Observed, block: ImageBlock) -> list[str]:
    names = list(observed.points[block.target_id])
    return [names[int(i)] for i in block.point_idx]


def near(observed: Observed, name: Name) -> str:
    """What to do about a name that means nothing: the nearest that does."""
    there = known(observed, name.what)
    if name.what == "image_point":  # of the same image or point first: there are too many to compare
        parts = name.id.split("/")
        there = [k for k in there if k.split("/")[:2] == parts[:2] or k.split("/")[-1] == parts[-1]][:2000]
    return suggestion(name.id, there)


def find(observed: Observed, text: str) -> Name:
    """The name that a person means: with its kind (``image:X/h05``), as reports call it, or bare where one fits.

    A reading goes before a point, an epoch before the readings of a table at that epoch. Raises SurveyError for
    what is unknown or may mean several things.
    """
    prefix, colon, rest = text.partition(":")
    # the first group in which any name means something counts
    groups = ([Name("reading", text)], _with_kind(prefix, rest) if colon else [], *_bare(observed, text))
    names = next((names for group in groups if (names := [n for n in group if observed.hits(n)])), [])
    if len(names) == 1:
        return names[0]
    if names:
        raise SurveyError(f"{text!r} stands for {' and '.join(map(str, names[:6]))}"
                          f"{' and more' if len(names) > 6 else ''}; name one of them so")  # fmt: skip
    raise SurveyError(f"nothing that was observed has the name {text!r}; {_meant(observed, prefix, colon, rest, text)}")


def _with_kind(prefix: str, rest: str) -> list[Name]:
    if prefix == "reading":
        return [Name("reading", rest)]
    if prefix in WHAT:
        return [Name(prefix, rest)] if name_problem(prefix, rest) is None else []
    kind = CALLED.get(prefix)
    return [] if kind is None else [Name("reading", f"{kind.layout.name}:{rest}")]


def _bare(observed: Observed, text: str) -> tuple[list[Name], ...]:
    """Groups of names that a bare text may stand for."""
    named = (f"{kind.layout.name}:{text}" for kind in KINDS)
    readings = [Name("reading", name) for name in named if name in observed.readings]
    n = text.count("/") + 1
    if n > 1:
        shapes = {2: ("image", "point"), 3: ("image_point", "target", "spot"), 4: ("image_point",)}.get(n, ())
        return readings, [Name(what, text) for what in shapes]
    wide = [Name(what, text) for what in ("epoch", "camera", "target")]
    points = [
        Name("point", f"{t}/{text}" if t else text)
        for t, there in sorted(observed.points.items(), key=lambda item: item[0] is not None)
        if text in there
    ]
    return readings, wide, points


def _meant(observed: Observed, prefix: str, colon: str, rest: str, text: str) -> str:
    station = f"station:{text.removeprefix('station:')}"
    pairs = [f"pairs:{p.pair_id}" for p in observed.survey.pairs if station in (p.a.text, p.b.text)]
    if pairs:
        return f"a station goes with all that was measured from it: name {listed(pairs, 8, ' ')}"
    if colon and (named := _with_kind(prefix, rest)):
        if named[0].what != "reading":
            return near(observed, named[0])
        table = named[0].id.partition(":")[0]
        return suggestion(rest, (k.partition(":")[2] for k in observed.readings if k.startswith(f"{table}:")))
    if colon and prefix in WHAT:
        return str(name_problem(prefix, rest)).removeprefix("id: ")
    bare = [k.partition(":")[2] for k in observed.readings]
    for what in ("epoch", "camera", "target", "image", "point"):
        bare += known(observed, what)
    bare += [p for target, points in observed.points.items() if target for p in points]
    return suggestion(text, bare)


def by_member(observed: Observed, text: str) -> str | None:
    """The set of coordinates to which a position belongs that is no observation by itself; None for others."""
    name = text.removeprefix("coordinates:")
    for item in observed.survey.coordinates:
        if item.set_id and name in map(position_text, item.positions):
            return str(item.set_id)
    return None
