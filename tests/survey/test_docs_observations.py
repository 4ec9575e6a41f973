"""The page on observations: its examples are one project, and it names every table, column and key there is."""

import re
from pathlib import Path

import pytest

from survey import project as files
from survey.project.declared.declarations import INSTRUMENT_UNITS, SURFACE_UNITS, declared
from survey.project.declared.vectors import vector_keys
from survey.project.tables.layouts import LAYOUTS

PAGE = Path(__file__).parents[2] / "docs" / "observations.md"
NEW = ("terrestrial", "terrestrial_covariance", "coordinate_differences", "coordinate_differences_covariance", "levels",
       "alignments", "laser_spots", "on_surfaces", "coordinates")  # fmt: skip


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> files.Project:
    folder, text = tmp_path_factory.mktemp("page"), PAGE.read_text(encoding="utf-8")
    (folder / "observations").mkdir()
    definition = "\n".join(re.findall(r"```toml\n(.*?)```", text, re.DOTALL))
    (folder / "survey.toml").write_text(definition, encoding="utf-8")
    for name, rows in re.findall(r"```csv (\w+)\n(.*?)```", text, re.DOTALL):
        (folder / "observations" / f"{name}.csv").write_text(rows, encoding="utf-8")
    return files.read(folder)


def test_the_examples_are_one_project(project: files.Project) -> None:
    survey = project.survey
    counts = {name: len(getattr(survey, name)) for name in
              ("readings", "reading_covariances", "levels", "alignments", "laser_spots", "on_surfaces", "beams",
               "surfaces", "instruments", "setups", "coordinate_differences", "coordinates")}  # fmt: skip
    assert counts == {"readings": 7, "reading_covariances": 1, "levels": 5, "alignments": 2, "laser_spots": 2,
                      "on_surfaces": 4, "beams": 1, "surfaces": 3, "instruments": 2, "setups": 2,
                      "coordinate_differences": 1, "coordinates": 1}  # fmt: skip
    assert project.alignment_tasks[0].task_id == "board"
    # 0.1 mm, and 0.3 mm per root kilometre over 45 m
    assert survey.readings[[r.reading_id for r in survey.readings].index("h1")].sigma == pytest.approx(
        1e-3 * (0.1**2 + 0.3**2 * 0.045) ** 0.5
    )


def test_every_column_and_key_is_named() -> None:
    text = PAGE.read_text(encoding="utf-8")
    columns = {c for name in NEW for c in LAYOUTS[name].columns}
    # families of columns that the page writes with a star, or in one row for all units
    stems = ("value_", "sigma_", "rho_")
    missing = {c for c in columns if c not in text and not c.startswith(stems) and not c.endswith(("_height_m",))}
    assert missing == set()
    keys = {k for units in (INSTRUMENT_UNITS, *SURFACE_UNITS.values()) for k in vector_keys(units)}
    assert {k for k in keys if k not in text} == set()
    assert {k for k in declared("instrument").by_name if k.rsplit("_", 1)[0] not in text} == set()
    for name in LAYOUTS:
        if name in NEW:
            assert name in text
