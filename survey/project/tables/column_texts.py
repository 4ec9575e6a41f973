"""What the columns of the tables in ``observations/`` mean; their names and kinds are those of each table's layout."""

_POSITION = "position, such as B01, target:board/r0c0, station:head@e01"
_COMMON = {
    "group": "group of the observation for its variance component; default: the kind",
    "used": "true or false; false: predicted and listed, not adjusted",
    "sigma_u_px": "standard deviation of u; default: [sigmas] image_px",
    "sigma_v_px": "standard deviation of v",
    "rho_uv": "correlation of u and v",
    "u_px": "column; the centre of the first pixel is 0",
    "v_px": "row, downwards",
    "epoch_id": "epoch",
    "camera_id": "camera",
    "target_id": "target; blank: a point of the world",
    "from_id": _POSITION,
    "to_id": _POSITION,
    "set_id": "rows of one set are one observation with a covariance; blank: each row its own",
    "x_mm": "x", "y_mm": "y", "z_mm": "z",
    "sigma_mm": "standard deviation",
    "sigma_x_mm": "standard deviation of x", "sigma_y_mm": "standard deviation of y",
    "sigma_z_mm": "standard deviation of z",
    "rho_xy": "correlation of x and y", "rho_xz": "correlation of x and z", "rho_yz": "correlation of y and z",
    "a_axis": "x, y or z", "b_axis": "x, y or z", "covariance_mm2": "their covariance",
    "value_mm": "the value, or", "value_m": "the value", "value_deg": "the value, or", "value_gon": "the value, or",
}  # fmt: skip
COLUMN_TEXTS: dict[str, tuple[str, dict[str, str]]] = {
    "image_points": ("Image points of targets and of points of the world; written by labsurvey detect.", {
        "point_id": "point of the target, or of the world"}),
    "spots": ("Bright spots without a name; written by labsurvey detect.", {"spot_id": "number of the spot"}),
    "table_angles": ("Readings of turntables.", {
        "table_id": "turntable", "axis1_deg": "outer axis", "axis2_deg": "inner axis",
        "sigma_arcsec": "of both axes; default: that of the table in survey.toml",
        "sigma_axis1_arcsec": "or of each: outer",
        "sigma_axis2_arcsec": "inner", "rho_12": "correlation of the two"}),
    "exclusions": ("What people leave out; written by labsurvey exclude, include and remove, only ever added to.", {
        "what": "kind: image, epoch, camera, target, point, image_point, spot, or a table such as distances",
        "id": "its name, as labsurvey exclude takes it", "state": "excluded or included; the last row counts",
        "reason": "why", "author": "who", "time": "when (ISO 8601)"}),
    "pairs": ("Measured relative rotations and poses b_from_a.", {
        "pair_id": "name of the pair", "a_id": "frame a, such as camera:X@e01", "b_id": "frame b",
        "qw": "unit quaternion of b_from_a", "qx": "x", "qy": "y", "qz": "z", 
        "euler_x_deg": "or R = Rz(z) Ry(y) Rx(x): x", "euler_y_deg": "y", "euler_z_deg": "z",
        "tx_mm": "translation; blank: a rotation alone", "ty_mm": "y", "tz_mm": "z"}),
    "distances": ("Distances between two positions: tape, caliper, scale bar.", {
        "distance_id": "name of the distance"}),
    "coordinates": ("Measured coordinates of positions in the world; blank: not measured.", {"point_id": _POSITION}),
    "coordinates_covariance": ("Covariances within sets of coordinates; rows that are not there are 0.", {
        "set_id": "set of coordinates.csv", "a_id": "position", "b_id": "position"}),
    "terrestrial": ("Readings of total stations, theodolites and levels.", {
        "kind": "direction, angle, zenith, azimuth, slope_distance, horizontal_distance or height_difference",
        "reading_id": "name of the reading; default: r and its row", "setup_id": "set-up of survey.toml",
        "second_id": "right target of an angle", "value_dms": "an angle as 12 34 56.7, or",
        "value_m": "a length", "value_mm": "a length", "length_m": "of the levelling line",
        "sigma_mm": "of a length; default: the instrument's",
        "sigma_target_centring_mm": "in place of the instrument's"}),
    "terrestrial_covariance": ("Correlations between readings.", {
        "a_id": "reading", "b_id": "reading", "rho": "their correlation"}),
    "coordinate_differences": ("Coordinates of one position less those of another: vectors, GNSS baselines.", {
        "difference_id": "name of the difference"}),
    "coordinate_differences_covariance": ("Covariances between differences.", {
        "a_id": "difference", "b_id": "difference"}),
    "levels": ("Readings of levels put on boards and tables.", {
        "level_id": "name of the reading", "frame_id": "frame on which the level stands",
        "axis": "the level's axis in that frame: x, -y, or three numbers",
        "value_g": "of an accelerometer: share of gravity",
        "sigma_g": "standard deviation of it"}),
    "alignments": ("Measured angles between an axis of one frame and one of another: laser traces, autocollimation.", {
        "alignment_id": "name", "a_id": "frame a", "b_id": "frame b", "axis_a": "axis in a: x, -y, or three numbers",
        "axis_b": "axis in b", "rho_12": "correlation of the two values"}),
    "laser_spots": ("Places where a beam met a target.", {
        "spot_id": "name", "beam_id": "beam of survey.toml", "target_id": "target that it met",
        "x_mm": "x in the target",
        "y_mm": "y in the target", "epoch_id": "epoch; blank where nothing moves"}),
    "on_surfaces": ("Positions that lie on a surface.", {
        "surface_id": "surface of survey.toml", "point_id": _POSITION,
        "offset_mm": "distance above it: radius of a reflector"}),
}  # fmt: skip
_PATTERNS = (
    ("sigma_", "standard deviation"), ("cov_", "covariance of the components named, rotation rad and translation m"),
    ("value_1_", "first angle"), ("value_2_", "second angle"), ("value_", "the value, in one of the units"),
    ("instrument_height_", "of the instrument above its point"), ("target_height_", "of the target above its point"),
    ("second_height_", "of the right target of an angle"), ("rho_", "correlation"),
    ("d", "component of the difference"),
)  # fmt: skip


def column_text(table: str, column: str) -> str:
    """What a column holds; empty where nobody has said it."""
    own = COLUMN_TEXTS.get(table, ("", {}))[1]
    if column in own or column in _COMMON:
        return own.get(column, _COMMON.get(column, ""))
    return next((text for start, text in _PATTERNS if column.startswith(start)), "")
