"""The one walk over a survey's parameters: every name once, and nothing but what is asked for changes."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3

from adjust.design.noise import disturbed
from adjust.graph.building import GraphBuilder
from adjust.model.result import ParameterName
from adjust.model.rewriting import Rewriting, Vector, vector_parameters, with_changed, with_rows
from adjust.model.survey import (
    Beam,
    Camera,
    Clock,
    ImageCrop,
    LensParameter,
    PointParameter,
    PoseParameter,
    Station,
    Surface,
    Survey,
    Table,
    VectorParameter,
    VectorPrior,
)
from survey.simulate import full_lab
from tests.adjust import helpers as h


class Names(Rewriting):
    """Puts free poses at the origin, and notes all names."""

    def __init__(self) -> None:
        self.seen: list[ParameterName] = []

    def vector(self, name: ParameterName, given: Vector) -> Vector:
        self.seen.append(name)
        return given

    def pose(self, name: ParameterName, given: PoseParameter) -> PoseParameter:
        self.seen.append(name)
        return replace(given, value=Pose3(np.eye(4))) if given.treatment == "free" else given

    def point(self, name: ParameterName, given: PointParameter) -> PointParameter:
        self.seen.append(name)
        return given

    def epochs(
        self, name: ParameterName, given: Mapping[str, PoseParameter], usual: PoseParameter
    ) -> Mapping[str, PoseParameter]:
        return super().epochs(name, {**given, "later": usual}, usual)


@pytest.mark.slow
def test_every_parameter_is_met_once_under_the_name_of_its_unknown() -> None:
    survey, truth = full_lab(1)
    start, names = h.start_at(truth), Names()
    changed = names(survey)
    assert len(set(names.seen)) == len(names.seen)
    unknowns = GraphBuilder(survey, start.lenses).build(start).unknowns.by_name
    of_owners = {n[:2] for n in unknowns if n[0] not in ("table_angles", "orientation")}
    assert of_owners <= {n[:2] for n in names.seen}
    assert all("later" in s.epochs for s in changed.stations)
    free = [t.carrier_from_target for t in survey.targets if t.carrier_from_target.treatment == "free"]
    moved = [t.carrier_from_target.value for t in changed.targets if t.carrier_from_target.treatment == "free"]
    assert len(free) == len(moved) > 0
    assert all(np.array_equal(m.matrix(), np.eye(4)) for m in moved if m is not None)
    assert changed.image_blocks is survey.image_blocks
    assert all(a.lens is b.lens for a, b in zip(changed.cameras, survey.cameras, strict=True))
    assert all(a.x_in_world is b.x_in_world for a, b in zip(changed.points, survey.points, strict=True))


def test_beams_and_surfaces_are_met_and_a_surface_without_parameters_stays() -> None:
    known = Surface("s1", "plane", parameters=VectorParameter(("tilt_1",), np.zeros(1)))
    names = Names()
    changed = names(Survey(beams=(Beam("b", "station", "s"),), surfaces=(known, Surface("s2", "line"))))
    assert names.seen == [("beam", "b"), ("surface", "s1"), ("vertical",)]
    assert changed.surfaces[1].parameters is None


def test_crops_and_clocks_are_met_and_their_priors_drawn() -> None:
    """Beside what they belong to; their priors are observations as those of everything else are."""
    known = VectorPrior(("offset",), np.zeros(1), np.eye(1))
    late = Clock(VectorParameter(("offset",), np.zeros(1), ("offset",), known))
    shifted = VectorParameter(("left",), np.zeros(1), ("left",), replace(known, names=("left",)))
    lens = LensParameter("pinhole", (), crops={"e1": ImageCrop(shifted)})
    survey = Survey(cameras=(Camera("c", "s", (640, 480), lens, clock=late),), stations=(Station("s", clock=late),),
                    tables=(Table("t", clock=late),))  # fmt: skip
    names = Names()
    names(survey)
    assert set(vector_parameters(survey)) <= set(names.seen)
    wanted = {("lens_crop", "c", "e1"), ("camera_clock", "c"), ("pose_clock", "s"), ("table_clock", "t")}
    assert wanted <= set(names.seen)
    drawn = vector_parameters(disturbed(survey, np.random.default_rng(1)))
    means = [prior.mean[0] for name in sorted(wanted) if (prior := drawn[name].prior) is not None]
    assert len(set(means) - {0.0}) == len(wanted)


def test_rows_and_things_are_changed_alone() -> None:
    tables = (Table("a"), Table("b"), Table("c"))
    survey = Survey(tables=tables)
    changed = with_changed(survey, "tables", "b", axes=("z",)).tables
    assert [t.axes for t in changed] == [tables[0].axes, ("z",), tables[2].axes]
    assert changed[0] is tables[0]
    assert changed[2] is tables[2]
    rows = with_rows(survey, "tables", {2: tables[0]}).tables
    assert all(a is b for a, b in zip(rows, (tables[0], tables[1], tables[0]), strict=True))
