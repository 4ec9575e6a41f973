"""The columns of all tables of observations. Nothing here needs GTSAM: large tables are read while that is loaded."""

from survey.project.tables.reading import ANGLE_UNITS, FLAGS, Layout

_POINT_SIGMAS = ("sigma_u_px", "sigma_v_px", "rho_uv")
IMAGE_POINTS = Layout(
    "image_points",
    ("epoch_id", "camera_id", "point_id"),
    ("u_px", "v_px"),
    ("target_id", "group", "used"),
    _POINT_SIGMAS,
)
SPOTS = Layout("spots", ("epoch_id", "camera_id", "spot_id"), ("u_px", "v_px"), (), _POINT_SIGMAS)

TABLE_ANGLES = Layout(
    "table_angles",
    ("epoch_id", "table_id"),
    ("axis1_deg",),
    FLAGS[:1],
    ("axis2_deg", "sigma_arcsec", "sigma_axis1_arcsec", "sigma_axis2_arcsec", "rho_12"),
)
DISTANCES = Layout("distances", ("distance_id", "from_id", "to_id"), (), FLAGS, ("value_mm", "value_m", "sigma_mm"))

QUATERNION = ("qw", "qx", "qy", "qz")
EULER = ("euler_x_deg", "euler_y_deg", "euler_z_deg")
TRANSLATION = ("tx_mm", "ty_mm", "tz_mm")
_TANGENT = ("rx", "ry", "rz", "tx", "ty", "tz")


def covariance_column(i: int, j: int) -> str:
    """Column of one element of a pair's covariance, in rad and m."""
    unit = {0: "rad2", 1: "rad_m", 2: "m2"}[(i >= 3) + (j >= 3)]
    return f"cov_{_TANGENT[i]}_{_TANGENT[j]}_{unit}"


EULER_SIGMAS = [tuple(f"sigma_euler_{a}_{unit}" for a in "xyz") for unit in ("deg", "arcsec")]
SIGMA_COLUMNS = {
    "rotation": [("sigma_rotation_deg",) * 3, ("sigma_rotation_arcsec",) * 3]
    + [tuple(f"sigma_{a}_{unit}" for a in _TANGENT[:3]) for unit in ("deg", "arcsec")]
    + EULER_SIGMAS,
    "translation": [("sigma_translation_mm",) * 3, tuple(f"sigma_{a}_mm" for a in _TANGENT[3:])],
}
COVARIANCE_COLUMNS = tuple(covariance_column(i, j) for i in range(6) for j in range(6))
PAIRS = Layout(
    "pairs",
    ("pair_id", "a_id", "b_id"),
    (),
    FLAGS,
    QUATERNION
    + EULER
    + TRANSLATION
    + tuple(dict.fromkeys(name for columns in SIGMA_COLUMNS.values() for names in columns for name in names))
    + COVARIANCE_COLUMNS,
)

HEIGHTS = ("instrument_height", "target_height", "second_height")
TERRESTRIAL = Layout(
    "terrestrial",
    ("kind", "from_id", "to_id"),
    (),
    ("reading_id", "setup_id", "second_id", "value_dms", *FLAGS),
    (
        *(f"value_{unit}" for unit in ("deg", "gon", "m", "mm")),
        *(f"sigma_{unit}" for unit in (*ANGLE_UNITS, "mm")),
        *(f"{name}_{unit}" for name in HEIGHTS for unit in ("mm", "m")),
        "sigma_target_centring_mm",
        "length_m",
    ),
)
TERRESTRIAL_COVARIANCE = Layout("terrestrial_covariance", ("a_id", "b_id"), ("rho",))

_RHO = ("rho_xy", "rho_xz", "rho_yz")
COORDINATE_COLUMNS = ("x_mm", "y_mm", "z_mm", "sigma_x_mm", "sigma_y_mm", "sigma_z_mm", *_RHO)
COORDINATES = Layout("coordinates", ("point_id",), (), ("set_id", *FLAGS), COORDINATE_COLUMNS)
COORDINATES_COVARIANCE = Layout(
    "coordinates_covariance", ("set_id", "a_id", "a_axis", "b_id", "b_axis"), ("covariance_mm2",)
)
DIFFERENCE_COLUMNS = ("dx_mm", "dy_mm", "dz_mm", "sigma_dx_mm", "sigma_dy_mm", "sigma_dz_mm", *_RHO)
DIFFERENCES = Layout(
    "coordinate_differences", ("difference_id", "from_id", "to_id"), (), ("set_id", *FLAGS), DIFFERENCE_COLUMNS
)
DIFFERENCES_COVARIANCE = Layout(
    "coordinate_differences_covariance", ("a_id", "a_axis", "b_id", "b_axis"), ("covariance_mm2",)
)

TILT_UNITS = ("arcsec", "mgon", "deg", "mm_per_m")
LEVELS = Layout(
    "levels",
    ("level_id", "frame_id", "axis"),
    (),
    FLAGS,
    (*(f"value_{unit}" for unit in (*TILT_UNITS, "g")), *(f"sigma_{unit}" for unit in (*TILT_UNITS, "g"))),
)
ALIGNMENTS = Layout(
    "alignments",
    ("alignment_id", "a_id", "axis_a", "b_id", "axis_b"),
    (),
    FLAGS,
    (
        *(f"value_{i}_{unit}" for i in (1, 2) for unit in ("arcsec", "deg")),
        *(f"sigma_{i}_{unit}" for i in (1, 2) for unit in ("arcsec", "deg")),
        "rho_12",
    ),
)
LASER_SPOTS = Layout(
    "laser_spots",
    ("spot_id", "beam_id", "epoch_id", "target_id"),
    ("x_mm", "y_mm"),
    FLAGS,
    ("sigma_mm", "sigma_x_mm", "sigma_y_mm", "rho_xy"),
)
ON_SURFACES = Layout("on_surfaces", ("surface_id", "point_id"), ("sigma_mm",), FLAGS, ("offset_mm",))

LAYOUTS = {layout.name: layout for layout in (
    IMAGE_POINTS, SPOTS, TABLE_ANGLES, PAIRS, DISTANCES, COORDINATES, COORDINATES_COVARIANCE, TERRESTRIAL,
    TERRESTRIAL_COVARIANCE, DIFFERENCES, DIFFERENCES_COVARIANCE, LEVELS, ALIGNMENTS, LASER_SPOTS, ON_SURFACES,
)}  # fmt: skip
