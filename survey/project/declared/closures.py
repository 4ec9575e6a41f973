"""How pairs are adjusted: ``[adjustment] pairs`` and the tables [closures.NAME] of ``survey.toml``."""

from typing import Literal

from adjust.model.observations import Closure
from survey.folder.units import from_si, to_si
from survey.project.declared.declarations import keys_of
from survey.project.declared.node import Node
from survey.project.declared.toml_text import Section

FORMS: tuple[Literal["poses", "closed"], ...] = ("poses", "closed")


def read_closures(root: Node) -> tuple[Literal["poses", "closed"], tuple[Closure, ...]]:
    """The form and all mounts, in the order of the file. Raises SurveyError."""
    asked = root.table("adjustment").choice("pairs", FORMS, FORMS[0])
    form = next(f for f in FORMS if f == asked)
    closures = tuple(_read(name, node) for name, node in root.tables("closures"))
    if closures and form != "closed":
        raise root.table("closures").error('a mount closes a loop only where loops are; write [adjustment] pairs = '
                                           '"closed"', closures[0].closure_id)  # fmt: skip
    return form, closures


def _read(name: str, node: Node) -> Closure:
    node.allow(*keys_of("closure"))
    along = node.number("sigma_mm", 0.0)
    if along < 0.0:
        raise node.error(f"found {along:g}; a sigma is not negative", "sigma_mm")
    about = node.number("sigma_arcsec", positive=True)
    return Closure(name, node.names("pairs"), float(to_si(about, "arcsec")), float(to_si(along, "mm")))


def closure_sections(closures: tuple[Closure, ...]) -> list[Section]:
    """The inverse of :func:`read_closures`."""
    return [
        (("closures", c.closure_id), {
            "pairs": c.pair_ids, "sigma_arcsec": float(from_si(c.rotation_sigma, "arcsec")),
            "sigma_mm": float(from_si(c.translation_sigma, "mm")),
        })
        for c in closures
    ]  # fmt: skip
