"""Every table of ``survey.toml`` with its keys: what readers allow, what the reference says, what editors complete."""

from survey.project.declared.keys import REQUIRED, Declared, Key, vector_keys_declared

_XYZ = ("x", "y", "z")
_SIX = ("rx", "ry", "rz", "tx", "ty", "tz")
_SIGMA_ARCSEC = ("arcsec", "mgon", "cc", "deg")
_ROTATION = (
    Key("rotation_quaternion_wxyz", "numbers", "unit quaternion, w first", size=(4,)),
    Key("rotation_euler_xyz_deg", "numbers", "or angles x, y, z with R = Rz(z) Ry(y) Rx(x)", size=(3,)),
)
_DICTIONARY = Key("dictionary", "text", "of the markers, as OpenCV names it, such as DICT_4X4_50", REQUIRED)

TILT_UNITS = {"tilt_1": "arcsec", "tilt_2": "arcsec"}
INSTRUMENT_UNITS = {
    "distance_offset": "mm", "distance_scale": "ppm", "refraction": "1", "vertical_index": "arcsec",
}  # fmt: skip
BEAM_UNITS = {"offset_1": "mm", "offset_2": "mm", "slope_1": "1", "slope_2": "1"}
WARP_UNITS = {
    "warp_x": "mm", "warp_y": "mm", "warp_xy": "mm", "scale_x": "ppm", "scale_y": "ppm", "shear": "ppm",
    "expansion": "ppm_per_K",
}  # fmt: skip
CROP_UNITS = {"scale": "1", "left": "px", "top": "px"}
CLOCK_UNITS = {"offset": "ms", "drift": "ppm", "line_time": "us"}
SURFACE_UNITS: dict[str, dict[str, str]] = {
    "plane": {"normal_1": "deg", "normal_2": "deg", "distance": "mm"},
    "line": {"direction_1": "deg", "direction_2": "deg", "offset_1": "mm", "offset_2": "mm"},
    "sphere": {"x": "mm", "y": "mm", "z": "mm", "radius": "mm"},
}
_SURFACE_SAID = {
    "normal_1": "turn of the normal about the first axis across it",
    "normal_2": "and about the second",
    "distance": "from the world's origin along the normal",
    "direction_1": "turn of the direction about the first axis across it",
    "direction_2": "and about the second",
    "offset_1": "where it passes the world's origin, along the first axis across it",
    "offset_2": "and along the second",
    "x": "centre, in the world",
    "y": "centre, in the world",
    "z": "centre, in the world",
    "radius": "of the sphere",
}
_SURFACE_KIND = Key("kind", "choice", "what it is", REQUIRED, choices=tuple(SURFACE_UNITS))


def _surface(kind: str, reference: Key | None) -> Declared:
    units = SURFACE_UNITS[kind]
    keys = vector_keys_declared(units, _SURFACE_SAID, tuple(units))
    return Declared(
        f"surface_{kind}", "surfaces.ID", f"A {kind}; what is not given is found from the positions on it.",
        (_SURFACE_KIND, *((reference,) if reference else ()), *keys), of=("kind", kind),
    )  # fmt: skip


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


_ACCURACY = tuple(
    Key(f"sigma_{name}_{unit}", "number", f"of one {name} reading; give it in one unit", positive=True)
    for name in ("direction", "angle", "zenith", "azimuth")
    for unit in _SIGMA_ARCSEC
)

DECLARATIONS: tuple[Declared, ...] = (
    Declared(
        "root", "", "The keys before the first table.",
        (
            Key("format", "whole", "of the folder; this program reads 1", REQUIRED, least=1),
            Key("title", "text", "of the report", ""),
            Key("tie_points", "flag", "points that only the observations name are points of the world", False),
            Key("dimensions", "whole", "2: a plane network, every z is kept; 1: levelling, x and y are kept", 3,
                least=1),
            Key("cameras", "table", "cameras by id", table="camera"),
            Key("stations", "table", "stations by id: rigid bodies that carry cameras or targets", table="station"),
            Key("tables", "table", "turntables by id", table="turntable"),
            Key("targets", "table", "targets by id", table="target"),
            Key("points", "table", "points of the world by id", table="point"),
            Key("datum", "table", "what fixes the coordinates", table="datum"),
            Key("sigmas", "table", "sigmas of image points, factors of groups", table="sigmas"),
            Key("adjustment", "table", "tests and what a run may leave out", table="adjustment"),
            Key("closures", "table", "loops of pairs through a mount, by name", table="closure"),
            Key("spots", "table", "beacons as bright spots, found without a name", table="spots"),
            Key("vertical", "table", "the plumb line", table="vertical"),
            Key("temperatures_degC", "table", "by epoch, for targets that expand", table="temperatures"),
            Key("times_s", "table", "by epoch, for clocks; all epochs or none", table="times"),
            Key("epoch_interval_s", "number", "instead: from each epoch to the next, in the order of their names",
                positive=True),
            Key("bearings", "table", "how horizontal angles count", table="bearings"),
            Key("instruments", "table", "total stations, levels by id", table="instrument"),
            Key("setups", "table", "set-ups of instruments by id", table="setup"),
            Key("beams", "table", "lasers fixed on something, by id", table="beam"),
            Key("surfaces", "table", "planes, lines, spheres by id", table="surface"),
            Key("align", "table", "what is to be aligned, by id", table="align"),
            Key("tolerances", "table", "demands on the results, by name", table="tolerance"),
            Key("identification", "table", "who, where, with what: texts for the report", table="identification"),
        ),
    ),
    Declared(
        "camera", "cameras.ID", "A camera on a station; its images are in images/ID/EPOCH.png.",
        (
            Key("station", "text", "the station that carries it", REQUIRED, refers="stations"),
            Key("image_size_px", "numbers", "width, height", REQUIRED, size=(2,)),
            Key("lens", "table", "its lens", REQUIRED, table="lens"),
            Key("station_from_camera", "table", "the camera in its station", table="pose"),
            Key("clock", "table", "when it exposes; absent: at the epochs' times", table="camera_clock"),
        ),
    ),
    _clock("camera_clock", "cameras.ID.clock", "When a camera exposes, while things move (remedies.md).",
           tuple(CLOCK_UNITS)),
    _clock("clock", "CLOCK", "When the axes of a turntable (tables.ID.clock), or the poses of a station in pairs.csv "
           "(stations.ID.clock), were read.", ("offset", "drift")),
    Declared(
        "lens", "cameras.ID.lens", "Model and parameters. The parameters of each model: mathematics.md.",
        (
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
    ),
    Declared(
        "lens_shared", "cameras.ID.lens.shared", "One unknown for several cameras of the same model (remedies.md).",
        (
            Key("camera", "text", "whose parameters they are; it shares none itself", REQUIRED, refers="cameras"),
            Key("parameters", "names", "which, free in both; [] for none, default: all that are free here"),
        ),
    ),
    Declared(
        "lens_crops", "cameras.ID.lens.crops", "Crops by epoch: crops.e11 = { scale = 0.5 }. Lens and "
        "image_size_px are those of the whole image.",
        free_keys=Key("EPOCH", "table", "from this epoch on, until the next", table="lens_crop"),
    ),
    Declared(
        "lens_crop", "cameras.ID.lens.crops.EPOCH", "A part of the image, or another size of it (remedies.md).",
        (
            Key("size_px", "numbers", "width, height of these images; default: all that is right of left_px and below "
                "top_px, times scale", size=(2,)),
            *vector_keys_declared(CROP_UNITS, {
                "scale": "px of these images per px of the whole image, 1 unless given",
                "left": "what is cut off at the left, px of the whole image",
                "top": "and at the top",
            }, ()),
        ),
    ),
    Declared(
        "lens_drift", "cameras.ID.lens.drift", "Free parameters that change: by blocks of epochs, or with the "
        "temperature (remedies.md).",
        (
            Key("parameters", "names", "which", REQUIRED),
            Key("begins", "names", "epochs at which a block begins; the first block has the lens itself", default=[]),
            Key("sigma", "table", "of a random walk from block to block; absent: every block by itself",
                table="lens_step"),
            Key("with_temperature", "flag", "in proportion to temperatures_degC, without blocks", False),
            Key("reference_degC", "number", "the temperature at which the lens itself holds", 20.0),
        ),
    ),
    Declared(
        "lens_step", "cameras.ID.lens.drift.sigma", "Parameter = sigma of its change from one block to the next.",
        free_keys=Key("PARAMETER", "number", "in the unit of the parameter", positive=True),
    ),
    Declared(
        "lens_values", "cameras.ID.lens.values", "Parameter = value, in px, mm or without unit as the model has it.",
        free_keys=Key("PARAMETER", "number", "its value"),
    ),
    Declared(
        "lens_prior", "cameras.ID.lens.prior.PARAMETER",
        "A free parameter that is known beforehand, from a calibration certificate: { value = 1600.0, sigma = 2.0 }.",
        (
            Key("value", "number", "the mean", REQUIRED),
            Key("sigma", "number", "of it; required unless prior_covariance is given", positive=True),
        ),
    ),
    Declared(
        "lens_tie", "cameras.ID.lens.tie.PARAMETER",
        "A parameter that is factor times another one: fy = { to = \"fx\" } makes pixels square.",
        (
            Key("to", "text", "the other parameter, which is not tied itself", REQUIRED),
            Key("factor", "number", "times which", 1.0),
        ),
    ),
    Declared(
        "station", "stations.ID", "A rigid body: a head, a tripod, a relay station, a robot's hand.",
        (
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
    ),
    Declared(
        "pose", "POSE", "A pose a_from_b: the origin of b in a, and the rotation from b to a. Where it is absent it is "
        "unknown and its start value is found.",
        (
            Key("treatment", "choice", "unknown, kept, or unknown with a prior at its value", "free",
                choices=("free", "held", "prior")),
            Key("translation_mm", "numbers", "the origin of b in a", size=(3,)),
            *_ROTATION,
            Key("sigma_translation_mm", "sigma", "of a prior, in the frame b; inf for unknown", size=(3,)),
            Key("sigma_rotation_deg", "sigma", "of a prior, about the axes of b; inf for unknown", size=(3,)),
            Key("sigma_rotation_arcsec", "sigma", "the same in arcseconds; give one of the two", size=(3,)),
            Key("covariance_rad_m", "matrix", "in place of sigmas: rotation rad, then translation m, in the frame b",
                size=(6,)),
            Key("held", "names", "components that keep their value, of a small motion in the frame b", choices=_SIX),
        ),
    ),
    Declared(
        "poses", "EPOCHS", "Poses by epoch: stations.head.epochs.e01 = { translation_mm = [0, 0, 1200] }.",
        free_keys=Key("EPOCH", "table", "the pose at this epoch", table="pose"),
    ),
    Declared(
        "turntable", "tables.ID", "A turntable of one or two axes; its readings are in table_angles.csv.",
        (
            Key("axes", "names", "outermost first, one or two of x, y, z", ["x", "z"], choices=_XYZ),
            Key("sigma_arcsec", "sigma", "of a reading where the table gives none, one or one per axis", size=(2,)),
            Key("world_from_table", "table", "its base in the world", table="pose"),
            Key("geometry", "table", "how its axes stand to each other", table="turntable_geometry"),
            Key("geometry_sigma", "table", "sigmas of priors at the values of geometry, under the same keys",
                table="turntable_sigma"),
            Key("harmonics", "table", "errors of its axes as they turn, up to which order (remedies.md)",
                table="harmonics"),
            Key("clock", "table", "when its axes are read; absent: at the epochs' times", table="clock"),
        ),
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
    Declared(
        "turntable_geometry", "tables.ID.geometry", "Two axes have all four parameters, one axis zero_1 alone.",
        (
            Key("free", "names", "which are unknown, harmonics too; of two axes the first two unless said"),
            Key("non_orthogonality_arcsec", "number", "what the angle between the axes has beyond 90 degrees", 0.0),
            Key("axis_offset_mm", "number", "shortest distance of the axes", 0.0),
            Key("zero_1_deg", "number", "reading of the first encoder at the table's zero", 0.0),
            Key("zero_2_deg", "number", "of the second", 0.0),
        ),
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
    Declared(
        "warp", "targets.ID.warp", "How the points of a board deviate from their nominal places (remedies.md).",
        (
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
    ),
    Declared(
        "point", "points.ID", "A point of the world; {} is an unknown one whose start value is found.",
        (
            Key("x_mm", "numbers", "coordinates; nan for one that is not known; as many as there are dimensions",
                size=(3,)),
            Key("treatment", "choice", "unknown, kept, or unknown with a prior at its value", "free",
                choices=("free", "held", "prior")),
            Key("held", "names", "coordinates that keep their value", choices=_XYZ),
            Key("sigma_mm", "sigma", "of a prior; inf for unknown", size=(3,)),
            Key("covariance_mm2", "matrix", "in place of sigma_mm", size=(3,)),
        ),
    ),
    Declared(
        "datum", "datum", "What fixes origin, orientation and scale where observations do not.",
        (
            Key("kind", "choice", "given: what is held or has a prior; inner: inner constraints", "given",
                choices=("given", "inner")),
            Key("points", "names", "inner: the points whose centre and mean turn are kept; default: all",
                refers="points"),
            Key("stations", "names", "inner: the stations that count too", refers="stations"),
        ),
    ),
    Declared(
        "sigmas", "sigmas", "Sigmas of observations.",
        (
            Key("image_px", "number", "of image points that have none in image_points.csv", positive=True),
            Key("scale", "table", "factors of the sigmas of groups: scale.GROUP", table="scale"),
        ),
    ),
    Declared(
        "scale", "sigmas.scale", "Group = factor of all its sigmas.",
        free_keys=Key("GROUP", "number", "factor", positive=True),
    ),
    Declared(
        "adjustment", "adjustment", "Tests and what a run may leave out.",
        (
            Key("alpha", "number", "probability of a false alarm, of each family of tests", 0.05, positive=True),
            Key("reject_blocks", "flag", "leave out a target in one image that fits nowhere", True),
            Key("reject_points", "flag", "leave out single image points", True),
            Key("reject_pairs", "flag", "leave out pairs and single observations of all other kinds", True),
            Key("variance_components", "flag", "estimate the variance of every group", False),
            Key("sigmas", "choice", "sigmas of results as the observations' own say, or scaled by sigma0; without it "
                "scaled", choices=("a_priori", "a_posteriori")),
            Key("pairs", "choice", "poses: pairs by the poses of their frames; closed: every loop of them closed, also "
                "of cameras and marker blocks of which nothing but pairs is known", "poses",
                choices=("poses", "closed")),
        ),
    ),
    Declared(
        "closure", "closures.NAME",
        "A loop of pairs that a mechanical mount closes, only as well as the mount repeats; needs pairs = \"closed\".",
        (
            Key("pairs", "names", "ids of the pairs as they are walked; the mount sits at end a of the last", REQUIRED),
            Key("sigma_arcsec", "number", "how well the mount repeats, about each axis", REQUIRED, positive=True),
            Key("sigma_mm", "number", "and along each axis, where pairs are poses", 0.0),
        ),
    ),
    Declared(
        "spots", "spots", "Bright spots that labsurvey detect looks for and adjust gives the names of points.",
        (
            Key("cameras", "names", "the cameras that see them", REQUIRED, refers="cameras"),
            Key("epochs", "names", "the epochs that show them; default: all"),
            Key("diameter_px", "numbers", "smallest, largest", [2.0, 12.0], size=(2,)),
            Key("gate_px", "number", "how far from its predicted place a spot may be", 15.0, positive=True),
        ),
    ),
    Declared(
        "vertical", "vertical", "The plumb line, which levels and levelled instruments follow.",
        (
            Key("up_in_world", "numbers", "unit vector", [0, 0, 1], size=(3,)),
            Key("radius_m", "number", "level surfaces are spheres of this radius; absent: planes", positive=True),
            *vector_keys_declared(
                TILT_UNITS,
                {"tilt_1": "turn of it about the first axis across it", "tilt_2": "and about the second"}, (),
            ),
        ),
    ),
    Declared(
        "bearings", "bearings", "How horizontal angles count.",
        (
            Key("zero", "choice", "the axis of the world that they count from", "y", choices=("x", "y")),
            Key("clockwise", "flag", "seen from above", True),
        ),
    ),
    Declared(
        "instrument", "instruments.ID", "An instrument: what its readings are worth, and its own corrections.",
        (
            *_ACCURACY,
            Key("sigma_distance_mm", "number", "of a distance: mm + ppm · d", positive=True),
            Key("sigma_distance_ppm", "number", "the part that grows with it", positive=True),
            Key("sigma_height_difference_mm", "number", "of one height difference", positive=True),
            Key("sigma_levelling_mm", "number", "per root of a kilometre of length_m, added in squares", positive=True),
            Key("sigma_target_centring_mm", "number", "of targets over points, one error per reading",
                positive=True),
            Key("sigma_centring_mm", "number", "of the instrument over its point, one error per set-up", positive=True),
            Key("sigma_height_mm", "number", "of its height, one error per set-up", positive=True),
            *vector_keys_declared(
                INSTRUMENT_UNITS,
                {"distance_offset": "added to distances", "distance_scale": "observed = offset + (1 + scale) · true",
                 "refraction": "coefficient; needs vertical.radius_m", "vertical_index": "of the vertical circle"},
                (),
            ),
        ),
    ),
    Declared(
        "setup", "setups.ID", "An instrument set up once: its directions share one orientation.",
        (
            Key("instrument", "text", "which", refers="instruments"),
            Key("levelled", "flag", "false: its axes are those of the station it stands on", True),
            Key("sigma_centring_mm", "number", "in place of the instrument's; 0 for none"),
            Key("sigma_height_mm", "number", "in place of the instrument's; 0 for none"),
        ),
    ),
    Declared(
        "beam", "beams.ID", "A laser fixed on the mount of a turntable or on a station; give one of the two.",
        (
            Key("mount", "text", "the turntable", refers="tables"),
            Key("station", "text", "or the station", refers="stations"),
            Key("axis", "choice", "the axis of it along which the beam runs, about", "z", choices=_XYZ),
            *vector_keys_declared(
                BEAM_UNITS,
                {"offset_1": "where it leaves the plane through the origin, along the next axis", "offset_2":
                 "and along the one after", "slope_1": "towards the next axis", "slope_2": "and the one after"},
                tuple(BEAM_UNITS),
            ),
        ),
    ),
    _surface("plane", Key("normal", "numbers", "about; needed where positions lie beside the plane", size=(3,))),
    _surface("line", Key("direction", "numbers", "about", size=(3,))),
    _surface("sphere", None),
    Declared(
        "temperatures", "temperatures_degC", "Epoch = temperature, where something is to expand with it.",
        free_keys=Key("EPOCH", "number", "degC"),
    ),
    Declared("times", "times_s", "Epoch = its time, s, from any beginning.", free_keys=Key("EPOCH", "number", "s")),
    Declared(
        "vector_sigma", "SIGMA", "Sigmas of priors, under the keys of the values.",
        free_keys=Key("KEY", "number", "sigma, in the unit of the key", positive=True),
    ),
    Declared(
        "align", "align.ID", "What labsurvey align says how to turn.",
        (
            Key("body", "text", "the frame that can be turned, such as target:board", REQUIRED),
            Key("onto", "text", "the frame whose axes it is to have, such as table:turntable", REQUIRED),
            *_ROTATION,
            Key("feet_mm", "table", "screws or edges, three or more, x and y in the body", table="feet"),
            Key("pitch_mm", "number", "of the screws", positive=True),
            Key("tolerance_arcsec", "number", "about each axis", positive=True),
        ),
    ),
    Declared(
        "feet", "align.ID.feet_mm", "Name = place: left = [0, 0].",
        free_keys=Key("NAME", "numbers", "x, y in the body, mm", size=(2,)),
    ),
    Declared(
        "tolerance", "tolerances.NAME", "A demand on results; labsurvey report --check obeys it.",
        (
            Key("of", "choice", "of what", REQUIRED, choices=(
                "points", "stations", "cameras", "lenses", "tables", "table_geometry", "targets")),
            Key("ids", "names", "whose; default: all"),
            Key("component", "text", "a component such as fx; absent: the whole position or rotation"),
            *(
                Key(name if unit == "1" else f"{name}_{unit}", "number", said, positive=name != "nominal")
                for name, said in (
                    ("expanded", "largest expanded uncertainty (95 %); give it in one unit"),
                    ("nominal", "of the component; needs a tolerance"),
                    ("tolerance", "deviation from nominal that is allowed, with the uncertainty (ISO 14253-1)"),
                )
                for unit in ("mm", "arcsec", "deg", "px", "1")
            ),
        ),
    ),
    Declared(
        "identification", "identification", "Name = text, shown at the head of the report in this order.",
        free_keys=Key("NAME", "text", "anything"),
    ),
)  # fmt: skip
_BY_NAME = {declared.name: declared for declared in DECLARATIONS}
_BY_ID = {  # the tables above those that stand under an id of the user's, as [cameras] is above [cameras.X]
    d.name: Declared(d.name, d.path.rpartition(".")[0], d.what, free_keys=Key("ID", "table", d.what, table=d.name))
    for d in DECLARATIONS if "." in d.path and d.path.rpartition(".")[2].isupper()
}  # fmt: skip


def declared(name: str) -> Declared:
    """The declaration of this name."""
    return _BY_NAME[name]


def below(table: Declared, key: str) -> Declared | None:
    """The declaration of what stands under a key; None where a word in it tells, as ``kind`` of a target."""
    if key in table.by_name:
        name = table.by_name[key].table
        return _BY_ID.get(name, _BY_NAME.get(name))
    return _BY_NAME.get(table.free_keys.table) if table.free_keys else None
