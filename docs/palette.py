"""Pictures of pages as PNG of at most 136 colours: a quarter of the size, and no difference that an eye would see."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

_MOST, _SAMPLE = 136, 40000


def write_palette_png(path: Path, png: bytes) -> None:
    """Write a picture given as PNG with the 136 colours nearest to its own (k-means over different colours)."""
    picture = cv2.cvtColor(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    height, width = picture.shape[:2]
    codes = (picture.astype(np.uint32) * np.array([65536, 256, 1], dtype=np.uint32)).sum(axis=2).ravel()
    different, which, n = np.unique(codes, return_inverse=True, return_counts=True)
    colours = np.stack([different >> 16, (different >> 8) & 255, different & 255], axis=1).astype(np.float32)
    if len(different) > _MOST:
        cv2.setRNGSeed(1)
        order = np.argsort(-n, kind="stable")
        flat, others = order[:64], order[64:]  # large areas keep their colour
        some = others[:: max(1, len(others) // _SAMPLE)]
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 12, 0.5)
        _, _, found = cv2.kmeans(colours[some], _MOST - 64, None, criteria, 1, cv2.KMEANS_PP_CENTERS)
        palette = np.concatenate([colours[flat], np.round(found)])
        nearest = np.concatenate([np.argmin(((part[:, None] - palette) ** 2).sum(axis=2), axis=1)
                                  for part in np.array_split(colours, len(colours) // 4096 + 1)])  # fmt: skip
    else:
        palette, nearest = colours, np.arange(len(different))
    rows = np.zeros((height, width + 1), np.uint8)  # each begins with the number of its filter: none
    rows[:, 1:] = nearest[which].reshape(height, width)
    head = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    parts = ((b"IHDR", head), (b"PLTE", palette.astype(np.uint8).tobytes()),
             (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b""))  # fmt: skip
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*part) for part in parts))


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
