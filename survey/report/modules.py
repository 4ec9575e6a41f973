"""The script of a page that has to be one file: ES modules, shared with the workbench, without their imports."""

import re
from functools import cache
from pathlib import Path

WEB = Path(__file__).with_name("web")
"""Modules, words, colours and looks that the report shares with the workbench."""
_IMPORT = re.compile(r'^import \{ (.+?) \} from "\./([\w-]+)\.js";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:const|function|class) (\w+))", re.MULTILINE)
_COMMENT = re.compile(r"/\*\*.*?\*/\s*|^\s*//[^\n]*\n", re.DOTALL | re.MULTILINE)


@cache
def bundled(entry: str) -> str:
    """A module and all it imports as one script: each a function of its own, so that equal names do not meet."""
    done: dict[str, str] = {}

    def add(name: str) -> None:
        text = _COMMENT.sub("", (WEB / f"{name}.js").read_text(encoding="utf-8"))
        for _, other in _IMPORT.findall(text):
            if other not in done:
                add(other)
        body = _IMPORT.sub(lambda found: f"const {{ {found[1]} }} = ${found[2]};\n", text)
        names = ", ".join(_EXPORT.findall(body))
        done[name] = f"const ${name} = (() => {{\n{_EXPORT.sub('', body).strip()}\nreturn {{ {names} }};\n}})();\n"

    add(entry)
    return f'"use strict";\n(() => {{\n{"".join(done.values())}}})();\n'


@cache
def looks(*names: str) -> str:
    """Style sheets one after the other."""
    return "".join((WEB / f"{name}.css").read_text(encoding="utf-8") for name in names)
