"""The simulator's truth as JSON, for people and tests; no command of the software reads it."""

import json

import numpy as np
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.model.result import ParameterName
from adjust.model.survey import TABLE_GEOMETRY, FloatArray
from survey.simulate.scene import BROWN, Truth

_NOTE = "true values of the simulation; nothing reads this file"
_ARCSEC = 180.0 / np.pi * 3600.0


def truth_json(truth: Truth, seed: int) -> str:
    """Every parameter by ``kind/id[/epoch]``, with units in the key names."""
    parameters = {"/".join(name): _value(name, value) for name, value in truth.items()}
    return json.dumps({"note": _NOTE, "seed": seed, "parameters": parameters}, indent=1) + "\n"


def _value(name: ParameterName, value: Pose3 | FloatArray) -> dict[str, object]:
    if isinstance(value, Pose3):
        x, y, z, w = Rotation.from_matrix(value.rotation().matrix()).as_quat(canonical=True)
        return {
            "translation_mm": _listed(1e3 * value.translation()),
            "rotation_quaternion_wxyz": _listed(np.array([w, x, y, z])),
        }
    if name[0] == "lens":
        return dict(zip(BROWN, _listed(value), strict=True))
    if name[0] == "table_angles":
        return {"axis1_deg": float(np.degrees(value[0])), "axis2_deg": float(np.degrees(value[1]))}
    if name[0] == "table_geometry":
        factors = dict(zip(TABLE_GEOMETRY, (_ARCSEC, 1e3, 180.0 / np.pi, 180.0 / np.pi), strict=True))
        units = dict(zip(TABLE_GEOMETRY, ("arcsec", "mm", "deg", "deg"), strict=True))
        return {f"{n}_{units[n]}": float(v * factors[n]) for n, v in zip(TABLE_GEOMETRY, value, strict=True)}
    return {"x_mm": _listed(1e3 * value)}


def _listed(values: FloatArray) -> list[float]:
    return [float(value) for value in values]
