"""What a user of OpenCV writes to calibrate a pair of cameras from photographs; run as a program of its own.

    python -m tests.benchmarks.opencv_script FOLDER    (FOLDER/left, FOLDER/right, board of 9 x 6 corners)

The classic finder with ``cornerSubPix``, each camera with ``calibrateCamera``, the pair with ``stereoCalibrate``. No
sigmas, no tests, no report.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

SIZE, SQUARE = (9, 6), 25.0
UNTIL = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-3)


def main() -> None:
    """Print the focal lengths and the distance of the cameras."""
    board = np.zeros((SIZE[0] * SIZE[1], 3), np.float32)
    board[:, :2] = SQUARE * np.mgrid[: SIZE[0], : SIZE[1]].T.reshape(-1, 2)
    found: list[dict[str, np.ndarray]] = [{}, {}]
    size = (0, 0)
    for corners, name in zip(found, ("left", "right"), strict=True):
        for path in sorted((Path(sys.argv[1]) / name).iterdir()):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            size = image.shape[::-1]
            ok, uv = cv2.findChessboardCorners(image, SIZE)
            if ok:
                corners[path.stem] = cv2.cornerSubPix(image, uv, (5, 5), (-1, -1), UNTIL)
    lenses = [cv2.calibrateCamera([board] * len(c), list(c.values()), size, None, None)[1:3] for c in found]
    both = sorted(set(found[0]) & set(found[1]))
    views = [[c[name] for name in both] for c in found]
    result = cv2.stereoCalibrate([board] * len(both), *views, *lenses[0], *lenses[1], size)
    print([round(float(lens[0][0, 0]), 2) for lens in lenses], round(float(np.linalg.norm(result[6])), 3))


if __name__ == "__main__":
    main()
