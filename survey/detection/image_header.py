"""How large an image says it is, before anything is decoded: a few bytes can claim any number of pixels.

Sources: PNG (W3C, 11.2.2 IHDR), TIFF 6.0 (tags 256 and 257), JPEG (ITU T.81, B.2.2 frame header),
BMP (BITMAPINFOHEADER).
"""

import struct

_TIFF_TYPES = {1: "B", 3: "H", 4: "I"}


def image_size(head: bytes) -> tuple[int, int] | None:
    """(width, height) by the first bytes of a PNG, TIFF, JPEG or BMP file; None where they do not tell."""
    try:
        if head.startswith(b"\x89PNG\r\n\x1a\n"):
            width, height = struct.unpack_from(">II", head, 16)
            return width, height
        if head.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", head, 18)
            return abs(width), abs(height)
        if head[:4] in (b"II*\0", b"MM\0*"):
            return _tiff_size(head, "<" if head[:1] == b"I" else ">")
        if head.startswith(b"\xff\xd8"):
            return _jpeg_size(head)
    except struct.error:  # the header goes on beyond what is there
        pass
    return None


def _tiff_size(head: bytes, order: str) -> tuple[int, int] | None:
    (at,) = struct.unpack_from(order + "I", head, 4)
    (count,) = struct.unpack_from(order + "H", head, at)
    found: dict[int, int] = {}
    for i in range(count):
        tag, kind = struct.unpack_from(order + "HH", head, at + 2 + 12 * i)
        if tag in (256, 257) and kind in _TIFF_TYPES:
            (found[tag],) = struct.unpack_from(order + _TIFF_TYPES[kind], head, at + 10 + 12 * i)
    return (found[256], found[257]) if len(found) == 2 else None


def _jpeg_size(head: bytes) -> tuple[int, int] | None:
    at = 2
    while True:
        mark, kind, length = struct.unpack_from(">BBH", head, at)
        if mark != 0xFF:
            return None
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", head, at + 5)
            return width, height
        at += 1 if kind == 0xFF else 2 + length  # bytes that fill up, then the marker itself
