"""The order of modules and rooms: none imports itself round about or a room above, as the sources have it."""

import ast
import configparser
import itertools
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("adjust", "survey", "capture")


def _modules(root: Path) -> dict[str, Path]:
    paths = (path for name in PACKAGES for path in (root / name).rglob("*.py"))
    found = {path.relative_to(root).with_suffix("").as_posix(): path for path in paths}
    return {name.removesuffix("/__init__").replace("/", "."): path for name, path in found.items()}


def _statements(node: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    """Imports anywhere: in functions too, and those for type checkers alone."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child
        elif not isinstance(child, ast.expr):
            yield from _statements(child)


def _named(name: str, is_package: bool, statement: ast.Import | ast.ImportFrom) -> Iterator[str]:
    if isinstance(statement, ast.Import):
        yield from (alias.name for alias in statement.names)
        return
    above = name.split(".")[: len(name.split(".")) + is_package - statement.level] if statement.level else []
    base = ".".join((*above, *filter(None, [statement.module])))
    for alias in statement.names:
        yield from (f"{base}.{alias.name}", base)


@cache
def _imports(root: Path) -> dict[str, set[str]]:
    """What every module imports: a name out of a package's face is that package, a module in it the module."""
    modules = _modules(root)
    out: dict[str, set[str]] = {}
    for name, path in modules.items():
        out[name] = set()
        for statement in _statements(ast.parse(path.read_text(encoding="utf-8"))):
            named = list(_named(name, path.name == "__init__.py", statement))
            if isinstance(statement, ast.ImportFrom):  # "from package import module" is of the module
                named = [full if full in modules else base for full, base in zip(named[::2], named[1::2], strict=True)]
            out[name] |= {other for other in named if other in modules and other != name}
    return out


def _circle(imports: Mapping[str, set[str]]) -> list[str]:
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


@pytest.mark.slow
@pytest.mark.parametrize("package", PACKAGES)
def test_no_module_imports_itself_round_about(package: str) -> None:
    imports = {name: of for name, of in _imports(ROOT).items() if name.split(".")[0] == package}
    assert imports
    assert _circle(imports) == []


def test_a_circle_is_found_through_functions_relative_imports_and_types(tmp_path: Path) -> None:
    (tmp_path / "survey").mkdir()
    texts = {
        "__init__": "",
        "a": "def late():\n    from survey.b import thing\n",
        "b": "from . import c\n",
        "c": "import typing\nif typing.TYPE_CHECKING:\n    from .d import thing\n",
        "d": "",
    }
    for name, text in texts.items():
        (tmp_path / "survey" / f"{name}.py").write_text(text)
    assert _circle(_imports.__wrapped__(tmp_path)) == []
    (tmp_path / "survey/d.py").write_text("from .a import late\n")
    assert set(_circle(_imports.__wrapped__(tmp_path))) == {f"survey.{name}" for name in "abcd"}


@cache
def _floors(package: str) -> dict[str, int]:
    """The rooms of a package from the top, as its contract in setup.cfg has them."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    layers = setup[f"importlinter:contract:{package}"]["layers"].split()
    return {name.strip("()"): floor for floor, name in enumerate(layers)}


def _upward(imports: Mapping[str, set[str]], package: str, floors: Mapping[str, int]) -> list[str]:
    """Imports of a room above: "a.high.thing -> a.low.thing" of a package's modules."""
    inside = {m: m.split(".")[1] for m in imports if m.startswith(f"{package}.")}
    return [f"{m} -> {of}" for m in sorted(inside) for of in sorted(imports[m])
            if of in inside and floors[inside[of]] < floors[inside[m]]]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("package", PACKAGES)
def test_every_room_imports_rooms_below_it_only(package: str) -> None:
    assert _upward(_imports(ROOT), package, _floors(package)) == []


def test_an_import_of_a_room_above_is_found() -> None:
    imports = {"a.x.one": {"a.y.two"}, "a.y.two": {"a.y.three"}, "a.y.three": {"a.x.one", "b"}, "b": set()}
    assert _upward(imports, "a", {"x": 0, "y": 1}) == ["a.y.three -> a.x.one"]


@pytest.mark.parametrize("package", PACKAGES)
def test_the_page_on_architecture_has_the_rooms_of_the_contract_in_its_order(package: str) -> None:
    lines = iter((ROOT / "docs/architecture.md").read_text(encoding="utf-8").splitlines())
    assert any(line.startswith(f"| room of `{package}` |") for line in lines)
    next(lines)
    rows = list(itertools.takewhile(lambda line: line.startswith("|"), lines))
    assert [row.split("`")[1] for row in rows] == [room for room in _floors(package) if room != "__main__"]


_MOST = 16
"""Modules of a folder that are still seen at a glance, ``__init__`` not counted."""


def _crowded(root: Path) -> dict[str, int]:
    count = Counter(path.parent.relative_to(root).as_posix() for path in _modules(root).values()
                    if path.name != "__init__.py")  # fmt: skip
    return {folder: n for folder, n in count.items() if n > _MOST}


def test_no_folder_has_more_modules_than_are_seen_at_a_glance(tmp_path: Path) -> None:
    assert _crowded(ROOT) == {}
    (tmp_path / "survey").mkdir()
    for k in range(_MOST + 1):
        (tmp_path / "survey" / f"m{k}.py").touch()
    assert _crowded(tmp_path) == {"survey": _MOST + 1}
