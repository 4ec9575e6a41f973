"""mrcal's bare optimiser, in the Python that has it: ``python3 mrcal_worker.py CASE WARM OUT``.

Needs numpy and mrcal only. Answers as the other workers do.
"""

import json
import sys
import time
from typing import Any

import mrcal
import numpy as np


def rotation_vector_pose(m: Any) -> Any:
    return mrcal.rt_from_Rt(np.vstack([m[:3, :3], m[:3, 3]]))


def problem(path: str) -> dict[str, Any]:
    """Arguments of ``mrcal.optimize`` from the rough start, without regularisation and outlier rejection."""
    with np.load(path) as data:
        case = {name: data[name] for name in data.files}
    rows, columns = (int(n) for n in case["shape"])
    camera, epoch = case["camera"], case["epoch"]
    observations = np.ones((len(camera), rows, columns, 3))
    observations[..., :2] = case["uv"].reshape(-1, rows, columns, 2)
    cameras = case["camera_from_head"]
    return {
        "intrinsics": case["lens"].copy(),
        "extrinsics_rt_fromref": np.array([rotation_vector_pose(m) for m in cameras[1:]]).reshape(-1, 6),
        "frames_rt_toref": np.array([rotation_vector_pose(m) for m in case["head_from_board"]]),
        "points": None,
        "observations_board": observations,
        "indices_frame_camintrinsics_camextrinsics": np.stack([epoch, camera, camera - 1], axis=1).astype(np.int32),
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "lensmodel": "LENSMODEL_OPENCV4",
        "imagersizes": np.tile(np.array([1280, 1024], np.int32), (len(cameras), 1)),
        "calibration_object_spacing": float(case["board"][1, 0] - case["board"][0, 0]),
        "do_optimize_calobject_warp": False,
        "do_apply_outlier_rejection": False,
        "do_apply_regularization": False,
        "verbose": False,
    }


def settle(arguments: dict[str, Any]) -> None:
    """Start again from the result until nothing moves: it stops before the last digits. Not timed."""
    for _ in range(10):
        before = arguments["intrinsics"].copy()
        mrcal.optimize(**arguments)
        if np.abs(arguments["intrinsics"] - before).max() < 1e-11:
            return


def matrix(rt: Any) -> Any:
    out = np.eye(4)
    Rt = mrcal.Rt_from_rt(rt)
    out[:3, :3], out[:3, 3] = Rt[:3], Rt[3]
    return out


def memory_mb(what: str) -> float:
    """As for the other workers."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) / 1024 for line in file if line.startswith(what))


def main() -> None:
    path, warm, out = sys.argv[1:]
    mrcal.optimize(**problem(warm))
    given = problem(path)
    idle = memory_mb("VmRSS")
    print(json.dumps({"ready": True}), flush=True)
    for _ in sys.stdin:
        arguments = {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in given.items()}
        wall, cpu = time.perf_counter(), time.process_time()
        mrcal.optimize(**arguments)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        settle(arguments)
        heads = [np.eye(4)] + [matrix(rt) for rt in arguments["extrinsics_rt_fromref"]]
        boards = [matrix(rt) for rt in arguments["frames_rt_toref"]]
        np.savez(out, lens=arguments["intrinsics"], camera_from_head=np.array(heads), head_from_board=np.array(boards))
        answer = {"stages": {"optimize": wall}, "wall": wall, "cpu": cpu, "note": "", "idle_mb": idle,
                  "peak_mb": memory_mb("VmHWM"), "numbers": {}}  # fmt: skip
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
