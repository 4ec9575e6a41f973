"""The lens of a camera in ``survey.toml``."""


import numpy as np

from adjust.lenses.models import MODELS
from adjust.model.survey import FloatArray, ImageCrop, LensDrift, LensParameter, LensSharing, Tie, VectorPrior
from survey.project.declared.bodies import CROP_UNITS
from survey.project.declared.node import Node
from survey.project.declared.toml_text import in_units
from survey.project.declared.vectors import read_vector, vector_to_toml
from survey.project.tables.covariance import covariance_problem

# Without these a lens images nothing: they are never zero by silence.
_ESSENTIAL = {
    "brown": ("fx", "fy", "u0", "v0"),
    "fisheye": ("fx", "fy", "u0", "v0"),
    "brown_backward": ("c",),
    "brown_backward_dbat": ("c", "px", "py"),
    "aicon": ("ck",),
}


def read_lens(node: Node) -> LensParameter:
    """The table [cameras.*.lens]."""
    model = node.choice("model", MODELS)
    names = MODELS[model].names
    free = node.references("free", names, f"parameter of the model {model}")
    ties = _ties(node, names, free)
    values = _values(node, model, names, free, ties)
    pixel_size_mm = node.number("pixel_size_mm") if node.has("pixel_size_mm") else None
    if MODELS[model].in_mm and pixel_size_mm is None:
        raise node.error(f"pixel_size_mm is missing; the model {model} is in millimetres", "pixel_size_mm")
    drift = _drift(node.table("drift"), free) if node.has("drift") else None
    balance = _balance(node, model)
    shared = _shared(node.table("shared"), free) if node.has("shared") else None
    crops = {epoch: _crop(crop) for epoch, crop in node.tables("crops")}
    prior = _prior(node, names, free)
    return LensParameter(model, free, values, prior, ties, pixel_size_mm, balance, drift, shared, crops)


def _shared(node: Node, free: tuple[str, ...]) -> LensSharing | None:
    """None where it names no parameter."""
    camera, parameters = node.text("camera"), node.references("parameters", free, "free parameter", free)
    return LensSharing(camera, parameters) if parameters else None


def _crop(node: Node) -> ImageCrop:
    parameters = read_vector(node, CROP_UNITS, (), np.array([1.0, 0.0, 0.0]))
    if parameters.values[0] <= 0.0:
        raise node.error(f"found {parameters.values[0]:g}; the scale must be positive", "scale")
    return ImageCrop(parameters, read_size(node, "size_px") if node.has("size_px") else None)


def read_size(node: Node, key: str) -> tuple[int, int]:
    """Width and height of an image, px."""
    width, height = node.numbers(key, (2,))
    if min(width, height) < 1 or width % 1 or height % 1:
        raise node.error(f"found [{width:g}, {height:g}]; expected whole numbers, [width, height]", key)
    return int(width), int(height)


def _drift(node: Node, free: tuple[str, ...]) -> LensDrift:
    parameters = node.references("parameters", free, "free parameter")
    if not parameters:
        raise node.error("names no parameter; give some of free, or remove the table", "parameters")
    begins, steps = node.names("begins"), node.table("sigma")
    reference = node.number("reference_degC")
    if node.flag("with_temperature"):
        if begins or steps.values:
            raise node.error("a change with the temperature has no blocks; remove begins and sigma", "with_temperature")
        return LensDrift(parameters, (), None, reference)
    if not begins:
        raise node.error("name the epochs at which a new block begins, or write with_temperature = true", "begins")
    steps.allow(*parameters)
    if not steps.values:
        return LensDrift(parameters, begins)
    return LensDrift(parameters, begins, np.array([steps.number(name) for name in parameters]))


def _balance(node: Node, model: str) -> float:
    """The radius where AICON's radial distortion is zero, mm."""
    if node.has("balance_radius_mm") and model != "aicon":
        raise node.error('only the model "aicon" has a balance radius; remove it', "balance_radius_mm")
    return node.number("balance_radius_mm")


def _values(
    node: Node, model: str, names: tuple[str, ...], free: tuple[str, ...], ties: tuple[Tie, ...]
) -> FloatArray | None:
    table = node.table("values")
    table.allow(*names, what="lens parameter")
    tied = {tie.name for tie in ties}
    for name in _ESSENTIAL[model]:
        if name in table.values or name in tied or (not table.values and name in free):
            continue
        raise table.error(f"{name!r} has no value; give it here" + ("" if table.values else " or make it free"), name)
    if not table.values:
        return None
    return np.array([table.number(name, 0.0) for name in names])


def _prior(node: Node, names: tuple[str, ...], free: tuple[str, ...]) -> VectorPrior | None:
    table = node.table("prior")
    table.allow(*names, what="lens parameter")
    if not table.values:
        return None
    has_matrix = node.has("prior_covariance")
    means, sigmas = [], []
    for name in table.values:
        if name not in free:
            raise table.error("has a prior but is not free; add it to 'free' or remove the prior", name)
        entry = table.table(name)
        means.append(entry.number("value"))
        if has_matrix and entry.has("sigma"):
            raise entry.error("prior_covariance is given too; keep one of the two", "sigma")
        if not has_matrix:
            if not entry.has("sigma"):
                raise entry.error("a prior needs its sigma; add it")
            sigmas.append(entry.number("sigma"))
    k = len(means)
    cov = node.numbers("prior_covariance", (k, k)) if has_matrix else np.diag(np.array(sigmas) ** 2)
    problem = covariance_problem(cov[None])
    if problem:
        raise node.error(f"{problem[1]}; correct the matrix", "prior_covariance")
    return VectorPrior(tuple(table.values), np.array(means), cov)


def _ties(node: Node, names: tuple[str, ...], free: tuple[str, ...]) -> tuple[Tie, ...]:
    table = node.table("tie")
    table.allow(*names, what="lens parameter")
    ties = []
    for name in table.values:
        entry = table.table(name)
        to = entry.reference("to", names, "lens parameter")
        if to == name or to in table.values:
            raise entry.error(f"{to!r} is tied itself; tie to a parameter that is not", "to")
        if name in free:
            raise table.error("is tied and free; remove it from 'free' or remove the tie", name)
        ties.append(Tie(name, to, entry.number("factor")))
    return tuple(ties)


def lens_to_toml(lens: LensParameter) -> dict[str, object]:
    """The table that ``read_lens`` reads."""
    names, prior = MODELS[lens.model].names, lens.prior
    table: dict[str, object] = {"model": lens.model, "free": list(lens.free)}
    if lens.values is not None:
        table["values"] = dict(zip(names, lens.values.tolist(), strict=True))
    if prior is not None:
        alone = not (prior.cov - np.diag(np.diagonal(prior.cov))).any()
        rows = zip(prior.names, prior.mean.tolist(), np.sqrt(np.diagonal(prior.cov)).tolist(), strict=True)
        table["prior"] = {name: {"value": x} | ({"sigma": sigma} if alone else {}) for name, x, sigma in rows}
        table |= {} if alone else {"prior_covariance": prior.cov.tolist()}
    if lens.pixel_size_mm is not None:
        table["pixel_size_mm"] = lens.pixel_size_mm
    if lens.balance_radius_mm:
        table["balance_radius_mm"] = lens.balance_radius_mm
    shared, crops = lens.shared, lens.crops.items()
    return table | in_units(
        tie={tie.name: {"to": tie.to, "factor": tie.factor} for tie in lens.ties},
        drift=None if lens.drift is None else _drift_to_toml(lens.drift),
        shared=None if shared is None else {"camera": shared.camera_id, "parameters": list(shared.parameters)},
        crops={epoch: vector_to_toml(crop.parameters, CROP_UNITS, f"crop at epoch {epoch}")
               | in_units(size_px=crop.size) for epoch, crop in crops},
    )  # fmt: skip


def _drift_to_toml(drift: LensDrift) -> dict[str, object]:
    out: dict[str, object] = {"parameters": list(drift.parameters)}
    if drift.reference_temperature is not None:
        return out | {"with_temperature": True, "reference_degC": drift.reference_temperature}
    steps = () if drift.step_sigmas is None else zip(drift.parameters, drift.step_sigmas.tolist(), strict=True)
    return out | {"begins": list(drift.begins)} | in_units(sigma=dict(steps))
