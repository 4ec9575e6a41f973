"""Writes licences.md: every dependency of setup.cfg, and what those of the core bring along, with its licence.

    python docs/make_licences.py

Licences are read from what is installed; a dependency that is not installed keeps the line it has.
"""

import configparser
import re
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "licences.md"
_TITLE = """# Licences

`labsurvey` is under the Apache License 2.0. It contains no code of others; it imports the packages below,
each under its own licence. This page is written by `python docs/make_licences.py` from what the packages say of
themselves.

The native core is built by setuptools (MIT) and the compiler of the machine; where there is none by `ziglang` (MIT),
which is fetched for the build alone. Nothing of a compiler's C++ library is in it.
"""


def declared() -> dict[str, dict[str, str]]:
    """Requirements by use ("core" or the extra) and name, with their bounds."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    groups = {"core": setup["options"]["install_requires"], **setup["options.extras_require"]}
    return {use: dict(_split(line) for line in text.split("\n") if line.strip()) for use, text in groups.items()}


def _split(line: str) -> tuple[str, str]:
    name = re.split(r"[\[<>=!~; ]", line.strip())[0]
    return name.lower(), line.strip()[len(name) :].split(";")[0].strip()


def licence(found: Distribution) -> str:
    """What a package says: its licence expression, else its classifiers, else the first line of its licence."""
    meta = found.metadata
    if meta.get("License-Expression"):
        return str(meta["License-Expression"])
    classified = [c.split("::")[-1].strip() for c in meta.get_all("Classifier") or () if c.startswith("License ::")]
    first = (meta.get("License") or "").strip().split("\n")[0][:60]
    return ", ".join(c for c in classified if c != "OSI Approved") or first or "not stated"


def along(name: str, seen: set[str]) -> None:
    """Add what a package needs without extras, and what that needs."""
    for line in distribution(name).requires or ():
        if "extra ==" in line.replace("'", '"').replace("extra==", "extra =="):
            continue
        needed = _split(line)[0]
        try:
            distribution(needed)
        except PackageNotFoundError:  # not needed on this platform
            continue
        if needed not in seen:
            seen.add(needed)
            along(needed, seen)


def main() -> None:
    """Write the page."""
    old = dict(re.findall(r"^\| (\S+) (\|.*)$", PAGE.read_text(encoding="utf-8"), re.M)) if PAGE.exists() else {}
    lines = [_TITLE]
    core: set[str] = set()
    for use, found in declared().items():
        title = use if use == "core" else f"extra `{use}`"
        lines += [f"\n## {title}\n", "| package | bound | licence |", "|---|---|---|"]
        for name, bound in sorted(found.items()):
            try:
                lines.append(f"| {name} | {bound} | {licence(distribution(name))} |")
            except PackageNotFoundError:
                lines.append(f"| {name} {old.get(name, f'| {bound} | not installed here |')}")
                continue
            if use == "core":
                along(name, core)
    more = sorted(core - set(declared()["core"]))
    lines += ["\n## brought along by the core\n", "| package | bound | licence |", "|---|---|---|"]
    lines += [f"| {name} | | {licence(distribution(name))} |" for name in more]
    PAGE.write_text("\n".join(lines).replace("\n\n\n", "\n\n") + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
