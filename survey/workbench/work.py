"""What a page is about, and the one thread in which everything about it runs.

Nothing here loads what a project is read with: the page comes to the browser while that is done.
"""

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from contextvars import copy_context
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from adjust.model.errors import SurveyError
from survey.workbench.live import Live

if TYPE_CHECKING:
    from survey.workbench.pages.beginning import Beginning
    from survey.workbench.session import Workbench

    Shown = Workbench | Beginning

_LOOK_S, _PATIENCE_S = 2.0, 10.0
T = TypeVar("T")


class Work:
    """A project, or a folder that is to become one, and all that is asked of it, in turn."""

    def __init__(self, shown: "Shown | Callable[[], Shown]") -> None:
        """Questions wait where ``shown`` is still to be read; ``opened`` says when it is, or why it cannot be."""
        self.opened: Future[Shown] = Future()
        self.told = threading.Event()  # a page that it cannot be
        self.live = Live()
        self.running, self.asked = "", asyncio.Event()  # what runs; that a page has asked
        self.patience_s = _PATIENCE_S
        self._thread = ThreadPoolExecutor(1, "workbench")
        self._project: Workbench | None = None
        self._make = shown if callable(shown) else None
        if not callable(shown):
            self._use(shown)

    @property
    def bench(self) -> "Workbench":
        """The project; raises SurveyError where it is only to begin."""
        if self._project is None:
            raise SurveyError(f"{self.shown.folder}: there is no survey.toml yet; begin a project with its images")
        return self._project

    def _use(self, shown: "Shown") -> None:
        from survey.workbench.session import Workbench

        self.shown, self._project = shown, shown if isinstance(shown, Workbench) else None
        if self._project is not None:
            self._project.watch = self._progress
        self.opened.set_result(shown)

    def end(self) -> None:
        """Give up what runs, and the messages to pages."""
        if self._project is not None:
            self._project.cancel()
        self.live.post(None)

    def close(self) -> None:
        """Take no more work."""
        self.end()
        self._thread.shutdown(wait=False, cancel_futures=True)

    async def open(self) -> None:
        """Read what is shown, where that is still to be done, and adjust it for the first time."""
        if self._make is not None:
            try:
                self._use(await asyncio.to_thread(self._make))
            except Exception as error:  # whoever started this learns of it, a page that asks too
                self.opened.set_exception(error)
                return
        if self._project is not None and self._project.version == 0 and not self._project.situation.everything.is_empty:
            await self._first()

    async def _first(self) -> None:
        """The first adjustment, once a page has drawn what there is, or where none asks."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self.asked.wait(), _LOOK_S)
            await asyncio.wait_for(self.live.joined.wait(), self.patience_s)
        try:
            await self.run("adjust", self.bench.adjust)
        except (SurveyError, OSError) as error:
            self.live.post({"type": "error", "error": str(error)})

    async def watch_folder(self) -> None:
        """Tell pages of files that others have written."""
        told: tuple[str, ...] = ()
        while True:
            await asyncio.sleep(_LOOK_S)
            if self._project is None:
                continue
            changed = await asyncio.to_thread(self.bench.changed_files)
            if changed != told and not self.running:  # else it may be what is being written here
                told = changed
                self.live.post({"type": "folder", "changed": list(changed), "lock": self.bench.holder()})

    def _progress(self, step: int, omega: float) -> None:
        self.live.post({"type": "progress", "what": self.running, "step": step, "omega": omega})

    async def run(self, what: str, work: Callable[[], T]) -> T:
        """In the one thread, in turn; pages hear of the new state where there is one."""
        version = self.shown.version
        if version == 0 and what == "view":  # what there is, while the first solution is waited for
            return await asyncio.to_thread(work)

        def working() -> T:
            self.running = what
            try:
                return work()
            finally:
                self.running = ""

        try:
            spoken = copy_context()  # the language of who asks
            return await asyncio.get_running_loop().run_in_executor(self._thread, spoken.run, working)
        finally:
            if self._project is not None and (self._project.version != version or what == "save"):
                self.live.post({"type": "state", "version": self.bench.version, "unsaved": self.bench.n_unsaved})

    def show(self, folder: Path) -> None:
        """Another project from now on; one of which nothing is found yet says what is missing."""
        from survey.workbench.session import Workbench

        bench = Workbench(folder, read_only=self.shown.read_only, watch=self._progress)
        if not bench.situation.everything.is_empty:
            with suppress(SurveyError):
                bench.adjust()
        self.shown = self._project = bench
