"""Observations as the columns of their tables, the inverse of ``image_points`` and ``measurements``."""

from collections.abc import Sequence

import numpy as np
from gtsam import Pose3

from adjust.model.observations import Coordinates, Distance, ImageBlock, Pair, TableReading, frame_text, position_text
from adjust.model.survey import FloatArray, Survey
from adjust.observations.pairs import pair_arrays
from survey.folder.units import from_si
from survey.project.declared.poses import quaternion_wxyz
from survey.project.project import SpotBlock
from survey.project.tables.coordinates import XYZ_RHO, XYZ_SIGMAS
from survey.project.tables.covariance import sigmas_and_correlations
from survey.project.tables.pairs import COVARIANCE_COLUMNS, QUATERNION, SIGMA_COLUMNS, TRANSLATION
from survey.project.tables.reading import Columns, TextColumn
from survey.project.tables.terrestrial_columns import between_columns, group_columns, triple_columns

_FLAGS = ("false", "true")


def image_point_columns(blocks: Sequence[ImageBlock], survey: Survey) -> Columns:
    """One row per image point; ``group`` and ``used`` only where they are not as usual."""
    names: dict[str | None, tuple[str, ...]] = {target.target_id: target.point_ids for target in survey.targets}
    names[None] = tuple(point.point_id for point in survey.points)
    index: dict[str, int] = {}
    codes = {owner: np.array([index.setdefault(n, len(index)) for n in ids], int) for owner, ids in names.items()}
    sizes = [len(block.uv) for block in blocks]
    used = [block.mask for block in blocks]
    flags = np.concatenate([np.zeros(0, bool), *used])
    points = [codes[block.target_id][np.asarray(block.point_idx, int)] for block in blocks]
    return {
        "epoch_id": _repeat([block.epoch_id for block in blocks], sizes),
        "camera_id": _repeat([block.camera_id for block in blocks], sizes),
        "target_id": _repeat([block.target_id or "" for block in blocks], sizes),
        "point_id": TextColumn(tuple(index), np.concatenate([np.zeros(0, int), *points])),
        **_measured(blocks),
        **({"group": _repeat([b.group for b in blocks], sizes)} if any(b.group != "image" for b in blocks) else {}),
        **({} if flags.all() else {"used": TextColumn(_FLAGS, flags.astype(int))}),
    }


def spot_columns(spots: Sequence[SpotBlock]) -> Columns:
    """One row per unidentified spot."""
    sizes = [len(block.uv) for block in spots]
    return {
        "epoch_id": _repeat([block.epoch_id for block in spots], sizes),
        "camera_id": _repeat([block.camera_id for block in spots], sizes),
        "spot_id": [spot_id for block in spots for spot_id in block.spot_ids],
        **_measured(spots),
    }


def _measured(blocks: Sequence[ImageBlock] | Sequence[SpotBlock]) -> dict[str, FloatArray]:
    uv = np.concatenate([np.zeros((0, 2)), *(block.uv for block in blocks)])
    sigma, rho = sigmas_and_correlations(np.concatenate([np.zeros((0, 2, 2)), *(block.cov for block in blocks)]))
    columns = np.column_stack([uv, sigma, rho])
    return dict(zip(("u_px", "v_px", "sigma_u_px", "sigma_v_px", "rho_uv"), columns.T, strict=True))


def angle_columns(readings: Sequence[TableReading]) -> Columns:
    """One row per reading; the second axis blank for a table that has one."""
    rows = np.full((len(readings), 5), np.nan)
    for row, reading in zip(rows, readings, strict=True):
        k = len(reading.angles)
        sigma, rho = sigmas_and_correlations(reading.cov[None])
        row[:k] = from_si(reading.angles, "deg")
        row[2 : 2 + k] = from_si(sigma[0], "arcsec")
        row[4] = rho[0, 0] if k == 2 else np.nan
    names = ("axis1_deg", "axis2_deg", "sigma_axis1_arcsec", "sigma_axis2_arcsec", "rho_12")
    return {
        "epoch_id": [reading.epoch_id for reading in readings],
        "table_id": [reading.table_id for reading in readings],
        **dict(zip(names, rows.T, strict=True)),
        **group_columns(readings, "table", used=False),
    }


def pair_columns(pairs: Sequence[Pair]) -> Columns:
    """One row per pair: quaternion, translation of poses, sigmas where they are independent, else the covariance."""
    sigma_names = (*SIGMA_COLUMNS["rotation"][3], *SIGMA_COLUMNS["translation"][1])
    names = (*QUATERNION, *TRANSLATION, *sigma_names, *COVARIANCE_COLUMNS)
    measured, rows = pair_arrays(pairs), np.full((len(pairs), len(names)), np.nan)
    rotations = (p.b_from_a.rotation() if isinstance(p.b_from_a, Pose3) else p.b_from_a for p in pairs)
    rows[:, :4] = np.array([quaternion_wxyz(rotation) for rotation in rotations]).reshape(-1, 4)
    rows[:, 4:7] = from_si(measured.translations, "mm")
    alone = np.count_nonzero(measured.cov, axis=(1, 2)) == 6  # infinite where no translation was measured
    cov = np.where(np.isinf(measured.cov), np.nan, measured.cov)
    cov[~measured.is_pose, :, 3:] = np.nan
    sigma = np.sqrt(np.diagonal(cov[alone], axis1=1, axis2=2))
    rows[alone, 7:13] = np.concatenate([from_si(sigma[:, :3], "arcsec"), from_si(sigma[:, 3:], "mm")], axis=1)
    rows[~alone, 13:] = np.where(np.triu(np.ones((6, 6), dtype=np.bool_)), cov[~alone], np.nan).reshape(-1, 36)
    columns = {name: column for name, column in zip(names, rows.T, strict=True) if not np.isnan(column).all()}
    return {
        "pair_id": [pair.pair_id for pair in pairs],
        "a_id": [frame_text(pair.a) for pair in pairs],
        "b_id": [frame_text(pair.b) for pair in pairs],
        **columns,
        **group_columns(pairs, "pair"),
    }


def distance_columns(distances: Sequence[Distance]) -> Columns:
    """One row per distance."""
    return {
        "distance_id": [distance.distance_id for distance in distances],
        "from_id": [position_text(distance.a) for distance in distances],
        "to_id": [position_text(distance.b) for distance in distances],
        "value_m": np.array([distance.value for distance in distances]),
        "sigma_mm": from_si([distance.sigma for distance in distances], "mm"),
        **group_columns(distances, "distance"),
    }


def coordinate_columns(coordinates: Sequence[Coordinates]) -> tuple[Columns, Columns]:
    """One row per position, and one row per covariance between positions of the same observation."""
    sets, alone = [], set[str]()
    for number, observation in enumerate(coordinates, 1):
        names = [position_text(position) for position in observation.positions]
        set_id = observation.set_id or (f"set{number}" if len(names) > 1 or names[0] in alone else "")
        alone.update(names if not set_id else ())
        sets.append((set_id, names, observation.cov))
    set_ids = [set_id for set_id, names, _ in sets for _ in names]
    return {
        "point_id": [name for _, names, _ in sets for name in names],
        **triple_columns(("x_mm", "y_mm", "z_mm", *XYZ_SIGMAS, *XYZ_RHO), coordinates),
        **({"set_id": set_ids} if any(set_ids) else {}),
        **group_columns([c for c in coordinates for _ in c.positions], "coordinates"),
    }, between_columns(sets)


def _repeat(values: Sequence[str], sizes: Sequence[int]) -> TextColumn:
    index = {name: i for i, name in enumerate(dict.fromkeys(values))}
    return TextColumn(tuple(index), np.repeat(np.array([index[name] for name in values], int), sizes))
