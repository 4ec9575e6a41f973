"""docs/architecture.md: what is measured goes from file to report by the stations that the page names."""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import pytest

from survey.cli import main
from survey.jobs.adjusting.job import adjust_job

PAGE = Path(__file__).parents[2] / "docs" / "architecture.md"


def ways() -> dict[str, list[str]]:
    """By heading the stations of each way, "module.function" or "module.Class.method"."""
    text = PAGE.read_text(encoding="utf-8").split("## From file to report")[1].split("\n## ")[0]
    parts = re.split(r"^### (.*)$", text, flags=re.MULTILINE)[1:]
    found = zip(parts[::2], parts[1::2], strict=True)
    return {name: re.findall(r"^\d+\. `([\w.]+)`", part, re.MULTILINE) for name, part in found}


WAYS = ways()
EXAMPLES = {
    "An image point": "relay-station",
    "A measured pair": "relay",
    "A reading of an instrument": "total-station",
}


@contextmanager
def first_calls(stations: list[str]) -> Iterator[list[str]]:
    """Those of the stations that are entered, in the order of their first calls."""
    seen: list[str] = []
    names = set(stations)

    def entered(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            name = f"{frame.f_globals.get('__name__')}.{frame.f_code.co_qualname}"
            if name in names and name not in seen:
                seen.append(name)

    sys.setprofile(entered)
    try:
        yield seen
    finally:
        sys.setprofile(None)


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_what_is_measured_passes_the_stations_in_their_order(
    way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LABSURVEY_THREADS", "1")  # nothing is done beside anything, unseen
    assert len(WAYS[way]) <= 10
    folder = tmp_path / "lab"
    assert main(["example", EXAMPLES[way], str(folder), "--quiet"]) == 0
    with first_calls(WAYS[way]) as seen:
        adjust_job(folder, progress=False)
    assert seen == WAYS[way]
