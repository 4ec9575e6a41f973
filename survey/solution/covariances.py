"""The file ``covariance.npz`` of results: every parameter with its value and covariance, and what each number is."""

from pathlib import Path

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.result import Adjustment, Estimate, ParameterName
from adjust.model.survey import FloatArray
from survey.folder.arrays import packed_arrays, read_arrays
from survey.solution.quantities import SigmaKind, scale_of

_README = (
    "names[i] is kind/id[/epoch]/component; units[i] its unit, status[i] free, held, prior or tied; parameters[k] is "
    "kind/id[/epoch].",
    "Parameter k has the components start[k]:start[k+1] of names; its covariance is covariance[block[k]:block[k+1]], "
    "row by row; its value is values[value_start[k]:value_start[k+1]]: its components, of a pose the rows of [R t].",
    "Tangent of a pose a_from_b: rotation (rad) then translation (m), in frame b: a_from_b * Exp(tangent).",
    "Covariances are a priori times factor**2; factor is 1 where sigmas is a_priori, sigma0 where it is a_posteriori.",
)
_SIZES = {"point": 3, "world_from_station": 6}


def covariance_npz(adjustment: Adjustment, sigmas: SigmaKind = "a_posteriori") -> bytes:
    """Every parameter with its covariance, joint within the parameter, as an ``.npz`` that explains itself."""
    scale, estimates = scale_of(adjustment, sigmas), list(adjustment.estimates.values())
    values = [e.value.matrix()[:3].ravel() if isinstance(e.value, Pose3) else np.asarray(e.value, dtype=float).ravel()
              for e in estimates]  # fmt: skip
    sizes, none = np.array([len(e.components) for e in estimates], dtype=np.int64), np.empty(0)
    return packed_arrays(
        README=np.array(_README),
        names=np.array([f"{'/'.join(e.name)}/{c}" for e in estimates for c in e.components], dtype=str),
        units=np.array([u for e in estimates for u in e.units], dtype=str),
        status=np.array([s for e in estimates for s in e.status], dtype=str),
        parameters=np.array(["/".join(e.name) for e in estimates], dtype=str),
        start=np.concatenate([[0], np.cumsum(sizes)]),
        block=np.concatenate([[0], np.cumsum(sizes**2)]),
        covariance=np.concatenate([*((scale.factor**2 * e.cov).ravel() for e in estimates), none]),
        value_start=np.cumsum([0, *map(len, values)]),
        values=np.concatenate([*values, none]),
        sigmas=np.array(scale.sigmas),
        factor=np.array(scale.factor),
    )


def read_estimates(path: Path) -> dict[ParameterName, Estimate]:
    """The estimates that :func:`covariance_npz` wrote, their covariances a priori.

    Raises ValueError, KeyError or OSError for what is no such file.
    """
    found = read_arrays(path)
    start, block, ends, texts = found["start"], found["block"], found["value_start"], found["parameters"]
    flat, values, factor = found["covariance"], found["values"], float(found.get("factor", 1.0))
    n = len(texts) + 1 if texts.ndim == 1 and texts.dtype.kind == "U" else -1
    if any(x.shape != (n,) or x.dtype != np.int64 for x in (start, block, ends)) or flat.dtype != values.dtype != float:
        raise ValueError(f"{path.name}: start, block and covariance do not fit the parameters")
    sizes = np.diff(start)
    fits = (sizes >= 0).all() and start[0] == block[0] == ends[0] == 0 and (np.diff(block) == sizes**2).all()
    if not fits or flat.shape != (block[-1],) or values.shape != (ends[-1],) or (np.diff(ends) < 0).any():
        raise ValueError(f"{path.name}: the blocks do not fit the sizes of the parameters")
    if not factor > 0.0:
        raise ValueError(f"{path.name}: the factor of its covariances is {factor}")
    components = [name.rpartition("/")[2] for name in found["names"].tolist()]
    units, status = found["units"].tolist(), found["status"].tolist()
    if not len(components) == len(units) == len(status) == start[-1]:
        raise ValueError(f"{path.name}: names, units and status do not fit the parameters")
    out = {}
    for k, text in enumerate(texts.tolist()):
        name, own = tuple(text.split("/")), slice(*start[k : k + 2].tolist())
        cov = flat[block[k] : block[k + 1]].reshape(sizes[k], sizes[k]) / factor**2
        value = _value(name, values[ends[k] : ends[k + 1]], len(cov))
        out[name] = Estimate(name, value, tuple(components[own]), tuple(units[own]), cov, tuple(status[own]))
    return out


def _value(name: ParameterName, numbers: FloatArray, size: int) -> Pose3 | FloatArray:
    """Twelve numbers of six components are a pose."""
    is_pose = size == 6 and len(numbers) == 12
    if size != _SIZES.get(name[0], size) or not (is_pose or len(numbers) == size):
        raise ValueError(f"{'/'.join(name)}: {len(numbers)} values and a covariance of {size} components")
    if not is_pose:
        return np.asarray(numbers, dtype=float)
    R, t = numbers.reshape(3, 4)[:, :3], numbers.reshape(3, 4)[:, 3]
    if not np.abs(R @ R.T - np.eye(3)).max() < 1e-9 or np.linalg.det(R) < 0.0 or not np.isfinite(t).all():
        raise ValueError(f"{'/'.join(name)}: is no pose")
    return Pose3(Rot3(R), t)
