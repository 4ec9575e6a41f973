"""What a project holds, counted for people."""

from collections.abc import Iterable

from adjust.model import Survey

_SEVERAL = {"table_readings": "table readings", "reading_covariances": "covariances of readings",
            "coordinate_differences": "coordinate differences", "laser_spots": "laser spots",
            "on_surfaces": "points on surfaces"}  # fmt: skip
_OBSERVED = ("table_readings", "pairs", "distances", "coordinates", "readings", "coordinate_differences", "levels",
             "alignments", "laser_spots", "on_surfaces")  # fmt: skip
_OWNERS = ("cameras", "stations", "tables", "targets", "points", "instruments", "setups", "beams", "surfaces")


def observed(survey: Survey, n_spots: int) -> dict[str, int]:
    """How many observations of each kind there are; n_spots: those that are still to be identified."""
    found = {"image points": sum(len(b.uv) for b in survey.image_blocks), "images": len(
        {(b.camera_id, b.epoch_id) for b in survey.image_blocks})}  # fmt: skip
    found |= {_SEVERAL.get(name, name): len(getattr(survey, name)) for name in _OBSERVED}
    found["spots to identify"] = n_spots
    return {name: n for name, n in found.items() if n}


def owners(survey: Survey) -> dict[str, int]:
    """How many cameras, stations, points ... there are."""
    return {name: len(getattr(survey, name)) for name in _OWNERS if getattr(survey, name)}


def contents(survey: Survey, n_spots: int) -> list[tuple[str, str]]:
    """What is observed, of what, in which datum: names and texts of a table."""
    return [("observed", _counted(observed(survey, n_spots))), ("of", _counted(owners(survey))),
            ("datum", survey.datum.kind)]  # fmt: skip


def _counted(found: dict[str, int]) -> str:
    return ", ".join(f"{n} {name if n != 1 else name.removesuffix('s')}" for name, n in found.items()) or "nothing"


def lines_text(lines: Iterable[tuple[str, str]]) -> list[str]:
    """The table as lines of a text."""
    return [f"  {name:<9} {said}" for name, said in lines]
