"""Which functions of the packages read files, and which of them the list of readers reaches with good files."""

import ast
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).parents[2]
PACKAGES = ("survey", "capture")
_READS = frozenset({
    "read_bytes", "read_text", "open", "fdopen", "fromfile", "loadtxt", "genfromtxt", "imread", "imdecode",
    "imdecodemulti", "memmap", "ZipFile", "ParquetFile", "read_table", "read_csv", "File", "Reconstruction", "parse",
})  # fmt: skip
_PARSES = {("json", "loads"), ("json", "load"), ("tomllib", "loads"), ("tomllib", "load"), ("np", "load"),
           ("csv", "reader"), ("csv", "DictReader"), ("yaml", "load"), ("ast", "parse")}  # fmt: skip


def functions_called(read: Callable[[bytes], object], inputs: Sequence[bytes]) -> list[str]:
    """Functions of the packages that run while ``inputs`` are read, as ``survey/jobs/relay.py:read_trajectory``."""
    found = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            found.add(frame.f_code)

    sys.setprofile(note)
    try:
        for data in inputs:
            read(data)
    finally:
        sys.setprofile(None)
    named = ((Path(code.co_filename), code.co_qualname) for code in found)
    return sorted({f"{path.relative_to(ROOT).as_posix()}:{name}" for path, name in named if _is_ours(path)})


def _is_ours(path: Path) -> bool:
    return path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] in PACKAGES


def reading_functions() -> Iterator[str]:
    """All functions of the packages named ``read_...`` that others may call, and all that open or parse a file."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            where = path.relative_to(ROOT).as_posix()
            for name, node in _functions(ast.parse(path.read_text(encoding="utf-8")), ""):
                is_named = node.name.startswith("read_") and "." not in name
                if is_named or any(_is_reading(n) for n in ast.walk(node) if isinstance(n, ast.Call)):
                    yield f"{where}:{name}"


def _functions(tree: ast.AST, prefix: str) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef):
            yield from _functions(node, f"{prefix}{node.name}.")
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield prefix + node.name, node
        elif isinstance(node, ast.If | ast.Try):
            yield from _functions(node, prefix)


def _is_reading(call: ast.Call) -> bool:
    if isinstance(call.func, ast.Name):
        return call.func.id == "open"
    if not isinstance(call.func, ast.Attribute):
        return False
    owner = call.func.value.id if isinstance(call.func.value, ast.Name) else ""
    return (owner, call.func.attr) in _PARSES or (call.func.attr in _READS and owner not in ("self", "argparse", "re"))
