"""Cameras, stations, turntables, targets and points as ``survey.toml`` declares them, and what stands below them."""

from survey.project.declared.keys import REQUIRED, Declared, Key, declare, vector_keys_declared

AXES = ("x", "y", "z")
_SIX = ("rx", "ry", "rz", "tx", "ty", "tz")
ROTATION = (
    Key("rotation_quaternion_wxyz", "numbers", "unit quaternion, w first", size=(4,)),
    Key("rotation_euler_xyz_deg", "numbers", "or angles x, y, z with R = Rz(z) Ry(y) Rx(x)", size=(3,)),
)
_DICTIONARY = Key("dictionary", "text", "of the markers, as OpenCV names it, such as DICT_4X4_50", REQUIRED)

WARP_UNITS = {
    "warp_x": "mm", "warp_y": "mm", "warp_xy": "mm", "scale_x": "ppm", "scale_y": "ppm", "shear": "ppm",
    "expansion": "ppm_per_K",
}  # fmt: skip
CROP_UNITS = {"scale": "1", "left": "px", "top": "px"}
CLOCK_UNITS = {"offset": "ms", "drift": "ppm", "line_time": "us"}


def _clock(name: str, path: str, what: str, names: tuple[str, ...]) -> Declared:
    said = {
        "offset": "how much later than the epochs' times", "drift": "how much more late with time, about the middle of "
        "the session", "line_time": "from each row of the image to the next lower one",
    }  # fmt: skip
    jitter = "sigma of the time of every single epoch about that; 0: none"
    return Declared(name, path, what, (
        *vector_keys_declared({n: CLOCK_UNITS[n] for n in names}, said, ("offset",)),
        Key("jitter_ms", "number", jitter, 0.0),
        Key("jitter_intervals", "number", "the same where no times are known, in intervals between epochs", 0.0),
    ))  # fmt: skip


def _target(kind: str, what: str, *keys: Key) -> Declared:
    common = (
        Key("kind", "choice", "what it is", REQUIRED,
            choices=("checkerboard", "charuco", "marker_grid", "marker_block", "points")),
        *keys,
        Key("station", "text", "the station that carries it; without one it stands in the world", refers="stations"),
        Key("motion", "choice", "fixed on its carrier, or with a pose of its own at every epoch", "fixed",
            choices=("fixed", "epoch")),
        Key("pose", "table", "carrier_from_target: the target in the station or the world", table="pose"),
        Key("epochs", "table", "its pose at single epochs, where motion is epoch: epochs.EPOCH", table="poses"),
        Key("warp", "table", "a board that is bent, stretched, sheared or grown; not of a marker_block", table="warp"),
        Key("cameras", "names", "the only cameras that may see it; default: all", refers="cameras"),
    )  # fmt: skip
    return Declared(f"target_{kind}", "targets.ID", what, common, of=("kind", kind))


BODIES: tuple[Declared, ...] = (
    declare(
        "camera", "cameras.ID", "A camera on a station; its images are in images/ID/EPOCH.png.",
        Key("station", "text", "the station that carries it", REQUIRED, refers="stations"),
        Key("image_size_px", "numbers", "width, height", REQUIRED, size=(2,)),
        Key("lens", "table", "its lens", REQUIRED, table="lens"),
        Key("station_from_camera", "table", "the camera in its station", table="pose"),
        Key("clock", "table", "when it exposes; absent: at the epochs' times", table="camera_clock"),
    ),
    _clock("camera_clock", "cameras.ID.clock", "When a camera exposes, while things move (remedies.md).",
           tuple(CLOCK_UNITS)),
    _clock("clock", "CLOCK", "When the axes of a turntable (tables.ID.clock), or the poses of a station in pairs.csv "
           "(stations.ID.clock), were read.", ("offset", "drift")),
    declare(
        "lens", "cameras.ID.lens", "Model and parameters. The parameters of each model: mathematics.md.",
        Key("model", "choice", "brown and fisheye as OpenCV's, the others of photogrammetry in mm", REQUIRED,
            choices=("brown", "fisheye", "brown_backward", "brown_backward_dbat", "aicon")),
        Key("free", "names", "parameters that are unknown; the others keep their value", REQUIRED),
        Key("values", "table", "start values, or values kept; those not named are 0. Absent: found from the images",
            table="lens_values"),
        Key("prior", "table", "what is known of free parameters beforehand", table="lens_prior"),
        Key("prior_covariance", "matrix", "of all priors in their order, in place of the sigmas", size=(0,)),
        Key("tie", "table", "parameters that are a multiple of another one", table="lens_tie"),
        Key("pixel_size_mm", "number", "needed by the models in mm", positive=True),
        Key("balance_radius_mm", "number", "model aicon: where the radial distortion is zero", 0.0),
        Key("drift", "table", "parameters that change in the course of the session", table="lens_drift"),
        Key("shared", "table", "parameters that are those of another camera", table="lens_shared"),
        Key("crops", "table", "images that are cropped or resized, by the epoch from which on: crops.EPOCH",
            table="lens_crops"),
    ),
    declare(
        "lens_shared", "cameras.ID.lens.shared", "One unknown for several cameras of the same model (remedies.md).",
        Key("camera", "text", "whose parameters they are; it shares none itself", REQUIRED, refers="cameras"),
        Key("parameters", "names", "which, free in both; [] for none, default: all that are free here"),
    ),
    Declared(
        "lens_crops", "cameras.ID.lens.crops", "Crops by epoch: crops.e11 = { scale = 0.5 }. Lens and "
        "image_size_px are those of the whole image.",
        free_keys=Key("EPOCH", "table", "from this epoch on, until the next", table="lens_crop"),
    ),
    declare(
        "lens_crop", "cameras.ID.lens.crops.EPOCH", "A part of the image, or another size of it (remedies.md).",
        Key("size_px", "numbers", "width, height of these images; default: all that is right of left_px and below "
            "top_px, times scale", size=(2,)),
        *vector_keys_declared(CROP_UNITS, {
            "scale": "px of these images per px of the whole image, 1 unless given",
            "left": "what is cut off at the left, px of the whole image",
            "top": "and at the top",
        }, ()),
    ),
    declare(
        "lens_drift", "cameras.ID.lens.drift", "Free parameters that change: by blocks of epochs, or with the "
        "temperature (remedies.md).",
        Key("parameters", "names", "which", REQUIRED),
        Key("begins", "names", "epochs at which a block begins; the first block has the lens itself", default=[]),
        Key("sigma", "table", "of a random walk from block to block; absent: every block by itself",
            table="lens_step"),
        Key("with_temperature", "flag", "in proportion to temperatures_degC, without blocks", False),
        Key("reference_degC", "number", "the temperature at which the lens itself holds", 20.0),
    ),
    Declared(
        "lens_step", "cameras.ID.lens.drift.sigma", "Parameter = sigma of its change from one block to the next.",
        free_keys=Key("PARAMETER", "number", "in the unit of the parameter", positive=True),
    ),
    Declared(
        "lens_values", "cameras.ID.lens.values", "Parameter = value, in px, mm or without unit as the model has it.",
        free_keys=Key("PARAMETER", "number", "its value"),
    ),
    declare(
        "lens_prior", "cameras.ID.lens.prior.PARAMETER",
        "A free parameter that is known beforehand, from a calibration certificate: { value = 1600.0, sigma = 2.0 }.",
        Key("value", "number", "the mean", REQUIRED),
        Key("sigma", "number", "of it; required unless prior_covariance is given", positive=True),
    ),
    declare(
        "lens_tie", "cameras.ID.lens.tie.PARAMETER",
        "A parameter that is factor times another one: fy = { to = \"fx\" } makes pixels square.",
        Key("to", "text", "the other parameter, which is not tied itself", REQUIRED),
        Key("factor", "number", "times which", 1.0),
    ),
    declare(
        "station", "stations.ID", "A rigid body: a head, a tripod, a relay station, a robot's hand.",
        Key("motion", "choice", "one pose for all epochs, one for each, or carried by a turntable", "fixed",
            choices=("fixed", "epoch", "table")),
        Key("table", "text", "the turntable that carries it, where motion is table", refers="tables"),
        Key("world_from_station", "table", "the station in the world, at all epochs that say nothing else",
            table="pose"),
        Key("mount_from_station", "table", "the station on the table's mount, where motion is table", table="pose"),
        Key("epochs", "table", "the station at single epochs, where motion is not fixed: epochs.EPOCH",
            table="poses"),
        Key("clock", "table", "when its poses in pairs.csv were measured, as by a robot", table="clock"),
    ),
    declare(
        "pose", "POSE", "A pose a_from_b: the origin of b in a, and the rotation from b to a. Where it is absent it is "
        "unknown and its start value is found.",
        Key("treatment", "choice", "unknown, kept, or unknown with a prior at its value", "free",
            choices=("free", "held", "prior")),
        Key("translation_mm", "numbers", "the origin of b in a", size=(3,)),
        *ROTATION,
        Key("sigma_translation_mm", "sigma", "of a prior, in the frame b; inf for unknown", size=(3,)),
        Key("sigma_rotation_deg", "sigma", "of a prior, about the axes of b; inf for unknown", size=(3,)),
        Key("sigma_rotation_arcsec", "sigma", "the same in arcseconds; give one of the two", size=(3,)),
        Key("covariance_rad_m", "matrix", "in place of sigmas: rotation rad, then translation m, in the frame b",
            size=(6,)),
        Key("held", "names", "components that keep their value, of a small motion in the frame b", choices=_SIX),
    ),
    Declared(
        "poses", "EPOCHS", "Poses by epoch: stations.head.epochs.e01 = { translation_mm = [0, 0, 1200] }.",
        free_keys=Key("EPOCH", "table", "the pose at this epoch", table="pose"),
    ),
    declare(
        "turntable", "tables.ID", "A turntable of one or two axes; its readings are in table_angles.csv.",
        Key("axes", "names", "outermost first, one or two of x, y, z", ["x", "z"], choices=AXES),
        Key("sigma_arcsec", "sigma", "of a reading where the table gives none, one or one per axis", size=(2,)),
        Key("world_from_table", "table", "its base in the world", table="pose"),
        Key("geometry", "table", "how its axes stand to each other", table="turntable_geometry"),
        Key("geometry_sigma", "table", "sigmas of priors at the values of geometry, under the same keys",
            table="turntable_sigma"),
        Key("harmonics", "table", "errors of its axes as they turn, up to which order (remedies.md)",
            table="harmonics"),
        Key("clock", "table", "when its axes are read; absent: at the epochs' times", table="clock"),
    ),
    Declared(
        "harmonics", "tables.ID.harmonics", "Harmonics of an axis that are unknown, up to this order.",
        tuple(
            Key(f"{kind}_{axis}", "whole", f"{what} of axis {axis}", 0, least=0)
            for kind, what in (("angle", "graduation and eccentricity of the encoder"), ("axial", "shift along it"),
                               ("radial", "run-out"), ("tilt", "wobble"))
            for axis in (1, 2)
        ),
    ),
    declare(
        "turntable_geometry", "tables.ID.geometry", "Two axes have all four parameters, one axis zero_1 alone.",
        Key("free", "names", "which are unknown, harmonics too; of two axes the first two unless said"),
        Key("non_orthogonality_arcsec", "number", "what the angle between the axes has beyond 90 degrees", 0.0),
        Key("axis_offset_mm", "number", "shortest distance of the axes", 0.0),
        Key("zero_1_deg", "number", "reading of the first encoder at the table's zero", 0.0),
        Key("zero_2_deg", "number", "of the second", 0.0),
        free_keys=Key("HARMONIC", "number", "angle_2_cos_1_arcsec, radial_2_re_m1_mm and so on: its value", 0.0),
    ),
    Declared(
        "turntable_sigma", "tables.ID.geometry_sigma", "Sigmas of priors of free parameters.",
        tuple(
            Key(name, "number", "sigma", positive=True)
            for name in ("non_orthogonality_arcsec", "axis_offset_mm", "zero_1_deg", "zero_2_deg")
        ),
        free_keys=Key("HARMONIC", "number", "sigma of a harmonic, under the key of its value", positive=True),
    ),
    _target(
        "checkerboard", "A checkerboard; its points rRcC are the inner corners, row R, column C from the upper left.",
        Key("columns", "whole", "inner corners across", REQUIRED, least=2),
        Key("rows", "whole", "inner corners down", REQUIRED, least=2),
        Key("square_mm", "number", "edge of a square", REQUIRED, positive=True),
    ),
    _target(
        "charuco", "A checkerboard with markers in its white squares; its points rRcC are the inner corners.",
        Key("squares_x", "whole", "squares across", REQUIRED, least=2),
        Key("squares_y", "whole", "squares down", REQUIRED, least=2),
        Key("square_mm", "number", "edge of a square", REQUIRED, positive=True),
        Key("marker_mm", "number", "edge of a marker, less than a square's", REQUIRED, positive=True),
        _DICTIONARY,
        Key("legacy", "flag", "as boards before OpenCV 4.6: an even number of rows begins with white", False),
    ),
    _target(
        "marker_grid", "A sheet of markers; its points mN.K are the corners K (0 to 3) of marker N.",
        Key("columns", "whole", "markers across", REQUIRED, least=1),
        Key("rows", "whole", "markers down", REQUIRED, least=1),
        Key("marker_mm", "number", "edge of a marker", REQUIRED, positive=True),
        Key("gap_mm", "number", "between two markers", REQUIRED, positive=True),
        _DICTIONARY,
        Key("first_id", "whole", "number of the upper left marker; the others count on by rows", 0, least=0),
    ),
    _target(
        "marker_block", "Markers on a body of any form; its points mN.K are the corners K (0 to 3) of marker N.",
        _DICTIONARY,
        Key("markers", "table", "number = four corners", REQUIRED, table="markers"),
    ),
    _target(
        "points", "A list of points with known places; image_points.csv names them, no program finds them.",
        Key("file", "text", "CSV or Parquet in the project's folder: point_id,x_mm,y_mm,z_mm", REQUIRED),
    ),
    Declared(
        "markers", "targets.ID.markers", "Corners of each marker in the target's frame, mm, from the upper left one "
        "clockwise: 7 = [[0, 0, 0], [40, 0, 0], [40, -40, 0], [0, -40, 0]].",
        free_keys=Key("NUMBER", "matrix", "four corners, x, y, z", size=(4, 3)),
    ),
    declare(
        "warp", "targets.ID.warp", "How the points of a board deviate from their nominal places (remedies.md).",
        Key("free", "flag", "which are unknown; true: warp_x and warp_y, false: none", True,
            choices=tuple(WARP_UNITS)),
        Key("warp_x_mm", "number", "how far the middle stands out, along x", 0.0),
        Key("warp_y_mm", "number", "and along y", 0.0),
        Key("warp_xy_mm", "number", "how far two corners stand out, the other two back", 0.0),
        Key("scale_x_ppm", "number", "how much longer it is along x", 0.0),
        Key("scale_y_ppm", "number", "and along y", 0.0),
        Key("shear_ppm", "number", "how far points move along x with their y", 0.0),
        Key("expansion_ppm_per_K", "number", "how much it grows with temperatures_degC", 0.0),
        Key("reference_degC", "number", "the temperature for which its lengths hold", 20.0),
        Key("sigma_mm", "sigma", "of a prior of warp_x and warp_y at these values", size=(2,)),
        Key("sigma", "table", "a prior: sigmas of free values, under their keys", table="vector_sigma"),
    ),
    declare(
        "point", "points.ID", "A point of the world; {} is an unknown one whose start value is found.",
        Key("x_mm", "numbers", "coordinates; nan for one that is not known; as many as there are dimensions",
            size=(3,)),
        Key("treatment", "choice", "unknown, kept, or unknown with a prior at its value", "free",
            choices=("free", "held", "prior")),
        Key("held", "names", "coordinates that keep their value", choices=AXES),
        Key("sigma_mm", "sigma", "of a prior; inf for unknown", size=(3,)),
        Key("covariance_mm2", "matrix", "in place of sigma_mm", size=(3,)),
    ),
)  # fmt: skip
