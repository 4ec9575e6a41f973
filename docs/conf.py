"""Sphinx: these pages and the docstrings. Build: sphinx-build -W docs build/docs (extra ``docs``)."""

import importlib
import inspect
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

project = "labsurvey"
author = "the authors of labsurvey"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "labsurvey"
html_show_sphinx = False
html_show_copyright = False
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
nitpicky = False
# pages link to files of the project (examples, tests), which are no pages
suppress_warnings = ["myst.xref_missing", "misc.highlighting_failure"]

PACKAGES = ("survey", "adjust", "capture")
# what a package without a list of its own shows
MODULES = {
    "adjust": (
        "adjust.model.survey",
        "adjust.model.observations",
        "adjust.adjustment",
        "adjust.model.result",
        "adjust.model.errors",
    ),
    "survey": (
        "survey.jobs.adjusting.job", "survey.jobs.adjusting.outcome", "survey.project.project", "survey.simulate",
        "survey.report.results",
    ),
    "capture": (
        "capture.devices.camera",
        "capture.devices.turntable",
        "capture.plan.plan",
        "capture.session.taking",
    ),
}


class PublicNames(Directive):
    """All public names of the three packages with their docstrings."""

    def run(self) -> list[nodes.Node]:
        """Sections for each package, made by autodoc."""
        lines: list[str] = []
        seen: set[int] = set()
        for package in PACKAGES:
            lines += ["", package, "-" * len(package), "", *_package(package, seen)]
        node = nodes.container()
        node.document = self.state.document
        self.state.nested_parse(StringList(lines, "public names"), self.content_offset, node, match_titles=True)
        return node.children


def _package(name: str, seen: set[int]) -> list[str]:
    module = importlib.import_module(name)
    listed = getattr(module, "__all__", None)
    lines = [f".. automodule:: {name}", "   :no-members:", ""]
    if listed:
        for each in listed:
            value = getattr(module, each)
            lines += _entry(name, each, value)
            if id(value) in seen:  # a class of another package under this name, too: one entry in the index
                lines.insert(len(lines) - 1, "   :no-index:")
            seen.add(id(value))
        return lines
    for inner in MODULES[name]:
        lines += [f".. automodule:: {inner}", "   :members:", ""]
    return lines


def _entry(package: str, name: str, value: Any) -> list[str]:
    if inspect.ismodule(value):
        return [f".. automodule:: {value.__name__}", "   :members:", ""]
    if inspect.isclass(value):
        return [f".. autoclass:: {package}.{name}", "   :members:", ""]
    if callable(value):
        return [f".. autofunction:: {package}.{name}", ""]
    return [f".. autodata:: {package}.{name}", ""]


def literal_blocks(_app: Sphinx, _what: str, _name: str, _value: Any, _options: Any, lines: list[str]) -> None:
    """What is indented below a line that ends with a colon is code, as it stands."""
    for i in range(len(lines) - 2):
        opens = lines[i].endswith(":") and not lines[i].endswith("::")
        if opens and not lines[i + 1] and lines[i + 2].startswith("  "):
            lines[i] += ":"


def setup(app: Sphinx) -> dict[str, bool]:
    """Hooks of this file."""
    app.add_directive("public-names", PublicNames)
    app.connect("autodoc-process-docstring", literal_blocks)
    return {"parallel_read_safe": True}
