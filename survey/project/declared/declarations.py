"""Every table of ``survey.toml`` with its keys: what readers allow, what the reference says, what editors complete."""

from survey.project.declared.bodies import AXES, BODIES, ROTATION
from survey.project.declared.keys import REQUIRED, Declared, Key, declare, vector_keys_declared

_SIGMA_ARCSEC = ("arcsec", "mgon", "cc", "deg")

TILT_UNITS = {"tilt_1": "arcsec", "tilt_2": "arcsec"}
INSTRUMENT_UNITS = {
    "distance_offset": "mm", "distance_scale": "ppm", "refraction": "1", "vertical_index": "arcsec",
}  # fmt: skip
BEAM_UNITS = {"offset_1": "mm", "offset_2": "mm", "slope_1": "1", "slope_2": "1"}
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


_ACCURACY = tuple(
    Key(f"sigma_{name}_{unit}", "number", f"of one {name} reading; give it in one unit", positive=True)
    for name in ("direction", "angle", "zenith", "azimuth")
    for unit in _SIGMA_ARCSEC
)

DECLARATIONS: tuple[Declared, ...] = (
    declare(
        "root", "", "The keys before the first table.",
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
    *BODIES,
    declare(
        "datum", "datum", "What fixes origin, orientation and scale where observations do not.",
        Key("kind", "choice", "given: what is held or has a prior; inner: inner constraints", "given",
            choices=("given", "inner")),
        Key("points", "names", "inner: the points whose centre and mean turn are kept; default: all",
            refers="points"),
        Key("stations", "names", "inner: the stations that count too", refers="stations"),
    ),
    declare(
        "sigmas", "sigmas", "Sigmas of observations.",
        Key("image_px", "number", "of image points that have none in image_points.csv", positive=True),
        Key("scale", "table", "factors of the sigmas of groups: scale.GROUP", table="scale"),
    ),
    Declared(
        "scale", "sigmas.scale", "Group = factor of all its sigmas.",
        free_keys=Key("GROUP", "number", "factor", positive=True),
    ),
    declare(
        "adjustment", "adjustment", "Tests and what a run may leave out.",
        Key("alpha", "number", "probability of a false alarm, of each family of tests", 0.05, positive=True),
        Key("alpha0", "number", "level of one test of one component instead (Baarda's B-method), for minimal "
            "detectable biases and external reliability", positive=True),
        Key("power", "number", "probability with which a minimal detectable bias is found", 0.8, positive=True),
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
    declare(
        "closure", "closures.NAME",
        "A loop of pairs that a mechanical mount closes, only as well as the mount repeats; needs pairs = \"closed\".",
        Key("pairs", "names", "ids of the pairs as they are walked; the mount sits at end a of the last", REQUIRED),
        Key("sigma_arcsec", "number", "how well the mount repeats, about each axis", REQUIRED, positive=True),
        Key("sigma_mm", "number", "and along each axis, where pairs are poses", 0.0),
    ),
    declare(
        "spots", "spots", "Bright spots that labsurvey detect looks for and adjust gives the names of points.",
        Key("cameras", "names", "the cameras that see them", REQUIRED, refers="cameras"),
        Key("epochs", "names", "the epochs that show them; default: all"),
        Key("diameter_px", "numbers", "smallest, largest", [2.0, 12.0], size=(2,)),
        Key("gate_px", "number", "how far from its predicted place a spot may be", 15.0, positive=True),
    ),
    declare(
        "vertical", "vertical", "The plumb line, which levels and levelled instruments follow.",
        Key("up_in_world", "numbers", "unit vector", [0, 0, 1], size=(3,)),
        Key("radius_m", "number", "level surfaces are spheres of this radius; absent: planes", positive=True),
        *vector_keys_declared(
            TILT_UNITS,
            {"tilt_1": "turn of it about the first axis across it", "tilt_2": "and about the second"}, (),
        ),
    ),
    declare(
        "bearings", "bearings", "How horizontal angles count.",
        Key("zero", "choice", "the axis of the world that they count from", "y", choices=("x", "y")),
        Key("clockwise", "flag", "seen from above", True),
    ),
    declare(
        "instrument", "instruments.ID", "An instrument: what its readings are worth, and its own corrections.",
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
    declare(
        "setup", "setups.ID", "An instrument set up once: its directions share one orientation.",
        Key("instrument", "text", "which", refers="instruments"),
        Key("levelled", "flag", "false: its axes are those of the station it stands on", True),
        Key("sigma_centring_mm", "number", "in place of the instrument's; 0 for none"),
        Key("sigma_height_mm", "number", "in place of the instrument's; 0 for none"),
    ),
    declare(
        "beam", "beams.ID", "A laser fixed on the mount of a turntable or on a station; give one of the two.",
        Key("mount", "text", "the turntable", refers="tables"),
        Key("station", "text", "or the station", refers="stations"),
        Key("axis", "choice", "the axis of it along which the beam runs, about", "z", choices=AXES),
        *vector_keys_declared(
            BEAM_UNITS,
            {"offset_1": "where it leaves the plane through the origin, along the next axis", "offset_2":
             "and along the one after", "slope_1": "towards the next axis", "slope_2": "and the one after"},
            tuple(BEAM_UNITS),
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
    declare(
        "align", "align.ID", "What labsurvey align says how to turn.",
        Key("body", "text", "the frame that can be turned, such as target:board", REQUIRED),
        Key("onto", "text", "the frame whose axes it is to have, such as table:turntable", REQUIRED),
        *ROTATION,
        Key("feet_mm", "table", "screws or edges, three or more, x and y in the body", table="feet"),
        Key("pitch_mm", "number", "of the screws", positive=True),
        Key("tolerance_arcsec", "number", "about each axis", positive=True),
    ),
    Declared(
        "feet", "align.ID.feet_mm", "Name = place: left = [0, 0].",
        free_keys=Key("NAME", "numbers", "x, y in the body, mm", size=(2,)),
    ),
    declare(
        "tolerance", "tolerances.NAME", "A demand on results; labsurvey report --check obeys it.",
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
