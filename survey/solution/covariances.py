"""The file ``covariance.npz`` of results: covariances of all parameters."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from adjust.model.result import Adjustment, Estimate
from survey.folder.arrays import packed_arrays, read_arrays
from survey.solution.quantities import SigmaKind, scale_of

_README = (
    "names[i] is kind/id[/epoch]/component; units[i] its unit; parameters[k] is kind/id[/epoch].",
    "Parameter k has the components start[k]:start[k+1] of names; its covariance is covariance[block[k]:block[k+1]], "
    "row by row.",
    "Tangent of a pose a_from_b: rotation (rad) then translation (m), in frame b: a_from_b * Exp(tangent).",
    "Covariances are a priori times factor**2; factor is 1 where sigmas is a_priori, sigma0 where it is a_posteriori.",
)


def covariance_npz(adjustment: Adjustment, sigmas: SigmaKind = "a_posteriori") -> bytes:
    """Covariance of every parameter, joint within the parameter, as an ``.npz`` that explains itself."""
    scale, estimates = scale_of(adjustment, sigmas), list(adjustment.estimates.values())
    names = [f"{'/'.join(e.name)}/{c}" for e in estimates for c in e.components]
    return packed_arrays(README=np.array(_README), names=np.array(names, dtype=str),
                         **covariance_arrays(estimates, scale.factor), sigmas=np.array(scale.sigmas),
                         factor=np.array(scale.factor))  # fmt: skip


def covariance_arrays(estimates: Sequence[Estimate], factor: float = 1.0) -> dict[str, Any]:
    """Names, units and covariances of estimates one behind the other, with what :func:`covariance_npz` says of them."""
    sizes = np.array([len(e.components) for e in estimates], dtype=np.int64)
    return {
        "units": np.array([u for e in estimates for u in e.units], dtype=str),
        "parameters": np.array(["/".join(e.name) for e in estimates], dtype=str),
        "start": np.concatenate([[0], np.cumsum(sizes)]),
        "block": np.concatenate([[0], np.cumsum(sizes**2)]),
        "covariance": np.concatenate([*((factor**2 * e.cov).ravel() for e in estimates), np.empty(0)]),
    }


def read_covariances(path: Path) -> dict[str, Any]:
    """The blocks of a ``covariance.npz`` by ``kind/id[/epoch]``, each (n, n), as they were written.

    Raises ValueError or OSError for what is no such file.
    """
    found = read_arrays(path, ("start", "block", "covariance", "parameters"))
    start, block, flat, names = found["start"], found["block"], found["covariance"], found["parameters"]
    n = len(names) + 1 if names.ndim == 1 and names.dtype.kind == "U" else -1
    if not (start.shape == block.shape == (n,) and start.dtype == block.dtype == np.int64 and flat.dtype == float):
        raise ValueError(f"{path.name}: start, block and covariance do not fit the parameters")
    sizes = np.diff(start)
    if (sizes < 0).any() or (np.diff(block) != sizes**2).any() or flat.shape != (block[-1],) or block[0] != 0:
        raise ValueError(f"{path.name}: the blocks do not fit the sizes of the parameters")
    return {
        str(name): flat[block[k] : block[k + 1]].reshape(sizes[k], sizes[k]) for k, name in enumerate(names)
    }  # fmt: skip
