"""Read ``results/solution.json`` of an adjusted example and hold it against the truth that stands beside it.

Run: python examples/compare_with_truth.py lab
Every line is one quantity; errors are in units of their own sigma, so that their root mean square should be near 1.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

ARCSEC = np.degrees(1.0) * 3600.0


def main(folder: Path) -> None:
    truth = json.loads((folder / "truth.json").read_text())["parameters"]
    solution = json.loads((folder / "results" / "solution.json").read_text())
    rows = dict(compared(solution, truth))
    print(f"{'':<34}{'rms error/sigma':>17}{'largest':>9}")
    for name, errors in rows.items():
        print(f"{name:<34}{np.sqrt(np.mean(errors**2)):17.2f}{np.abs(errors).max():9.2f}")
    errors = np.concatenate(list(rows.values()))
    print(f"{f'all {len(errors)} numbers':<34}{np.sqrt(np.mean(errors**2)):17.2f}{np.abs(errors).max():9.2f}")
    # of some hundred numbers none should miss by more than five sigmas: chance would do that once in ten thousand runs
    if np.abs(errors).max() > 5.0:
        sys.exit(f"{folder}: an error exceeds five sigmas; the sigmas are too small or a value is wrong")


def compared(solution: dict, truth: dict) -> Iterator[tuple[str, np.ndarray]]:
    """Name of each estimated quantity and the errors of its free components over their sigmas."""
    for name, camera in solution["cameras"].items():
        true, lens = truth[f"lens/{name}"], camera["lens"]
        free = [p for p, status in lens["status"].items() if status == "free"]
        values = [(lens.get(f"{p}_px", lens.get(p)), lens.get(f"sigma_{p}_px", lens.get(f"sigma_{p}"))) for p in free]
        yield (
            f"lens of {name}",
            np.array([(value - true[p]) / sigma for p, (value, sigma) in zip(free, values, strict=True)]),
        )
        yield from pose(f"station_from_camera {name}", camera["station_from_camera"], truth)
    for name, station in solution["stations"].items():
        if "world_from_station" in station:
            yield from pose(f"world_from_station {name}", station["world_from_station"], truth)
    for name, target in solution["targets"].items():
        if "world_from_target" in target:
            yield from pose(f"world_from_target {name}", target["world_from_target"], truth, "carrier_from_target")
    for name, table in solution["tables"].items():
        yield from pose(f"world_from_table {name}", table["world_from_table"], truth)
        true, found = truth[f"table_geometry/{name}"], table["geometry"]
        keys = ("non_orthogonality_arcsec", "axis_offset_mm")
        yield f"geometry of {name}", np.array([(found[k] - true[k]) / found[f"sigma_{k}"] for k in keys])
    for name, point in solution["points"].items():
        true = truth[f"point/{name}"]["x_mm"]
        yield (
            f"point {name}",
            np.array([(point[f"{c}_mm"] - t) / point[f"sigma_{c}_mm"] for c, t in zip("xyz", true, strict=True)]),
        )


def pose(label: str, found: dict, truth: dict, kind: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Errors of a free pose: its origin along the axes of a, its rotation about the axes of b, of ``a_from_b``."""
    kind_name, name = label.split()
    true = truth[f"{kind or kind_name}/{name}"]
    if found["status"] != "free":
        return
    shift = np.subtract(found["translation_mm"], true["translation_mm"]) / found["sigma_translation_mm"]
    turned = _rotation(true).inv() * _rotation(found)
    yield label, np.concatenate([shift, ARCSEC * turned.as_rotvec() / found["sigma_rotation_arcsec"]])


def _rotation(entry: dict) -> Rotation:
    w, x, y, z = entry["rotation_quaternion_wxyz"]
    return Rotation.from_quat([x, y, z, w])


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "lab"))
