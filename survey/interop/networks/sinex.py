"""Adjusted points with their full covariance in the layout of SINEX 2.02.

Of the blocks of SINEX this file has SITE/ID, SOLUTION/STATISTICS, SOLUTION/ESTIMATE and
SOLUTION/MATRIX_ESTIMATE L COVA, in their fixed columns. It is SINEX-like: the frame is the lab's, not the Earth's,
there is no epoch, and approximate longitudes and latitudes are zero; FILE/COMMENT says so. Points whose names do not
fit four characters get numbers; the comment lists them.

Layout: SINEX Format Description 2.02, IERS (2006).
"""

import string
from collections.abc import Iterator, Sequence

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from survey.interop.networks.values import NetworkValues

_EPOCH = "00:000:00000"
_RULE = "*" + "-" * 79
_DIGITS = string.digits + string.ascii_uppercase


def sinex_text(network: NetworkValues) -> str:
    """The file of an adjusted network. Raises SurveyError where there is no covariance, or numbers do not fit."""
    if not network.names:
        raise SurveyError("no coordinate was adjusted; SINEX holds adjusted coordinates with their covariance")
    codes = _codes(list(dict.fromkeys(point for point, _ in network.names)))
    n = len(network.names)
    if n > 99999:
        raise SurveyError(f"{n} coordinates; SINEX numbers them with five digits")
    head = f"%=SNX 2.02 LAB {_EPOCH} LAB {_EPOCH} {_EPOCH} C {n:05d} 2 S"
    blocks = [
        ("FILE/COMMENT", _comments(network, codes)),
        ("SITE/ID", _sites(codes)),
        ("SOLUTION/STATISTICS", _statistics(network)),
        ("SOLUTION/ESTIMATE", _estimates(network, codes)),
        ("SOLUTION/MATRIX_ESTIMATE L COVA", _matrix(network.joint)),
    ]
    lines = [head]
    for name, rows in blocks:
        lines += [_RULE, f"+{name}", *rows, f"-{name}"]
    return "\n".join([*lines, "%ENDSNX", ""])


def _codes(points: Sequence[str]) -> dict[str, str]:
    """Four characters for every point: its name where that fits, else a number to the base 36."""
    fitting = [p for p in points if len(p) <= 4 and p.isascii() and p.isalnum() and p == p.upper()]
    codes = {p: p for p in fitting}
    taken, count = set(fitting), 0
    for point in points:
        while point not in codes:
            code = "".join(_DIGITS[count // 36**k % 36] for k in (3, 2, 1, 0))
            count += 1
            if code not in taken:
                taken.add(code)
                codes[point] = code
    return codes


def _comments(network: NetworkValues, codes: dict[str, str]) -> Iterator[str]:
    yield f" {network.title}"[:80]
    yield " coordinates in the frame of the laboratory, m; no epoch, no Earth-fixed frame"
    yield f" covariances are a priori times {network.factor**2!r}"
    for point, code in codes.items():
        if point != code:
            yield f" {code} = {point}"


def _sites(codes: dict[str, str]) -> Iterator[str]:
    yield "*CODE PT __DOMES__ T _STATION DESCRIPTION__ APPROX_LON_ APPROX_LAT_ _APP_H_"
    for point, code in codes.items():
        name = "".join(c if c.isascii() else "?" for c in point)[:22]
        yield f" {code:<4}  A           {name:<22}   0  0  0.0   0  0  0.0     0.0"


def _statistics(network: NetworkValues) -> Iterator[str]:
    yield "*_STATISTICAL PARAMETER________ __VALUE(S)____________"
    rows: list[tuple[str, float]] = [
        ("NUMBER OF OBSERVATIONS", network.n_observations),
        ("NUMBER OF UNKNOWNS", network.n_unknowns),
        ("NUMBER OF DEGREES OF FREEDOM", network.redundancy),
        ("WEIGHTED SQUARE SUM OF O-C", network.omega),
        ("VARIANCE FACTOR", network.omega / network.redundancy if network.redundancy > 0 else 1.0),
    ]
    for name, value in rows:
        yield f" {name:<30} {value:22.15E}" if isinstance(value, float) else f" {name:<30} {value:22d}"


def _estimates(network: NetworkValues, codes: dict[str, str]) -> Iterator[str]:
    yield "*INDEX TYPE__ CODE PT SOLN _REF_EPOCH__ UNIT S __ESTIMATED VALUE____ _STD_DEV___"
    sigmas = np.sqrt(np.clip(np.diagonal(network.joint), 0.0, None))
    for k, ((point, axis), sigma) in enumerate(zip(network.names, sigmas.tolist(), strict=True), 1):
        value = float(network.x[point]["xyz".index(axis)])
        what = f"STA{axis.upper()}"
        yield f" {k:5d} {what:<6} {codes[point]:<4}  A    1 {_EPOCH} m    2 {value:21.14E} {sigma:11.5E}"


def _matrix(cov: FloatArray) -> Iterator[str]:
    """Lower triangle by rows, three numbers a line."""
    yield "*PARA1 PARA2 ____PARA2+0__________ ____PARA2+1__________ ____PARA2+2__________"
    for i, row in enumerate(cov):
        for j in range(0, i + 1, 3):
            numbers = " ".join(f"{value:21.14E}" for value in row[j : min(j + 3, i + 1)].tolist())
            yield f" {i + 1:5d} {j + 1:5d} {numbers}"
