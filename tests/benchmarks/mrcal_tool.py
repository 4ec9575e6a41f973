"""mrcal's tool, ``mrcal-calibrate-cameras``, on corners that are written as its corner finder would."""

import ast
import re
import resource
import shutil
import subprocess
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np

from adjust.model.survey import FloatArray
from tests.benchmarks.data import SIZE, Calibration
from tests.benchmarks.outcome import Competitor, Outcome

TOOL = "mrcal-calibrate-cameras"


def _corners(case: Calibration) -> str:
    lines = ["# filename x y level"]
    for c, e, uv in zip(case.camera.tolist(), case.epoch.tolist(), case.uv, strict=True):
        lines += [f"camera{c}-{e:05d}.png {u:.9f} {v:.9f} 0" for u, v in uv]
    return "\n".join(lines) + "\n"


def _lens(model: Path) -> FloatArray:
    found = re.search(r"'intrinsics':\s*(\[[^\]]*\])", model.read_text())
    if found is None:
        raise ValueError(f"{model} holds no intrinsics")
    return np.array(ast.literal_eval(found[1]), dtype=float)


def mrcal_tool(case: Calibration) -> Competitor:
    """From corners to models on disk: start of the process, start values, optimisation, uncertainty of projections.

    Without regularisation, outlier rejection and board warp, so that its model is that of the others.
    """
    tool = shutil.which(TOOL)
    if tool is None:
        raise FileNotFoundError(f"there is no {TOOL} (Debian package: mrcal)")
    rows, columns = (int(n) for n in case.shape)
    text, spacing = _corners(case), float(case.board[1, 0] - case.board[0, 0])

    def run() -> Outcome:
        with tempfile.TemporaryDirectory() as folder:
            corners = Path(folder, "corners.vnl")
            corners.write_text(text)
            command = [
                tool, "--corners-cache", str(corners), "--lensmodel", "LENSMODEL_OPENCV4", "--focal", "1632",
                "--imagersize", *map(str, SIZE), "--object-spacing", f"{spacing:g}", "--object-width-n", str(columns),
                "--object-height-n", str(rows), "--skip-regularization", "--skip-outlier-rejection",
                "--skip-calobject-warp-solve", "--outdir", folder,
                *(f"camera{c}-*.png" for c in range(len(case.lens))),
            ]  # fmt: skip
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            t0 = perf_counter()
            subprocess.run(command, check=True, capture_output=True, text=True, cwd=folder)
            seconds = perf_counter() - t0
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            lens = np.array([_lens(Path(folder, f"camera-{c}.cameramodel")) for c in range(len(case.lens))])
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        numbers = {"child_cpu": cpu, "child_mb": after.ru_maxrss / 1024}
        return Outcome({"tool": seconds}, {"lens": lens}, "with its start-up and files", numbers)

    return run
