"""All observations of a project row by row, also those that take no part, joined with a solution.

The rows are those of the observations, never those of a result: what is left out altogether can still be seen and taken
back.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from io import BytesIO
from typing import Any

import numpy as np
import numpy.typing as npt

from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef, ImageBlock, frame_text, position_text
from adjust.model.result import Adjustment, ObservationResidual
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from survey.folder.plain import plain
from survey.project.observed import Hits, Observed, name_of_residual
from survey.solution.quantities import sigma_unit_for_people, unit_for_people
from survey.workbench.places import refs_of

IN_USE, BY_FILE, BY_PEOPLE, BY_THIS_RUN = 0, 1, 2, 3
"""Why an image point takes no part: it does, a table says used = false, exclusions.csv does, this run left it out."""
_Key = tuple[str, str, str | None]
_MOST_SIGMAS = 300_000  # rows: a page of more does without the sigmas of places


@frozen(eq=False)
class PointRows:
    """N image points in the order of ``survey.image_blocks``, with what the solution says of them.

    survey: all observations as the tables have them, spots that have got a name behind them. now: the same with what
    people left out. residuals (N, 2) px, predicted minus observed; test (N,), chi-square with two degrees of freedom;
    redundancy (N, 2): nan where nothing is predicted. used (N,): in the solution.
    """

    survey: Survey
    now: Survey
    residuals: FloatArray
    test: FloatArray
    redundancy: FloatArray
    used: BoolArray

    @cached_property
    def ptr(self) -> IntArray:
        """Row ranges (B + 1,) of the blocks."""
        return np.cumsum([0, *(len(b.uv) for b in self.survey.image_blocks)])

    @cached_property
    def why(self) -> npt.NDArray[np.uint8]:
        """Why a row takes no part (N,): one of ``IN_USE`` to ``BY_THIS_RUN``."""
        file, now = (_used(s.image_blocks) for s in (self.survey, self.now))
        out = np.where(self.used, IN_USE, np.where(now, BY_THIS_RUN, np.where(file, BY_PEOPLE, BY_FILE)))
        return out.astype(np.uint8)

    def point_ids(self, block: ImageBlock) -> Sequence[str]:
        """The names that ``block.point_idx`` counts."""
        return self.point_names[block.target_id]

    @cached_property
    def point_names(self) -> Mapping[str | None, Sequence[str]]:
        """By target, None: of the world."""
        return {t.target_id: t.point_ids for t in self.survey.targets} | {
            None: tuple(p.point_id for p in self.survey.points)
        }  # fmt: skip

    def id_of(self, row: int) -> str:
        """``camera/epoch/target/point``; without the target for a point of the world."""
        i = int(np.searchsorted(self.ptr, row, side="right")) - 1
        block = self.survey.image_blocks[i]
        point = self.point_ids(block)[int(block.point_idx[row - self.ptr[i]])]
        return "/".join([block.camera_id, block.epoch_id, *([block.target_id] if block.target_id else []), point])

    def in_image(self, camera_id: str, epoch_id: str) -> IntArray:
        """Rows of one image."""
        found = [np.arange(self.ptr[i], self.ptr[i + 1]) for i, b in enumerate(self.survey.image_blocks)
                 if (b.camera_id, b.epoch_id) == (camera_id, epoch_id)]  # fmt: skip
        return np.concatenate([*found, np.zeros(0, dtype=np.int64)]).astype(np.int64)


def point_rows(survey: Survey, now: Survey, adjustment: Adjustment | None) -> PointRows:
    """The rows of ``survey``; ``now``: the same blocks with what people left out. adjustment: None before any."""
    n = sum(len(b.uv) for b in survey.image_blocks)
    residuals, test, redundancy = np.full((n, 2), np.nan), np.full(n, np.nan), np.full((n, 2), np.nan)
    used = np.zeros(n, dtype=np.bool_)
    if adjustment is not None:
        images = adjustment.image_residuals
        mine, theirs = _joined(survey.image_blocks, adjustment.survey.image_blocks)
        residuals[mine], test[mine] = images.residuals[theirs], images.test[theirs]
        redundancy[mine], used[mine] = images.redundancy[theirs], images.used[theirs]
    return PointRows(survey, now, residuals, test, redundancy, used)


def _used(blocks: Sequence[ImageBlock]) -> BoolArray:
    parts = [b.mask for b in blocks]
    return np.concatenate([*parts, np.zeros(0, dtype=np.bool_)])


def _joined(mine: Sequence[ImageBlock], theirs: Sequence[ImageBlock]) -> tuple[IntArray, IntArray]:
    """Rows of the same image points in two lists of blocks: of one image, target and pixel."""
    rows: dict[_Key, list[tuple[int, ImageBlock]]] = {}
    at = 0
    for block in mine:
        rows.setdefault(_key(block), []).append((at, block))
        at += len(block.uv)
    here, there, at = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)], 0
    for block in theirs:
        candidates = rows.get(_key(block), [])
        same = next((first for first, b in candidates if np.array_equal(b.uv, block.uv)), None)
        if same is not None:
            here.append(same + np.arange(len(block.uv)))
            there.append(at + np.arange(len(block.uv)))
        elif candidates:
            uv = np.concatenate([b.uv for _, b in candidates]) @ np.array([1.0, 1j])
            index = np.concatenate([first + np.arange(len(b.uv)) for first, b in candidates])
            order = np.argsort(uv)
            wanted = block.uv @ np.array([1.0, 1j])
            place = np.minimum(np.searchsorted(uv[order], wanted), len(uv) - 1)
            found = uv[order][place] == wanted
            here.append(index[order][place][found])
            there.append(at + np.flatnonzero(found))
        at += len(block.uv)
    return np.concatenate(here), np.concatenate(there)


def _key(block: ImageBlock) -> _Key:
    return block.camera_id, block.epoch_id, block.target_id


def columns(
    rows: PointRows, limit: float, version: int, chosen: IntArray | None = None, layout: int = 0, whole: bool = True
) -> bytes:
    """Image points for a page: length of the header (u4), the header (JSON), then the columns it lists, little-endian.

    limit: of |w|, the square root of the chi-square test's. chosen: these rows only. layout: of which rows there are in
    which order; a page that knows it needs no more than what a solution says of them (not ``whole``).
    """
    every = slice(None) if chosen is None else chosen
    with np.errstate(invalid="ignore"):
        arrays: dict[str, npt.NDArray[Any]] = {
            "du": rows.residuals[:, 0], "dv": rows.residuals[:, 1], "w": np.sqrt(rows.test),
            "redundancy": rows.redundancy.mean(axis=1), "used": rows.used.astype(np.uint8), "why": rows.why,
        }  # fmt: skip
    header: dict[str, object] = {"version": version, "limit": limit, "layout": layout, "whole": whole}
    if whole:
        said, seen = _seen(rows)
        header, arrays = header | said, seen | arrays
    types = {k: np.dtype("<f4") if a.dtype.kind == "f" else a.dtype for k, a in arrays.items()}
    types = dict(sorted(types.items(), key=lambda item: -item[1].itemsize))  # each begins at a multiple of its size
    header |= {
        "n": len(rows.test[every]), "rows": None if chosen is None else chosen.tolist(),
        "columns": [{"name": k, "type": kind.str.lstrip("<|")} for k, kind in types.items()],
    }  # fmt: skip
    text = json.dumps(header, ensure_ascii=False, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    out = BytesIO()
    out.writelines([len(text).to_bytes(4, "little"), text])
    for name, kind in types.items():  # one after the other: nowhere are all of them held twice
        out.write(np.ascontiguousarray(arrays.pop(name)[every], dtype=kind).data)
    return out.getvalue()


def _small(values: IntArray) -> npt.NDArray[np.unsignedinteger[Any]]:
    """Numbers from 0 on in as few bytes as they need, at most 4."""
    most = int(values.max(initial=0))
    return values.astype("u1" if most < 1 << 8 else "<u2" if most < 1 << 16 else "<u4")


def _seen(rows: PointRows) -> tuple[dict[str, object], dict[str, npt.NDArray[Any]]]:
    """What was observed, whatever the solution: names, and the columns of places and sigmas (these of so many rows)."""
    blocks, sizes = rows.survey.image_blocks, np.diff(rows.ptr)
    uv = np.concatenate([*(b.uv for b in blocks), np.zeros((0, 2))])
    arrays: dict[str, npt.NDArray[Any]] = {
        "block": _small(np.repeat(np.arange(len(blocks)), sizes)),
        "point": _small(np.concatenate([*(b.point_idx for b in blocks), np.zeros(0, dtype=np.int64)])),
        "u": uv[:, 0], "v": uv[:, 1],
    }  # fmt: skip
    if len(uv) <= _MOST_SIGMAS:
        sigma = np.sqrt(np.concatenate([*(np.einsum("nii->ni", b.cov) for b in blocks), np.zeros((0, 2))]))
        arrays |= {"sigma_u": sigma[:, 0], "sigma_v": sigma[:, 1]}
    names = {b.target_id for b in blocks}
    return {
        "blocks": [{"camera": b.camera_id, "epoch": b.epoch_id, "target": b.target_id, "group": b.group}
                   for b in blocks],
        "points": {t or "": list(ids) for t, ids in rows.point_names.items() if t in names},
    }, arrays  # fmt: skip


def reading_rows(survey: Survey, left: Hits, adjustment: Adjustment | None, limit: float) -> list[dict[str, object]]:
    """Every observation that is no image point, one entry per component, also those that take no part.

    survey: with all of them. left: what people left out of it. limit: of |w|. Values in the units shown.
    """
    found = {} if adjustment is None else {name_of_residual(o): o for o in adjustment.other_residuals}
    out: list[dict[str, object]] = []
    observed = Observed(survey, ())
    gone = set(observed.names(left))
    for name, places in observed.readings.items():
        field, i = places[0]
        item, residual = getattr(survey, field)[i], found.get(name)
        why = BY_FILE if not item.used else BY_PEOPLE if name in gone else IN_USE
        if residual is not None and not residual.used and why == IN_USE:
            why = BY_THIS_RUN
        table, _, reading = name.partition(":")
        head = {"id": name, "table": table, "name": reading, "group": item.group, "why": why,
                "used": why == IN_USE, "joins": _joins(item)}  # fmt: skip
        if residual is None:
            out.append(head | {"component": "", "w": None, "share": None})
        else:
            out += [head | _component(residual, k, limit) for k in range(len(residual.components))]
    return out


def _component(o: ObservationResidual, k: int, limit: float) -> dict[str, object]:
    unit, factor = unit_for_people(o.components[k], o.units[k])
    sigma_unit, sigma_factor = sigma_unit_for_people(o.units[k])
    values = {"observed": o.observed[k] * factor, "adjusted": o.adjusted[k] * factor,
              "residual": o.residual[k] * sigma_factor, "sigma": o.sigma[k] * sigma_factor,
              "redundancy": o.redundancy[k], "w": o.standardized[k],
              "share": abs(o.standardized[k]) / limit}  # fmt: skip
    return {"component": o.components[k], "unit": unit, "sigma_unit": sigma_unit, "kind": o.kind, **plain(values)}


def _joins(item: object) -> list[str]:
    """What a reading joins, as tables write it."""
    return [frame_text(one) if isinstance(one, FrameRef) else position_text(one) for one in refs_of(item)]
