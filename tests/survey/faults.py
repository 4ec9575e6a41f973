# ruff: noqa: E501  (one fault is one line, so that the catalogue can be read)
"""A small good project, and a catalogue of faults that can be planted in it.

Every fault is ``(name, plant, expected)``: ``plant(folder)`` changes one thing in the folder and returns a piece of the line
that the error must name ("" where it names only a file); ``expected`` is a regular expression for the error's message.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

Plant = Callable[[Path], str]


class Fault(NamedTuple):
    name: str
    plant: Plant
    expected: str


DEFINITION = """\
format = 1
title = "Small lab"   # a comment with [brackets] = and "quotes"

[cameras.X]
station = "head"
image_size_px = [1280, 1024]
[cameras.X.lens]
model = "brown"
free = ["fx", "u0", "v0", "k1"]
values = { fx = 1600.0, u0 = 639.5, v0 = 511.5, k1 = -0.1 }
prior = { k1 = { value = -0.1, sigma = 0.05 } }
tie = { fy = { to = "fx", factor = 1.0 } }

[cameras.Y]
station = "relay"
image_size_px = [640, 480]
station_from_camera = { treatment = "prior", translation_mm = [10.0, 0.0, 5.0], rotation_euler_xyz_deg = [0.0, 90.0, 0.0],\
 sigma_translation_mm = 2.0, sigma_rotation_deg = [1.0, 1.0, "inf"] }
[cameras.Y.lens]
model = "brown_backward"
free = ["c", "xp", "yp"]
pixel_size_mm = 0.0055

[stations.head]
motion = "table"
table = "turntable"
mount_from_station = { treatment = "held" }

[stations.relay]
motion = "epoch"
world_from_station = { treatment = "free", translation_mm = [1000.0, 0.0, 0.0], \
rotation_quaternion_wxyz = [1.0, 0.0, 0.0, 0.0] }
[stations.relay.epochs.e2]
translation_mm = [1100.0, 0.0, 0.0]
rotation_quaternion_wxyz = [0.7071067811865476, 0.7071067811865476, 0.0, 0.0]

[stations.pillar]

[tables.turntable]
axes = ["x", "z"]
sigma_arcsec = 8.0
geometry = { free = ["non_orthogonality", "axis_offset"], non_orthogonality_arcsec = 0.0, axis_offset_mm = 0.1 }
geometry_sigma = { axis_offset_mm = 1.0 }

[tables.rotary]
axes = ["z"]

[targets.board]
kind = "checkerboard"
columns = 5
rows = 4
square_mm = 20.0
pose = { treatment = "held" }
warp = { free = true, sigma_mm = 0.1 }

[targets.block]
kind = "marker_block"
dictionary = "4X4_50"
markers = { 7 = [[0, 0, 0], [30, 0, 0], [30, 30, 0], [0, 30, 0]], 3 = [[0, 0, 9], [30, 0, 9], [30, 30, 9], [0, 30, 9]] }
station = "relay"

[targets.grid]
kind = "marker_grid"
columns = 2
rows = 1
marker_mm = 40.0
gap_mm = 10.0
dictionary = "4X4_50"
first_id = 10
motion = "epoch"

[targets.charuco]
kind = "charuco"
squares_x = 5
squares_y = 4
square_mm = 30.0
marker_mm = 22.0
dictionary = "5X5_100"

[targets.sheet]
kind = "points"
file = "sheet_points.csv"

[points.B1]
[points.B2]
x_mm = [1000.0, 2000.0, 300.0]
treatment = "prior"
sigma_mm = [1.0, 1.0, 0.5]
[points.B3]
x_mm = [0.0, 0.0, 0.0]
treatment = "held"

[spots]
cameras = ["X", "Y"]
epochs = ["n1"]

[sigmas]
image_px = 0.1
scale = { distance = 2.0 }

[datum]
kind = "inner"
points = ["B1", "B2"]
stations = [
  "pillar",
]

[adjustment]
alpha = 0.01
"""

TABLES = {
    "observations/image_points.csv": """\
epoch_id,camera_id,target_id,point_id,u_px,v_px,sigma_u_px,sigma_v_px,rho_uv
e1,X,board,r0c0,100.25,200.5,0.1,0.2,0.5
e1,X,board,r0c1,110.25,200.5,0.1,0.2,0.5
e10,X,board,r0c0,120.25,200.5,,,
e2,X,board,r1c0,130.25,200.5,0.1,0.1,0
e1,Y,,B1,320.0,240.0,0.1,0.1,0
e1,Y,sheet,p2,320.0,240.0,0.1,0.1,0
""",
    "observations/table_angles.csv": """\
epoch_id,table_id,axis1_deg,axis2_deg,sigma_arcsec
e1,turntable,10.0,20.0,
e2,turntable,10.0,50.0,5.0
e1,rotary,33.0,,2.0
""",
    "observations/pairs.csv": """\
pair_id,a_id,b_id,qw,qx,qy,qz,tx_mm,ty_mm,tz_mm,sigma_rotation_arcsec,sigma_translation_mm
p1,station:pillar,relay@e1,1,0,0,0,100,0,0,10,0.1
p2,relay@e1,relay@e2,0.6,0.8,0,0,,,,10,
""",
    "observations/distances.csv": """\
distance_id,from_id,to_id,value_mm,sigma_mm
d1,B1,B2,1500.5,0.05
d2,camera:X@e1,target:board/r0c0,900,0.1
""",
    "observations/coordinates.csv": """\
point_id,x_mm,y_mm,z_mm,sigma_x_mm,sigma_y_mm,sigma_z_mm,rho_xy,rho_xz,rho_yz,set_id
B1,1,2,3,0.1,0.1,0.1,0,0,0,
B2,1000,2000,300,0.1,0.1,0.1,0.5,0,0,s1
B1,1,2,3,0.1,0.1,0.1,0,0,0,s1
""",
    "observations/coordinates_covariance.csv": """\
set_id,a_id,a_axis,b_id,b_axis,covariance_mm2
s1,B1,x,B2,x,0.002
""",
    "observations/spots.csv": """\
epoch_id,camera_id,spot_id,u_px,v_px,sigma_u_px,sigma_v_px,rho_uv
n1,X,s1,10.5,20.5,0.1,0.1,0
n1,X,s2,30.5,20.5,0.1,0.1,0
""",
    "sheet_points.csv": """\
point_id,x_mm,y_mm,z_mm
p1,0,0,0
p2,100,0,0
p3,0,100,5
""",
}


def write_good_project(folder: Path) -> None:
    """A project that reads without error and uses most of the format."""
    for name, text in {"survey.toml": DEFINITION, **TABLES}.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    for name in ("X/e1.png", "X/e2.JPG", "X/e10.png", "Y/e1.tif"):
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"not looked at")


def _replace(name: str, old: str, new: str, line: str | None = None) -> Plant:
    """Replace text; the error names the line with the first line of ``new``, or with ``line``."""

    def plant(folder: Path) -> str:
        text = (folder / name).read_text(encoding="utf-8")
        if text.count(old) != 1:
            raise ValueError(f"{old!r} stands {text.count(old)} times in {name}")
        (folder / name).write_text(text.replace(old, new), encoding="utf-8")
        return new.strip("\n").partition("\n")[0] if line is None else line

    return plant


def _toml(old: str, new: str) -> Plant:
    return _replace("survey.toml", old, new)


def _toml_at(old: str, new: str, line: str) -> Plant:
    return _replace("survey.toml", old, new, line)


def _row(table: str, old: str, new: str) -> Plant:
    return _replace(f"observations/{table}.csv", old, new)


def _add(table: str, row: str) -> Plant:
    def plant(folder: Path) -> str:
        path = folder / "observations" / f"{table}.csv"
        path.write_text(path.read_text(encoding="utf-8") + row + "\n", encoding="utf-8")
        return row

    return plant


def _write(name: str, content: str | bytes, line: str = "") -> Plant:
    def plant(folder: Path) -> str:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return line

    return plant


def _remove(name: str) -> Plant:
    def plant(folder: Path) -> str:
        (folder / name).unlink()
        return ""

    return plant


_LENS_Y = '[cameras.Y.lens]\nmodel = "brown_backward"\nfree = ["c", "xp", "yp"]\npixel_size_mm = 0.0055\n'
_PAIRS_WITH_COVARIANCE = (
    "pair_id,a_id,b_id,qw,qx,qy,qz,cov_rx_rx_rad2,cov_rx_ry_rad2,cov_rx_rz_rad2,cov_ry_ry_rad2,cov_ry_rz_rad2,cov_rz_rz_rad2"
)
_POINT = "e1,X,board,r0c1,110.25,200.5,0.1,0.2,0.5"

DEFINITION_FAULTS = [
    Fault("no survey.toml", _remove("survey.toml"), r"survey\.toml: there is no such file"),
    Fault("empty survey.toml", _write("survey.toml", ""), r"survey\.toml:1: the file is empty"),
    Fault("broken TOML", _toml('station = "head"', 'station = "head'), r"survey\.toml:\d+: not valid TOML"),
    Fault("key twice", _toml("rows = 4", "columns = 4"), r"not valid TOML: Cannot overwrite"),
    Fault("TOML ends early", _toml_at("alpha = 0.01\n", "alpha = [0.01", "alpha = [0.01"), r"not valid TOML"),
    Fault("format missing", _toml_at("format = 1\n", "", 'title = "Small'), r"survey\.toml:1: format: .*format = 1"),
    Fault("format of the future", _toml("format = 1", "format = 2"), r"format: found 2; .*format 1"),
    Fault("format as text", _toml("format = 1", 'format = "1"'), r"format: expected a whole number, found text"),
    Fault("unknown top key", _toml("[sigmas]", "[sigma]"), r"sigma: unknown key; did you mean 'sigmas'"),
    Fault("unknown key", _toml("columns = 5", "colums = 5"), r"colums: unknown key; did you mean 'columns'"),
    Fault("unit missing", _toml("square_mm = 20.0", "square = 20"), r"square: unknown key; did you mean 'square_mm'"),
    Fault("unit of pose missing", _toml("translation_mm = [1100.0,", "translation = [1100.0,"), r"mean 'translation_mm'"),
    Fault("key missing", _toml_at("rows = 4\n", "", "[targets.board]"), r"targets\.board\.rows: .*missing"),
    Fault("wrong type", _toml("columns = 5", 'columns = "5"'), r"columns: expected a whole number, found text '5'"),
    Fault("flag for a number", _toml("square_mm = 20.0", "square_mm = true"), r"square_mm: expected a number, found True"),
    Fault("table for a value", _toml_at("[stations.pillar]\n", "[stations]\npillar = 3\n", "pillar = 3"), r"expected a table, found 3"),
    Fault("not a list", _toml("image_size_px = [640, 480]", "image_size_px = 640"), r"expected a list of 2, found 640"),
    Fault("list too long", _toml("[640, 480]", "[640, 480, 3]"), r"expected a list of 2, found a list of 3"),
    Fault("image size of half pixels", _toml("[640, 480]", "[640.5, 480]"), r"image_size_px: .*whole numbers"),
    Fault("nan", _toml("square_mm = 20.0", "square_mm = nan"), r"square_mm: found nan; .*finite"),
    Fault("infinite coordinate", _toml("[1100.0, 0.0", "[inf, 0.0"), r"translation_mm: .*not finite"),
    Fault("size zero", _toml("square_mm = 20.0", "square_mm = 0.0"), r"square_mm: found 0.0; it must be positive"),
    Fault("sigma zero", _toml("sigma_mm = [1.0, 1.0, 0.5]", "sigma_mm = [1.0, 0.0, 0.5]"), r"a sigma must be positive"),
    Fault("sigma negative", _toml("sigma_arcsec = 8.0", "sigma_arcsec = -8.0"), r"sigma_arcsec: found -8; .*positive"),
    Fault("held component", _toml("sigma_translation_mm = 2.0", "sigma_translation_mm = [2, 0, 2]"), r"must be positive"),
    Fault("rotation sigma negative", _toml('[1.0, 1.0, "inf"]', '[-1.0, 1.0, "inf"]'), r"sigma_rotation_deg: found -1"),
    Fault("image sigma negative", _toml("image_px = 0.1", "image_px = -0.1"), r"image_px: found -0.1"),
    Fault("alpha too large", _toml("alpha = 0.01", "alpha = 5"), r"alpha: found 5; .*probability"),
    Fault("unknown group", _toml("{ distance = 2.0 }", "{ distanc = 2.0 }"), r"unknown group; did you mean 'distance'"),
    Fault("unknown kind", _toml('"checkerboard"', '"chekerboard"'), r"did you mean 'checkerboard'"),
    Fault("unknown treatment", _toml('{ treatment = "held" }\nwarp', '{ treatment = "fix" }\nwarp'), r"free, held, prior"),
    Fault("unknown motion", _toml('motion = "table"', 'motion = "turntable"'), r"motion: found 'turntable'"),
    Fault("unknown station of camera", _toml('station = "head"', 'station = "haed"'), r"'haed'; did you mean 'head'"),
    Fault("unknown station of target", _toml_at('9]] }\nstation = "relay"', '9]] }\nstation = "rely"', "rely"), r"did you mean 'relay'"),
    Fault("no table", _toml_at('table = "turntable"\n', "", "[stations.head]"), r"stations\.head\.table: .*add table"),
    Fault("unknown table", _toml('table = "turntable"', 'table = "turnable"'), r"did you mean 'turntable'"),
    Fault("mount without table", _toml_at("[stations.pillar]", "[stations.pillar]\nmount_from_station = {}", "mount_from"), r"only a station"),
    Fault("epochs of a fixed station", _toml_at('motion = "epoch"\nworld', 'motion = "fixed"\nworld', "epochs.e2]"), r"fixed.*no epochs"),
    Fault("axis twice", _toml('axes = ["x", "z"]', 'axes = ["x", "x"]'), r"axes\.1: 'x' is named twice"),
    Fault("unknown axis", _toml('axes = ["z"]', 'axes = ["w"]'), r"unknown axis 'w'"),
    Fault("no axis", _toml('axes = ["z"]', "axes = []"), r"axes: found 0 axes"),
    Fault("geometry of one axis", _toml_at('axes = ["x", "z"]', 'axes = ["z"]', "geometry = "), r"geometry\.\w+: unknown key"),
    Fault("sigma of a held offset", _toml_at('"axis_offset"]', "]", "geometry_sigma"), r"not free"),
    Fault("unknown lens model", _toml('"brown"', '"brwn"'), r"model: found 'brwn'; did you mean 'brown'"),
    Fault("unknown free parameter", _toml('"v0", "k1"]', '"v0", "k9"]'), r"free\.3: unknown parameter of the model brown 'k9'"),
    Fault("unknown lens value", _toml("k1 = -0.1 }\nprior", "q1 = -0.1 }\nprior"), r"values\.q1: unknown lens parameter"),
    Fault("value missing", _toml("fx = 1600.0, u0 = 639.5,", "fx = 1600.0,"), r"values\.u0: 'u0' has no value"),
    Fault("lens prior without sigma", _toml("value = -0.1, sigma = 0.05", "value = -0.1"), r"prior\.k1: .*needs its sigma"),
    Fault("lens prior of a held one", _toml("{ k1 = { value", "{ k2 = { value"), r"prior\.k2: has a prior but is not free"),
    Fault("tie to unknown", _toml('to = "fx"', 'to = "f"'), r"tie\.fy\.to: unknown lens parameter 'f'"),
    Fault("tie to itself", _toml('to = "fx"', 'to = "fy"'), r"'fy' is tied itself"),
    Fault("tied and free", _toml_at('["fx", "u0",', '["fx", "fy", "u0",', "tie = "), r"fy: is tied and free"),
    Fault("no lens", _toml_at(_LENS_Y, "", "[cameras.Y]"), r"\[cameras\.Y\.lens\] is missing"),
    Fault("no pixel size", _toml_at("pixel_size_mm = 0.0055\n", "", "[cameras.Y.lens]"), r"pixel_size_mm is missing"),
    Fault("prior without sigma", _toml("sigma_translation_mm = 2.0, ", ""), r"station_from_camera: .*needs its sigma"),
    Fault("point prior without sigma", _toml_at("sigma_mm = [1.0, 1.0, 0.5]\n", "", "[points.B2]"), r"points\.B2: .*sigma_mm"),
    Fault("sigma of a held point", _toml_at('treatment = "held"\n\n', 'treatment = "held"\nsigma_mm = 1\n\n', "sigma_mm = 1"), r"\"prior\""),
    Fault("held without value", _toml_at("x_mm = [0.0, 0.0, 0.0]\n", "", "[points.B3]"), r"points\.B3: x_mm is missing"),
    Fault("quaternion too long", _toml("= [0.7071067811865476, 0.7", "= [1.0, 0.7"), r"quaternion has length 1\.2"),
    Fault("rotation twice", _toml("[1.0, 0.0, 0.0, 0.0] }", "[1, 0, 0, 0], rotation_euler_xyz_deg = [0, 0, 0] }"), r"twice"),
    Fault("rotation missing", _toml_at("rotation_quaternion_wxyz = [0.7071067811865476, 0.7071067811865476, 0.0, 0.0]\n", "",
          "[stations.relay.epochs.e2]"), r"epochs\.e2: the rotation is missing"),
    Fault("covariance not symmetric", _toml("sigma_mm = [1.0, 1.0, 0.5]", "covariance_mm2 = [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]"),
          r"covariance_mm2: .*not symmetric"),
    Fault("covariance not definite", _toml("sigma_mm = [1.0, 1.0, 0.5]", "covariance_mm2 = [[1, 2, 0], [2, 1, 0], [0, 0, 1]]"),
          r"covariance_mm2: .*not positive definite"),
    Fault("unknown dictionary", _toml('dictionary = "5X5_100"', 'dictionary = "5X5_10"'), r"dictionary: unknown .*5X5_100"),
    Fault("marker too large", _toml("marker_mm = 22.0", "marker_mm = 32.0"), r"marker_mm: .*not smaller than the square"),
    Fault("marker with three corners", _toml(", [0, 30, 0]], 3", "], 3"), r"markers\.7: expected a list of 4"),
    Fault("marker without number", _toml("{ 7 = [", "{ m7 = ["), r"markers\.m7: expected the number of a marker"),
    Fault("warp of a block", _toml_at('"4X4_50"\nmarkers', '"4X4_50"\nwarp = {}\nmarkers', "warp = {}"), r"no warp"),
    Fault("point file missing", _remove("sheet_points.csv"), r"file: the file 'sheet_points\.csv' does not exist"),
    Fault("point file outside", _toml('"sheet_points.csv"', '"../sheet_points.csv"'), r"inside the project folder"),
    Fault("point file empty", _write("sheet_points.csv", "point_id,x_mm,y_mm,z_mm\n"), r"sheet_points\.csv:1: .*no points"),
    Fault("point twice in file", _replace("sheet_points.csv", "p3,0,100,5", "p1,0,100,5"), r"csv:4: point_id: 'p1' .*line 2"),
    Fault("id leaves the folder", _toml("[points.B1]", '[points."../B1"]'), r"'\.\./B1' cannot be an id"),
    Fault("id with separator", _toml("[stations.pillar]", '[stations."a/b"]'), r"'a/b' cannot be an id"),
    Fault("id is hidden", _toml("[points.B1]", '[points.".B1"]'), r"'\.B1' cannot be an id"),
    Fault("id is empty", _toml("[points.B1]", '[points.""]'), r"points\.: an id is empty"),
    Fault("spots of unknown camera", _toml('cameras = ["X", "Y"]', 'cameras = ["X", "W"]'), r"unknown camera 'W'"),
    Fault("spots upside down", _toml('epochs = ["n1"]', "diameter_px = [12.0, 2.0]"), r"diameter_px: .*smallest"),
    Fault("datum of unknown point", _toml('points = ["B1", "B2"]', 'points = ["B1", "B9"]'), r"datum\.points\.1: unknown point 'B9'"),
    Fault("datum of unknown station", _toml('  "pillar",', '  "pilar",'), r"did you mean 'pillar'"),
    Fault("datum given and named", _toml_at('kind = "inner"', 'kind = "given"', "points = ["), r"datum\.points: only .*inner"),
    Fault("definition not UTF-8", _write("survey.toml", b'format = 1\ntitle = "caf\xe9"\n', "title"), r"toml:2: byte 0xe9 is not"),
    Fault("images of unknown camera", _write("images/Q/e1.png", b""), r"images.Q: images of the unknown camera 'Q'"),
    Fault("image twice", _write("images/X/e1.bmp", b""), r"epoch 'e1' has an image already"),
    Fault("no image", _write("images/X/notes.txt", b""), r"notes\.txt: not an image"),
    Fault("image beside the folders", _write("images/e1.png", b""), r"e1\.png: a file among the cameras' folders"),
]  # fmt: skip

TABLE_FAULTS = [
    Fault("unknown column", _row("image_points", "u_px,v_px", "u_px,w_px"), r"points\.csv:1: unknown column 'w_px'; .*'v_px'"),
    Fault("column without unit", _row("image_points", ",u_px,v_px", ",u,v_px"), r"unknown column 'u'; did you mean 'u_px'"),
    Fault("column missing", _write("observations/distances.csv", "distance_id,from_id,value_mm,sigma_mm\n", "distance_id"),
          r"distances\.csv:1: the column 'to_id' is missing"),
    Fault("column twice", _row("image_points", "u_px,v_px,", "u_px,u_px,"), r"the column 'u_px' is there twice"),
    Fault("no header", _write("observations/distances.csv", "d1,B1,B2,1500.5,0.05\n", "d1,"), r"csv:1: the header is missing"),
    Fault("semicolons", _write("observations/distances.csv", "distance_id;from_id\n", "distance_id"), r"separated by commas"),
    Fault("empty table", _write("observations/distances.csv", ""), r"distances\.csv:1: the file is empty"),
    Fault("too few fields", _row("image_points", _POINT, "e1,X,board,r0c1,110.25"), r"csv:3: found 5 fields, expected 9"),
    Fault("too many fields", _row("image_points", _POINT, _POINT + ",1"), r"csv:3: found 10 fields, .*decimal point"),
    Fault("quote open", _row("image_points", _POINT, '"' + _POINT), r"image_points\.csv:\d+: .*quote"),
    Fault("field over two lines", _row("distances", "d2,", '"d\n2",'), r"csv:3: a quoted field runs over the end"),
    Fault("not a number", _row("image_points", "110.25", "11O.25"), r"csv:3: u_px: found '11O\.25', expected a number"),
    Fault("digits with underscore", _row("image_points", "110.25", "1_10.25"), r"csv:3: u_px: found '1_10\.25', expected a number"),
    Fault("blank number", _row("image_points", "110.25", ""), r"csv:3: u_px: is blank"),
    Fault("blank id", _row("image_points", "e1,X,board,r0c1", ",X,board,r0c1"), r"csv:3: epoch_id: is blank"),
    Fault("nan in table", _row("image_points", "110.25", "nan"), r"csv:3: u_px: found 'nan'; .*finite"),
    Fault("inf in table", _row("distances", "1500.5", "inf"), r"csv:2: value_mm: found 'inf'"),
    Fault("table not UTF-8", _write("observations/distances.csv", b"distance_id\nd\xfc\n", "d"), r"csv:2: byte 0xfc is not UTF-8"),
    Fault("table UTF-16", _write("observations/distances.csv", "distance_id".encode("utf-16")), r"csv:1: the file is UTF-16"),
    Fault("unknown file", _write("observations/image_point.csv", ""), r"unknown table 'image_point'; did you mean 'image_points'"),
    Fault("both formats", _write("observations/distances.parquet", b""), r"distances\.csv is there too"),
    Fault("unknown camera", _row("image_points", _POINT, _POINT.replace("X", "W")), r"csv:3: camera_id: unknown camera 'W'"),
    Fault("unknown target", _row("image_points", _POINT, _POINT.replace("board", "bord")), r"csv:3: .*did you mean 'board'"),
    Fault("unknown target point", _row("image_points", "r0c1", "r0c5"), r"csv:3: point_id: target 'board' has no point 'r0c5'"),
    Fault("unknown world point", _row("image_points", ",,B1,", ",,B7,"), r"csv:6: .*'B7'; .*tie_points = true"),
    Fault("image point twice", _add("image_points", _POINT), r"csv:8: point_id: 'r0c1' stands already in line 3"),
    Fault("outside the image", _row("image_points", "110.25", "1279.75"), r"csv:3: .*1279\.75.* outside the image of 1280 x 1024"),
    Fault("outside on the left", _row("image_points", "110.25", "-0.75"), r"csv:3: .*outside the image"),
    Fault("sigma zero in table", _row("image_points", _POINT, _POINT.replace("0.1,0.2", "0,0.2")), r"csv:3: sigma_u_px: found 0"),
    Fault("sigma negative in table", _row("distances", "0.05", "-0.05"), r"csv:2: sigma_mm: found -0.05; .*positive"),
    Fault("half a sigma", _row("image_points", _POINT, _POINT.replace("0.1,0.2", ",0.2")), r"csv:3: .*one is missing"),
    Fault("rho of one", _row("image_points", _POINT, _POINT[:-3] + "1.0"), r"csv:3: rho_uv: found 1; .*between -1 and 1"),
    Fault("no sigma anywhere", _toml_at("image_px = 0.1\n", "", "e10,X"), r"image_points\.csv:4: the row has no sigma"),
    Fault("id with path", _row("image_points", _POINT, _POINT.replace("e1,", "../e1,")), r"csv:3: epoch_id: '\.\./e1' cannot"),
    Fault("id with blanks", _row("image_points", _POINT, _POINT.replace("e1,", "e1 ,")), r"csv:3: epoch_id: .*blanks"),
    Fault("used neither yes nor no", _write("observations/distances.csv",
          "distance_id,from_id,to_id,value_mm,sigma_mm,used\nd1,B1,B2,1,1,maybe\n", "maybe"), r"csv:2: used: found 'maybe'"),
    Fault("spot of unknown camera", _row("spots", "n1,X,s2", "n1,Q,s2"), r"spots\.csv:3: camera_id: unknown camera 'Q'"),
    Fault("spot twice", _row("spots", "n1,X,s2", "n1,X,s1"), r"spots\.csv:3: spot_id: 's1' stands already in line 2"),
    Fault("unknown table id", _row("table_angles", "e2,turntable", "e2,turtable"), r"angles\.csv:3: .*did you mean 'turntable'"),
    Fault("reading twice", _row("table_angles", "e2,turntable", "e1,turntable"), r"csv:3: epoch 'e1' .*already in line 2"),
    Fault("angle missing", _row("table_angles", "10.0,50.0", "10.0,"), r"csv:3: axis2_deg: .*has 2 axes; fill in"),
    Fault("angle too many", _row("table_angles", "33.0,,", "33.0,1.0,"), r"csv:4: axis2_deg: .*has 1 axes; leave"),
    Fault("angle without sigma", _row("table_angles", "33.0,,2.0", "33.0,,"), r"csv:4: the row has no sigma.*tables\.rotary"),
    Fault("angle sigma twice", _write("observations/table_angles.csv", "epoch_id,table_id,axis1_deg,sigma_arcsec,sigma_axis1_arcsec\n"
          "e1,rotary,33.0,2,2\n", "e1,rotary"), r"csv:2: sigma_axis1_arcsec: the sigma is given twice; keep one of sigma_arcsec"),
    Fault("angle correlation", _write("observations/table_angles.csv", "epoch_id,table_id,axis1_deg,axis2_deg,rho_12\n"
          "e1,turntable,33.0,1.0,-1\n", "e1,turntable"), r"csv:2: rho_12: found -1"),
    Fault("pair twice", _row("pairs", "p2,", "p1,"), r"pairs\.csv:3: pair_id: 'p1' stands already in line 2"),
    Fault("pair of unknown station", _row("pairs", "station:pillar", "station:piller"), r"csv:2: .*'piller'; did you mean 'pillar'"),
    Fault("pair of unknown kind", _row("pairs", "station:pillar", "stat:pillar"), r"csv:2: .*unknown kind of frame 'stat'"),
    Fault("pair with itself", _row("pairs", "relay@e1,relay@e2", "relay@e1,relay@e1"), r"csv:3: .*two different frames"),
    Fault("epoch missing", _row("pairs", "pillar,relay@e1", "pillar,relay"), r"csv:2: .*'station:relay' moves"),
    Fault("epoch of a fixed frame", _row("pairs", "station:pillar", "station:pillar@e1"), r"csv:2: .*does not move"),
    Fault("pair quaternion", _row("pairs", "0.6,0.8", "0.6,0.9"), r"csv:3: the quaternion .*length 1\.08"),
    Fault("half a quaternion", _row("pairs", "0.6,0.8,0,0", "0.6,0.8,0,"), r"csv:3: qw,qx,qy,qz: only some"),
    Fault("half a translation", _row("pairs", "100,0,0,", "100,,0,"), r"csv:2: tx_mm,ty_mm,tz_mm: only some"),
    Fault("pair without rotation", _row("pairs", "0.6,0.8,0,0", ",,,"), r"csv:3: the rotation is given nowhere"),
    Fault("pair without sigma", _row("pairs", ",,,,10,", ",,,,,"), r"csv:3: the pair has no sigma of the rotation"),
    Fault("sigma without translation", _row("pairs", ",,,,10,", ",,,,10,1"), r"csv:3: .*sigma of the translation but no"),
    Fault("pair covariance", _write("observations/pairs.csv", _PAIRS_WITH_COVARIANCE + "\np1,pillar,relay@e1,1,0,0,0,1,2,0,1,0,1\n",
          "p1"), r"csv:2: the covariance is not positive definite"),
    Fault("pair covariance not symmetric", _write("observations/pairs.csv", _PAIRS_WITH_COVARIANCE + ",cov_ry_rx_rad2\n"
          "p1,pillar,relay@e1,1,0,0,0,1,0.5,0,1,0,1,0.1\n", "p1"), r"csv:2: the covariance is not symmetric"),
    Fault("pair covariance half", _write("observations/pairs.csv", _PAIRS_WITH_COVARIANCE + "\np1,pillar,relay@e1,1,0,0,0,1,,0,1,0,1\n",
          "p1"), r"csv:2: cov_rx_ry_rad2: is blank"),
    Fault("distance twice", _row("distances", "d2,", "d1,"), r"csv:3: distance_id: 'd1' stands already in line 2"),
    Fault("distance of unknown point", _row("distances", "d1,B1,", "d1,B8,"), r"csv:2: .*unknown point 'B8'"),
    Fault("distance of a bare station", _row("distances", "d1,B1,", "d1,pillar,"), r"csv:2: .*write 'station:pillar'"),
    Fault("distance of unknown corner", _row("distances", "board/r0c0", "board/r9c9"), r"csv:3: .*unknown point 'r9c9'"),
    Fault("distance to itself", _row("distances", "d1,B1,B2", "d1,B2,B2"), r"csv:2: .*two different positions"),
    Fault("distance without value", _row("distances", "1500.5", ""), r"csv:2: value_mm, value_m: fill in one"),
    Fault("distance negative", _row("distances", "1500.5", "-1500.5"), r"csv:2: value_mm: found -1500\.5"),
    Fault("coordinates twice", _add("coordinates", "B1,1,2,3,1,1,1,0,0,0,"), r"csv:5: point_id: 'B1' stands already in line 2"),
    Fault("coordinates not definite", _row("coordinates", "0.5,0,0,s1", "0.9,0.9,-0.9,s1"), r"csv:3: .*not positive definite"),
    Fault("correlation too large", _row("coordinates", "0.5,0,0,s1", "1.5,0,0,s1"), r"csv:3: .*between -1 and 1"),
    Fault("covariance of unknown set", _row("coordinates_covariance", "s1,B1", "s2,B1"), r"csv:2: set_id: unknown set 's2'"),
    Fault("covariance of unknown point", _row("coordinates_covariance", "x,B2,x", "x,B3,x"), r"csv:2: b_id: unknown point 'B3'; known: B1, B2"),
    Fault("joint covariance", _replace("observations/coordinates_covariance.csv", "0.002", "0.02", "B1,1,2,3,0.1,0.1,0.1,0,0,0,s1"), r"set 's1': the covariance is not positive"),
]  # fmt: skip

FAULTS = DEFINITION_FAULTS + TABLE_FAULTS


def named_line(folder: Path, message: str) -> str | None:
    """The text of the line that a message names as ``file:line``, or None."""
    found = re.search(rf"{re.escape(str(folder))}/(\S+?):(\d+): ", message)
    if not found:
        return None
    lines = (folder / found.group(1)).read_bytes().decode("utf-8", errors="replace").splitlines()
    number = int(found.group(2))
    return lines[number - 1] if number <= len(lines) else ""
