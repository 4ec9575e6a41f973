"""What may be wrong with a survey: one cause, the one change that would mend it, and where a project says it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, fields, replace
from typing import Any, Literal, get_args

import numpy as np
from gtsam import Pose3, Rot3

from adjust.lenses.models import MODELS
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey


@frozen
class Place:
    """Where a mistake sits. kind: camera, station, table, target, point, image, reading, pair, epoch, group ...

    ids: of the thing, an image by camera and epoch. key: of ``survey.toml`` or a column of the table, where one is at
    fault. epochs: those concerned, all where empty.
    """

    kind: str
    ids: tuple[str, ...]
    key: str = ""
    epochs: tuple[str, ...] = ()


@frozen
class ScaleKey:
    """The number, or every number, at ``path`` of ``survey.toml`` is multiplied: ("targets", "board", "square_mm")."""

    path: tuple[str, ...]
    factor: float


@frozen
class SetKey:
    """The value at ``path`` of ``survey.toml`` becomes another: a number, a word, yes or no, a list of them.

    Of a list of numbers in place of one that is shorter (coordinates in a plane), the first ones.
    """

    path: tuple[str, ...]
    value: float | int | str | bool | tuple[str | float, ...]


@frozen(eq=False)
class ChangeColumns:
    """In the rows of a table where each column of ``where`` has one of its values: new = matrix @ old + offset.

    columns: k numeric columns, in the units in which they stand there; matrix: (k, k); offset: (k,).
    """

    table: str
    columns: tuple[str, ...]
    matrix: FloatArray
    offset: FloatArray
    where: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


@frozen
class Rename:
    """In the rows of a table where each column of ``where`` has one of its values: ids of a column become others."""

    table: str
    column: str
    names: Mapping[str, str]
    where: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


@frozen
class ExchangeColumns:
    """In the rows of a table where each column of ``where`` has one of its values: two columns trade their values."""

    table: str
    columns: tuple[str, str]
    where: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


@frozen
class ChangeReadings:
    """The values of readings or distances, by id: new = factor * old + offset (rad or m), each in its own unit.

    field: "sigma", "instrument_height" or the like: that quantity instead.
    """

    ids: tuple[str, ...]
    factor: float
    offset: float = 0.0
    table: str = "terrestrial"
    field: str = "value"


@frozen
class SetReadings:
    """A column of ``terrestrial.csv`` gets this word in the rows of some readings, by id."""

    ids: tuple[str, ...]
    column: str
    value: str
    table: str = "terrestrial"


@frozen
class LeaveOut:
    """Rows of ``exclusions.csv``, each as a person would name it: "image:Y/hY06", "epoch:t09", "pairs:p3"."""

    names: tuple[str, ...]


Edit = ScaleKey | SetKey | ChangeColumns | ExchangeColumns | ChangeReadings | SetReadings | Rename | LeaveOut
_EDITS: dict[str, Any] = {kind.__name__: kind for kind in get_args(Edit)}


def told_edit(edit: Edit) -> dict[str, Any]:
    """For machines: its kind, and its fields by name."""
    return {"edit": type(edit).__name__, **{f.name: getattr(edit, f.name) for f in fields(edit)}}


def edit_told(told: Mapping[str, Any]) -> Edit:
    """The edit that :func:`told_edit` tells, as JSON has it. KeyError, TypeError or ValueError for what is none."""
    values = {name: _tuples(value) for name, value in told.items() if name != "edit"}
    for name in ("matrix", "offset") if told["edit"] == ChangeColumns.__name__ else ():
        values[name] = np.array(values[name], dtype=float)
    edit: Edit = _EDITS[told["edit"]](**values)
    return edit


def _tuples(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _tuples(x) for name, x in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


@frozen(eq=False)
class Hypothesis:
    """One cause, and the survey as it would be without it.

    name: of the kind of cause ("images mirrored"), the same for every place. cause: what is wrong, a sentence about
    named things. change: what would mend it. survey: the survey with that one change, to be tried, or what makes it
    where that takes adjustments of its own. edits: the same as changes of a project, none where only a person can
    do it. evidence: how clearly cheap evidence speaks for it, a ratio of misfits or of sigmas; only the order of
    trials follows it. parameters: how many numbers of the change were chosen to fit (a cut's epoch, a factor).
    looked_at: how many such hypotheses were compared with each other, for the family-wise level. follow: what the
    adjustment tells more exactly, in place of this one: the same survey under its right name, or another one to be
    tried. penalty: what the change adds to minus twice the log likelihood beside v'Pv, where it changes variances: the
    sum of the logarithms of their factors. scored: the evidence is how many times less the misfit beyond noise becomes
    by the score at the solution. of_variances: nothing else is changed, so that the values there are as good a start as
    any. pair_sigmas: (n, 6) by what the sigmas of all pairs are multiplied, where that is all that is changed.
    """

    name: str
    cause: str
    change: str
    place: Place
    survey: Survey | Callable[[], Survey | None]
    edits: tuple[Edit, ...] = ()
    evidence: float = 1.0
    parameters: int = 1
    looked_at: int = 1
    follow: Callable[[Adjustment], Sequence["Hypothesis"]] | None = None
    penalty: float = 0.0
    scored: bool = False
    of_variances: bool = False
    pair_sigmas: FloatArray | None = None

    def told(self, words: Callable[[Adjustment], str]) -> "Hypothesis":
        """With its cause as the adjustment that shows it says it; as it stands where that has no words."""
        return replace(self, follow=lambda result: [replace(self, cause=said)] if (said := words(result)) else [])

    def changed(self) -> Survey | None:
        """The survey to be tried; None where the change turns out not to be possible."""
        return self.survey() if callable(self.survey) else self.survey


@frozen
class Finding:
    """One thing to mend or to measure, told before anything is adjusted.

    level: ``problem`` spoils or stops the adjustment, ``weak`` weakens it.

    kind: short and constant, for programs. ids: what it concerns. found: what is the matter. remedy: what to do.
    """

    level: Literal["problem", "weak"]
    kind: str
    ids: tuple[str, ...]
    found: str
    remedy: str


def motion_text(motion: Pose3) -> str:
    """By how many millimetres and degrees, in its own axes."""
    shift = ", ".join(f"{1e3 * v:.2f}" for v in motion.translation())
    angle = np.degrees(np.linalg.norm(Rot3.Logmap(motion.rotation())))
    return f"by ({shift}) mm and {angle:.3f} deg in its own axes"


def block_keys(survey: Survey, camera_id: str, names: Sequence[str], begins: Sequence[str]) -> tuple[Edit, ...]:
    """``lens.drift``: parameters in blocks that begin at these epochs; none where it is there, or none is free."""
    lens = survey.cameras_by_id[camera_id].lens
    changing = tuple(x for x in names if x in lens.free)
    if lens.drift is not None or not changing:
        return ()
    path = ("cameras", camera_id, "lens", "drift")
    return SetKey((*path, "parameters"), changing), SetKey((*path, "begins"), tuple(begins))


def crop_keys(
    survey: Survey, camera_id: str, epoch_id: str, scale: float = 1.0, shift: Sequence[float] | FloatArray = (0.0, 0.0)
) -> tuple[Edit, ...]:
    """``lens.crops``: from this epoch on images of another size, or whose points moved by ``shift`` px.

    None where images are cropped already, or the lens is in mm.
    """
    camera = survey.cameras_by_id[camera_id]
    if camera.lens.crops or MODELS[camera.lens.model].in_mm:
        return ()
    path = ("cameras", camera_id, "lens", "crops", epoch_id)
    resized = scale != 1.0
    values = {"scale": scale} if resized else {"left_px": -float(shift[0]), "top_px": -float(shift[1])}
    return (
        SetKey((*path, "free"), ("scale",) if resized else ("left", "top")),
        *(SetKey((*path, key), float(f"{value:.6g}")) for key, value in values.items()),
        SetKey((*path, "size_px"), tuple(round(scale * n) for n in camera.image_size)),
    )


def new_setup(survey: Survey, setup_id: str) -> str:
    """A name for a part of a set-up that nothing has yet."""
    known, number = {r.setup_id for r in survey.readings} | {s.setup_id for s in survey.setups}, 2
    while f"{setup_id}-{number}" in known:
        number += 1
    return f"{setup_id}-{number}"


def split_setup(survey: Survey, setup_id: str, late: Sequence[str]) -> tuple[Edit, ...]:
    """These directions as those of a set-up of their own with the same instrument; none where more is said of it."""
    given, name = next((s for s in survey.setups if s.setup_id == setup_id), None), new_setup(survey, setup_id)
    if given is not None and (given.centring_sigma or given.height_sigma or not given.levelled):
        return ()
    instrument = None if given is None else given.instrument_id
    key, value = ("levelled", True) if instrument is None else ("instrument", instrument)  # it is listed by one of them
    return SetReadings(tuple(late), "setup_id", name), SetKey(("setups", name, key), value)


def found_by(keys: Sequence[Edit], change: str) -> str:
    """What is to be changed, where the adjustment finds it by keys of one table of ``survey.toml`` as well."""
    table = next((".".join(key.path[:-1]) for key in keys if isinstance(key, SetKey)), "")
    return f"let the adjustment find it: {table}; or {change}" if table else change
