"""``python -m tests.acceptance.networks_table > docs/networks.md``: every published network, measured now."""

import sys
from collections.abc import Iterable

from adjust.model.errors import SurveyError
from tests.acceptance.networks import (
    DEFAULTS,
    GAMA,
    KRUMM,
    LARGE,
    SYNTHETIC,
    Compared,
    compare_gama,
    compare_krumm,
    compare_large,
    compare_lgc,
    compare_railway,
)
from tests.data import data_folder

# ruff: noqa: E501
# reason: rows of Markdown tables are one line each

INTRODUCTION = """# Networks of other programs

`labsurvey convert FROM TO` reads the networks of other programs into project folders, and writes projects, with their
adjusted values where there are results, as files of other programs.

| format | ending | read | written |
|---|---|---|---|
| GNU Gama, local networks | `.gkf` | points held, free and constrained by axis, axes and sense of angles, direction sets, angles, distances, zenith angles, azimuths, height differences, vectors, coordinates, heights of instrument and target, covariance bands over mixed kinds, gon and degrees | all of these; the covariances in full |
| Krumm's textbook format | `.dat` (`.adj`) | heights, plane and spatial networks, English and German sections, dynamic datum | |
| CERN LGC, version 1 | `.lgc` | CALA, POIN, ANGL, ZENH, DMES | |
| plain table | `.csv` | points, readings, baselines and coordinates, one row each | the same and adjusted points; no correlations |
| DBAT script with PhotoModeler-like tables | `.xml` | a self-calibration: images, image points, control points | |
| AICON, JAiCov | `.phc .ior .eor .obc .scale`, report `.htm` | a bundle adjustment with self-calibration | |
| g2o | `.g2o` | pose networks | pose networks |
| JSON | `.json` | | everything, with units in the keys |
| SINEX 2.02, in its layout | `.snx` | | adjusted coordinates with their full covariance |

What a format cannot hold is listed by the command, never dropped in silence. Coordinates stay as they are in the file.
Where a program calls its axes north and east (x, y), the frame is left-handed in nature; `[bearings]` of the project
then says how its angles count, and lengths, heights and angles come out the same. Before cameras join such a network,
exchange x and y.

A project made from another program's file keeps every observation that its owner used (`reject_points` and `reject_pairs`
are false in its `survey.toml`), so that `adjust` gives that program's result; what does not fit is listed in the report.
Its `sigmas` under `[adjustment]` is that of the file: Gama's `sigma-act`; a posteriori for Krumm, LGC, DBAT and AICON.

Of Gama's files: default deviations of angles are arc seconds where the value is in degrees, cc where it is in gon.
Readings that are farther than `tol-abs` (1000 mm where the file does not say) from the coordinates in the file are marked
`used = false` and named by `convert`; write `true` to take one back. An angle goes only where its term is also beyond with
the weight that it has, as Gama does it. What the file asks for and does not get is listed: `latitude` and `ellipsoid`
(nothing is reduced to an ellipsoid), the network's `epoch`, readings that `tol-abs` cannot be applied to because a
point has no coordinates. `60` seconds are read as what rounding made of 59.99; a document type is passed over unless it
declares something; text that is not UTF-8 is read as Latin-1; names that cannot be ids are changed and listed.

SINEX-like means: FILE/COMMENT, SITE/ID, SOLUTION/STATISTICS, SOLUTION/ESTIMATE (STAX, STAY, STAZ in m) and
SOLUTION/MATRIX_ESTIMATE L COVA in their fixed columns, epochs and approximate longitudes zero; the frame is the
laboratory's. Names longer than four characters get codes, which the comment lists.

## Published results

Made by `python -m tests.acceptance.networks_table > docs/networks.md`; the tests hold the same numbers to their limits.
"""

GAMA_TEXT = """
### GNU Gama

Differences from Gama's XML: coordinates in mm, deviations relative, standardized residuals absolute (three decimals are
printed, half a unit is 0.0005). Gama stops after one linearisation. Columns *left* are what remains when exactly that
step is repeated from Gama's own approximate coordinates by an independent dense adjustment: where they are small and
the difference is not, Gama had not converged. For `tst-tetrahedron-3-gon` and `seq-dsuloha-d` Gama's standardized residuals
of correlated baselines and coordinates come from decorrelated rows; in the former its printed deviation of an adjusted
dy contradicts its own covariance matrix.

| network | points | observations | r | defect | sigma0 Gama | sigma0 | coordinates mm | left mm | deviations | left | w | left |
|---|---|---|---|---|---|---|---|---|---|---|---|---|
"""
FOLDER_TEXT = """
`python -m tests.acceptance.gama_folder FOLDER` converts and adjusts every `.gkf` below a folder and compares coordinates and
deviations of `results/solution.json` with the XML beside it. Of the 88 files of GNU Gama's `tests/gama-local/input`
(sandbox-gama at 3af74df8) all are converted and adjusted; 81 have a result of Gama's, and 76 of them agree to 1e-6 m in
every coordinate and 1e-3 in every deviation. The other five:

| file | difference | why |
|---|---|---|
| 2019-zeman | 2.1e-6 m | Gama stopped after its one linearisation (above) |
| 2019-prager | 2.9e-5 m, deviations to 3.6 % | Gama takes slope distances and zenith angles to targets above the mark as measured to the mark, reduced with approximate coordinates; with the reduced values of its XML the difference is 5.7e-8 m |
| Ghilani_GNSS_Baselines | 4.0e-5 m | axes and angles of the file do not fit together, so Gama turns y round, but not the signs of the correlations with it; with turned signs the difference is 0, and Ghilani's published result is ours |
| zoltan-test_3d_dms, zoltan-test_3d_gon | 0.17 m | Gama leaves one more zenith angle out, beyond `tol-abs` from start values of its own for a point that has none in the file; without it 1.2e-3 m (an instrument 16 m above its mark, Gama reduces) |
"""
LARGE_TEXT = """
### Networks of a thousand points

Synthetic, with Gama's variances; *left*: the same at Gama's linearisation, of every 31st coordinate.

| network | points | observations | r | sigma0 Gama | sigma0 | coordinates mm | deviations | left |
|---|---|---|---|---|---|---|---|---|
"""
KRUMM_TEXT = """
### Krumm's textbook networks

Largest difference from the published .adj in half units of the last printed digit: below 1 all digits agree. *Stopped*:
the same for plain Gauss-Newton stopped at steps below 1e-6 m. BlankenbachWillert3D holds two gross errors, so that
Gauss-Newton only halves the rest in each step; its published deviation of z had not settled in the sixth digit.

| network | points | observations | r | sigma0 | coordinates | corrections | deviations | stopped |
|---|---|---|---|---|---|---|---|---|
"""
LGC_TEXT = """
### CERN LGC

| network | points | observations | unknowns | sigma0 LGC | sigma0 | coordinates mm | deviations mm |
|---|---|---|---|---|---|---|---|
"""
RAILWAY_TEXT = """
### Without a published result

At the minimum of v'Pv by an independent gradient (steps left, in sigmas), in the datum of the constrained points.

| network | points | observations | r | defect | sigma0 | gradient | datum mm |
|---|---|---|---|---|---|---|---|
"""
JAICOV_TEXT = """
### JAiCov / AICON

115 images, 19,945 observations, 1147 unknowns, self-calibration, inner constraints over 66 points, through `convert` and
`adjust` on the folder: v'Pv 12359.40759 as published (S0 4.0536e-4 mm), all 150 points and their deviations within half
a unit of the last printed digit (1e-5 mm), lens parameters to ten decimals. See `tests/acceptance/test_jaicov.py`.
"""


def _row(cells: Iterable[object]) -> str:
    return "| " + " | ".join(str(c) for c in cells) + " |\n"


def _size(found: Compared) -> list[object]:
    return [len(found.network.survey.points), found.result.n_observations]


def _g(value: float) -> str:
    return f"{value:.2g}"


def gama_row(found: Compared) -> str:
    d, r = found.differences, found.result
    return _row([
        found.name, *_size(found), r.redundancy, r.datum_defect, f"{found.published_sigma0:.7g}", f"{found.sigma0:.7g}",
        _g(1e3 * d["coordinate_m"]), _g(1e3 * d["coordinate_gap_m"]), _g(d["sigma_relative"]), _g(d["sigma_gap"]),
        _g(d["standardized"]), _g(d["standardized_gap"]),
    ])  # fmt: skip


def large_row(found: Compared) -> str:
    d, r = found.differences, found.result
    return _row([
        found.name, *_size(found), r.redundancy, f"{found.published_sigma0:.7g}", f"{found.sigma0:.7g}",
        _g(1e3 * d["coordinate_m"]), _g(d["sigma_relative"]), _g(d["sigma_gap"]),
    ])  # fmt: skip


def krumm_row(found: Compared) -> str:
    d, r = found.differences, found.result
    return _row([
        found.name, *_size(found), r.redundancy, f"{found.sigma0:.5g}", f"{d['coordinate']:.2f}",
        f"{d['correction']:.2f}", f"{d['sigma']:.2f}",
        f"{max(v for k, v in d.items() if k.endswith('_gap')):.2f}",
    ])  # fmt: skip


def lgc_row(found: Compared) -> str:
    d, r = found.differences, found.result
    return _row([
        found.name, *_size(found), r.n_unknowns, found.published_sigma0, f"{found.sigma0:.6f}",
        _g(1e3 * d["coordinate_m"]), _g(1e3 * d["sigma_m"]),
    ])  # fmt: skip


def railway_row(found: Compared) -> str:
    d, r = found.differences, found.result
    return _row([
        found.name, *_size(found), r.redundancy, r.datum_defect, f"{found.sigma0:.7g}", _g(d["gradient"]),
        _g(1e3 * d["datum_m"]),
    ])  # fmt: skip


def main() -> None:
    """Print the page."""
    gama, defaults, synthetic, krumm, lgc = (
        data_folder("network", n) for n in ("gama", "gama_defaults", "synthetic", "krumm", "lgc")
    )
    small = ((gama, GAMA), (defaults, DEFAULTS), (synthetic, SYNTHETIC))
    sections = [
        (GAMA_TEXT, gama_row, [(compare_gama, f, n) for f, names in small for n in names]),
        (FOLDER_TEXT, gama_row, []),
        (LARGE_TEXT, large_row, [(compare_large, synthetic, n) for n in LARGE]),
        (KRUMM_TEXT, krumm_row, [(compare_krumm, krumm, n) for n in KRUMM]),
        (LGC_TEXT, lgc_row, [(lambda folder, _: compare_lgc(folder), lgc, "")]),
        (RAILWAY_TEXT, railway_row, [(lambda folder, _: compare_railway(folder), gama, "")]),
    ]
    out = INTRODUCTION
    for text, row, cases in sections:
        out += text
        for compare, folder, name in cases:
            try:
                out += row(compare(folder, name))
            except SurveyError as error:
                out += _row([name, str(error).splitlines()[0]])
                print(f"{name}: {error}", file=sys.stderr)
    sys.stdout.write(out + JAICOV_TEXT)


if __name__ == "__main__":
    main()
