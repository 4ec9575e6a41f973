"""Catalogues of languages against the texts of the program: nothing is missing, nothing stale, nothing in code."""

import ast
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from itertools import product
from pathlib import Path
from typing import get_args

import pytest
from jinja2 import Environment, nodes

import adjust
import survey
from adjust.model import observations
from adjust.model.result import Decision
from adjust.relay.loops import LoopKind, loop_basis
from adjust.relay.network import topology
from adjust.statistics.result import Alternative
from survey.batch.record import CAUSES
from survey.project.tables.terrestrial import READING_KINDS
from survey.report.language import (
    GROUPS_BY_KIND,
    LANGUAGES,
    MissingTranslationError,
    catalogue,
    group_name,
    message,
    speaking,
    t,
    text_said,
)

SURVEY, ADJUST = (Path(str(package.__file__)).parent for package in (survey, adjust))
PAGES = (*SURVEY.glob("report/**/*.py"), *SURVEY.glob("batch/*.py"))  # what is said in the reader's language
TEMPLATES = SURVEY / "report" / "templates"
TERMINAL = {"beforehand", "between.py", "trajectory.py"}
"""What speaks on a terminal alone, of the diagnosis."""
NAMES = """angles from another zero|axes or unit of given coordinates|axis of a table runs out|cameras exchanged
cameras not simultaneous|clock drift|clock offset|correlated observations|encoder of a table|epochs exchanged
epochs shifted|epochs without partners|focus touched|gear ratio|gear ratio of axis 7|given points exchanged
images copied|images mirrored
images of another camera|images resized|images shifted|images turned|instrument height|left-handed frames|lens drifts
motion forgotten|odd sigma|order of Euler angles|order of quaternions|pairs inverted|pixel origin|point moved
points exchanged|prism constant|rolling shutter|rotations inverted|rows and columns|rows of another set-up
sense of rotation|set-up turned|shift in other axes|sigmas of a group|sign of height differences|slipped decimal
station moved|stations exchanged|table moved|targets exchanged|the same twice|unit of angles|body of 7
unit of Euler angles|table misread|sign of an axis|reading mistyped|readings exchanged|points misnumbered
directions of the second face|kind of distances
unit of heights|unit of lengths|unit of shifts|unit of sigmas"""
"""Kinds of causes and marks of lines, by which programs tell them apart: shown to nobody."""
OTHERS = [language for language in LANGUAGES if language != "en"]


def literals(paths: tuple[Path, ...]) -> set[str]:
    """All literal texts, those within f-strings piece by piece."""
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in paths)
    return {
        node.value for tree in trees for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }  # fmt: skip


def said_by_templates() -> set[str]:
    """What ``t`` is called with in templates."""
    out = set()
    for path in TEMPLATES.glob("*.html"):
        for call in Environment().parse(path.read_text(encoding="utf-8")).find_all(nodes.Call):
            if isinstance(call.node, nodes.Name) and call.node.name == "t" and isinstance(call.args[0], nodes.Const):
                out.add(call.args[0].value)
    return out


def said_by_pages() -> Iterator[str]:
    """What ``t`` and ``section`` are called with, headings of tables, titles of the sections."""
    at = {"t": 0, "section": 1}
    for path in PAGES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in at and node.args:
                text = node.args[at[node.func.id]]
                if isinstance(text, ast.Constant) and isinstance(text.value, str):
                    yield text.value
            if isinstance(node, ast.Assign) and any(getattr(x, "id", "").lower() == "columns" for x in node.targets):
                words = (x.value for x in ast.walk(node.value) if isinstance(x, ast.Constant))
                yield from (x.removeprefix("<") for x in words if isinstance(x, str) and re.search(r"[A-Za-z]{4}", x))


@pytest.mark.parametrize("language", OTHERS)
def test_every_text_has_its_translation(language: str) -> None:
    wanted = {*said_by_pages(), *said_by_templates(), *CAUSES.values()}
    assert len(wanted) > 250
    assert wanted - set(catalogue(language).texts) == set()


@pytest.mark.slow
@pytest.mark.parametrize("language", OTHERS)
def test_nothing_stale_remains(language: str) -> None:
    near = literals(PAGES)
    far = literals((*SURVEY.rglob("*.py"), *ADJUST.rglob("*.py")))
    used = near | {x.removeprefix("<") for x in near} | said_by_templates() | {x.replace("_", " ") for x in far}
    assert set(catalogue(language).texts) - used == set()
    everything = "\n".join(far)
    sentences = catalogue(language).sentences
    for sentence in [*sentences, *catalogue(language).cells.keys() - catalogue(language).texts.keys()]:
        words = max(re.split(r"\{[nw]?\}|[^A-Za-z' ]", sentence), key=len).split()
        assert all(word in everything for word in words), sentence
    for pattern, _ in catalogue(language).messages[len(sentences) :]:
        words = re.findall(r"[a-z][a-z' ]+[a-z']", re.sub(r"\((?:\?:)?[^()]*(?<!\\)\)|\\S", "|", pattern))
        assert " ".join(max(words, key=len).split()[-4:]) in everything, pattern


@pytest.mark.parametrize("language", OTHERS)
def test_translations_take_what_the_texts_give(language: str) -> None:
    for english, said in catalogue(language).texts.items():
        assert set(re.findall(r"\{(\w+)\}", english)) == set(re.findall(r"\{(\w+)\}", said)), english
        assert re.findall(r"<[^>]*>", english) == re.findall(r"<[^>]*>", said), english
    for pattern, said in catalogue(language).messages:
        assert re.compile(pattern).groups == said.count("{}"), pattern


def ways(node: ast.AST | None) -> list[str]:
    """What a text may be: every choice within it, and 7 for a value."""
    if isinstance(node, ast.JoinedStr):
        return ["".join(parts) for parts in product(*map(ways, node.values))]
    if isinstance(node, ast.FormattedValue):
        return ways(node.value)
    if isinstance(node, ast.IfExp):
        return ways(node.body) + ways(node.orelse)
    if isinstance(node, ast.BinOp) and isinstance(node.left, ast.Constant) and isinstance(node.left.value, str):
        return ["", node.left.value]  # as often as a condition holds
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return [re.sub(r"\{[^{}]+\}|\{\}", "7", node.value)]
    return ["7"]


def said_by_diagnosis() -> set[str]:
    """Sentences of causes and remedies, and what they are put together from."""
    out = set()
    for path in ADJUST.glob("diagnosis/**/*.py"):
        if not TERMINAL & set(path.parts):
            out |= set(_said(ast.parse(path.read_text(encoding="utf-8"))))
    out = {re.sub("(?<=says)7", ": 7", re.sub("7(?=[a-z])", "7 ", x)) for x in out}  # values with signs of their own
    return {x for x in out if re.search("[A-Za-z]{2,} [a-z]{2,}", x)} - set(re.split(r"[|\n]", NAMES))


def _said(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.JoinedStr | ast.Constant):
        yield from (text.strip(" ;:,") for text in ways(node))
    elif not isinstance(node, ast.Raise) and not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
        for child in ast.iter_child_nodes(node):
            yield from _said(child)


@pytest.mark.slow
@pytest.mark.parametrize("language", OTHERS)
def test_causes_and_remedies_have_their_translation(language: str) -> None:
    said = said_by_diagnosis()
    assert len(said) > 150
    with speaking(language):
        assert {x for x in said if message(x) == x} == set()
        assert {x for x in map(message, said) if re.search(r"\b(the|is|are|its|of|and|or|to|from|them)\b", x)} == set()


def test_a_text_that_is_missing_is_a_bug() -> None:
    with speaking("de"), pytest.raises(MissingTranslationError):
        t("no such text")


def test_values_in_a_text_are_text() -> None:
    assert t("Close no loop: {names}", names="<b>") == "Close no loop: &lt;b&gt;"


def test_groups_named_after_their_kind_are_said_in_the_language_and_others_as_they_are() -> None:
    named = {
        field.default
        for kind in vars(observations).values() if is_dataclass(kind)
        for field in fields(kind) if field.name == "group"
    }  # fmt: skip
    assert {"image", "distance", "coordinates"} <= named
    assert named | set(READING_KINDS) <= GROUPS_BY_KIND
    with speaking("de"):
        assert group_name("slope_distance") == "Schrägstrecke"
        assert [x for x in GROUPS_BY_KIND if group_name(x) == x.replace("_", " ")] == []
        assert group_name("points") == "points"  # a name that people gave
    assert group_name("slope_distance") == "slope distance"


@pytest.mark.parametrize("language", OTHERS)
def test_warnings_of_an_adjustment_have_their_translation(language: str) -> None:
    """As they come; the words of each are looked for in the program by another test."""
    decision = Decision("rejected", "pair", "pair", ("A-B", "A", "B"), 40.0, 6, 1e-6, 22.5, 9.0, 1, "test")
    pair = Alternative((("pair", "A-B"),), (("pair", "C-D"),), 1.5)
    said = [
        decision.text(), f"fails its test, but cannot be left out: {decision.text().split(': ', 1)[1]}", pair.text(),
        "left out: pair A-B: off by 0.5 deg and 0.01 m, test 70.1, p 3e-12",
        "pair K10-E1 closes no loop: nobody would notice an error in it; measure a second way to what it leads to",
        "camera X: its distortion folds back at 700 px from the principal point, inside the observed 800 px; free "
        "fewer coefficients or cover the image better",
        "variance component of group image: sigmas were 0.10 times those given (factor 0.01 +- 0.001, p 1e-300)",
        "group pair: its typical observation contradicts the rest; sigmas 6.3 times as large explain that better than "
        "wrong observations do, and none was left out for it; check its units, the sense of its angles and the names "
        "in it",
    ]  # fmt: skip
    triangle = topology([("p", "A", "B"), ("q", "B", "C"), ("r", "C", "A")])
    said += [loop_basis(triangle, kind).note for kind in get_args(LoopKind)]
    with speaking(language):
        assert [x for x in said if message(x) == x] == []
        assert [x for x in map(message, said) if re.search(r"\b(the|is|are|its|of|and|or|to|from|off)\b", x)] == []


def test_german_messages_have_german_numbers() -> None:
    said = "Global test failed: residuals are 1.37 times what the sigmas of the observations allow. Look for errors."
    with speaking("de"):
        assert "das 1,37-fache" in message(said)
        assert "Epoche 1.5" in message("camera X at epoch 1.5, target board: not used")


def test_causes_are_said_in_the_language_part_by_part() -> None:
    said = ("probable cause: target board moves between epochs, but is said to stand still; write motion = \"epoch\" "
            "below [targets.board] in survey.toml (explains 97 % of the misfit, sigma0 becomes 1.02; survey.toml:14; "
            "--try 1)")
    with speaking("de"):
        assert message(said) == (
            "wahrscheinliche Ursache: Tafel board bewegt sich zwischen den Epochen, soll aber stillstehen; "
            "motion = \"epoch\" unter [targets.board] in survey.toml eintragen (erklärt 97 % der Widersprüche, "
            "sigma0 wird 1.02; survey.toml:14; --try 1)"
        )


def test_a_text_of_several_lines_is_said_with_its_columns() -> None:
    said = """a -> b: nothing to see
  ! no set of stable points was found; what is shown as motion depends on the datum

  group              observations  redundancy  smallest  median
  image                      4648      4497.3     0.093   0.980
  mine                          1         0.7     0.716   0.716
    station_from_camera.X.rx               72 arcsec required   83.8 arcsec planned   NOT MET"""
    with speaking("de"):
        assert text_said(said) == """a -> b: nothing to see
  ! keine Gruppe stabiler Punkte wurde gefunden; was als Bewegung gezeigt wird, hängt vom Datum ab

  Gruppe            Beobachtungen   Redundanz  kleinste  Median
  Bild                       4648      4497,3     0,093   0,980
  mine                          1         0,7     0,716   0,716
    station_from_camera.X.rx              72 arcsec gefordert   83,8 arcsec geplant  NICHT ERFÜLLT"""
    assert text_said(said) == said
