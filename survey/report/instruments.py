"""The section on the vertical, instruments, their setups, laser beams and surfaces."""

from typing import Any

from survey.report.context import Context
from survey.report.language import t
from survey.report.markup import esc, fixed, section
from survey.report.unknowns import vector_table


def instruments(c: Context) -> str:
    """What survey instruments, lasers and surfaces were found to be."""
    parts = []
    vertical = c.solution.get("vertical")
    if vertical is not None:
        body = vector_table(vertical["tilt"]) if "tilt" in vertical else ""
        parts.append(f"<h3>{t('Vertical')}</h3>{_vector(t('upwards in the world'), vertical['up_in_world'])}{body}")
    for instrument_id, entry in c.solution.get("instruments", {}).items():
        parts.append(f"<h3>{t('Instrument')} {esc(instrument_id)}</h3>{vector_table(entry)}")
    for setup_id, entry in c.solution.get("setups", {}).items():
        of = f" ({esc(entry['instrument'])})" if "instrument" in entry else ""
        tables = "".join(vector_table(entry[kind]) for kind in ("orientation", "centring") if kind in entry)
        parts.append(f"<h3>{t('Setup')} {esc(setup_id)}{of}</h3>{tables}")
    for beam_id, entry in c.solution.get("beams", {}).items():
        carrier = next(f"{kind} {entry[kind]}" for kind in ("mount", "station") if kind in entry)
        head = f"{t('Laser beam')} {esc(beam_id)} ({esc(carrier)}, {t('along')} {esc(entry['axis'])})"
        parts.append(f"<h3>{head}</h3>{vector_table(entry['parameters'])}")
    for surface_id, entry in c.solution.get("surfaces", {}).items():
        key = next((k for k in ("normal", "direction") if k in entry), None)
        line = _vector(t(key), entry[key]) if key else ""
        parts.append(f"<h3>{t(entry['kind'])} {esc(surface_id)}</h3>{line}{vector_table(entry['parameters'])}")
    return section("instruments", "Instruments and surfaces", "".join(parts))


def _vector(what: str, components: list[Any]) -> str:
    return f'<p class="note">{what}: ({", ".join(fixed(x, 6) for x in components)})</p>'
