"""How a session goes on, for people: a line on stderr, and ``capture/status.json`` for the web page."""

import json
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from tqdm import tqdm

from capture.session.quality_thread import quality_text
from capture.session.taking import Taken
from survey.folder.text import atomic_write
from survey.project.captured import status_path


class Progress:
    """Listener of a session. Times are differences of the monotonic clock."""

    def __init__(self, folder: Path, total: int, shown: bool) -> None:
        self._folder, self._begin = folder, time.monotonic()
        self._first: int | None = None
        self._bar = tqdm(total=total, desc="capturing", unit="epoch", disable=not shown, file=sys.stderr)
        self._last: dict[str, object] = {}

    def taken(self, taken: Taken, quality: Mapping[str, Mapping[str, Any]]) -> None:
        """One more epoch; quality: of its images, by camera."""
        if self._first is None:
            self._first = taken.done - 1
        self._bar.n = taken.done
        self._bar.set_postfix_str(quality_text(quality) or taken.record["epoch_id"])
        each = (time.monotonic() - self._begin) / (taken.done - self._first)
        self._last = {
            "done": taken.done,
            "total": taken.total,
            "seconds_left": round(each * (taken.total - taken.done), 1),
            "epoch_id": taken.record["epoch_id"],
            "after": taken.record["after"],
            "images": {name: image["path"] for name, image in taken.record["images"].items()},
            "quality": {name: dict(values) for name, values in quality.items()},
        }
        self.state("running")

    def quality(self, quality: Mapping[str, Mapping[str, object]]) -> None:
        """What was found out later."""
        self._last |= {"quality": {name: dict(values) for name, values in quality.items()}}
        self._bar.set_postfix_str(quality_text(quality))

    def note(self, line: str) -> None:
        """Something worth a line of its own."""
        if not self._bar.disable:
            self._bar.write(line, file=sys.stderr)

    def state(self, state: str, message: str = "") -> None:
        """Write the status; a full disk does not matter here."""
        path = status_path(self._folder)
        text = json.dumps({"state": state, "message": message, **self._last})
        with suppress(OSError):
            atomic_write(path, text)

    def close(self) -> None:
        """End the line."""
        self._bar.close()
