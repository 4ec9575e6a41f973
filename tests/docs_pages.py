"""The pages of the documentation as data: fenced blocks, what is said before them, links and anchors.

A page that begins with ``<!-- run -->`` is carried out from top to bottom in a scratch folder (``<!-- run: lab -->``:
beside a copy of the adjusted example full-lab). In front of a block stand, as comments that readers do not see:

``<!-- file: PATH -->``        the block is written there
``<!-- append: PATH -->``      the block is added to that file
``<!-- output -->``            lines that the commands above have printed; ``...`` stands for lines left out
``<!-- images: PATTERN -> FOLDER -->``  before a block: images of a real stereo rig are put there, named by their number
``<!-- shown: why -->``        the block is not run; commands must still be understood, code must still compile
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_COMMENT = re.compile(r"^<!--\s*(\w+)(?::\s*(.*?))?\s*-->$")
_FENCE = re.compile(r"^(`{3,}|~{3,})\s*([\w-]*)\s*(.*)$")
_LINK = re.compile(r"!?\[[^\]\[]*\]\(([^()\s]+)\)")
_HEADING = re.compile(r"^#{1,6}\s+(.*?)\s*$")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its text, the comments just above it as (word, what follows), its line."""

    language: str
    text: str
    said: tuple[tuple[str, str], ...]
    line: int

    def said_of(self, word: str) -> str | None:
        """What follows the comment ``word``; None where there is none."""
        return dict(self.said).get(word)


@dataclass(frozen=True)
class Page:
    """A page: path, prose without blocks by line, blocks, and how it is run ("" where it is not)."""

    path: Path
    prose: tuple[tuple[int, str], ...]
    blocks: tuple[Block, ...]
    run: str | None

    @property
    def name(self) -> str:
        """The path from the project's folder."""
        return self.path.relative_to(ROOT).as_posix()

    def links(self) -> Iterator[tuple[int, str]]:
        """Line and address of every link."""
        for line, text in self.prose:
            for match in _LINK.finditer(re.sub(r"`[^`]*`", "", text)):
                yield line, match.group(1)

    def anchors(self) -> set[str]:
        """Anchors of all headings, as GitHub and MyST make them."""
        found: set[str] = set()
        for _, text in self.prose:
            heading = _HEADING.match(text)
            if heading:
                found.add(slug(heading.group(1)))
        return found


def slug(heading: str) -> str:
    """The anchor of a heading: small letters, words joined by hyphens, punctuation dropped."""
    kept = re.sub(r"[^\w\- ]", "", heading.replace("`", "").strip().lower())
    return kept.replace(" ", "-")


def pages() -> tuple[Page, ...]:
    """README and everything below docs/."""
    paths = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return tuple(read_page(p) for p in paths if "_build" not in p.parts)


def read_page(path: Path) -> Page:
    """One page, cut into prose and blocks."""
    prose: list[tuple[int, str]] = []
    blocks: list[Block] = []
    said: list[tuple[str, str]] = []
    run: str | None = None
    lines = path.read_text(encoding="utf-8").splitlines()
    i = 0
    while i < len(lines):
        fence, comment = _FENCE.match(lines[i]), _COMMENT.match(lines[i])
        if fence:
            end = next((j for j in range(i + 1, len(lines)) if lines[j].strip() == fence.group(1)), None)
            if end is None:
                raise ValueError(f"{path}:{i + 1}: this block does not end")
            blocks.append(Block(fence.group(2), "\n".join(lines[i + 1 : end]) + "\n", tuple(said), i + 1))
            said, i = [], end + 1
            continue
        if comment and comment.group(1) == "run":
            run = comment.group(2) or "scratch"
        elif comment:
            said.append((comment.group(1), comment.group(2) or ""))
        elif lines[i].strip():
            said = []
        prose.append((i + 1, lines[i]))
        i += 1
    return Page(path, tuple(prose), tuple(blocks), run)
