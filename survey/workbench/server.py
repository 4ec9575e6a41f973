"""The local server of ``labsurvey open``: one project, one browser on this machine, a token.

Everything that it answers is a method of :class:`survey.workbench.session.Workbench`; here stand the addresses, the
guard and the messages while something runs. Nothing here loads what a project is read with: the page comes to the
browser while that is done.
"""

import asyncio
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from contextvars import copy_context
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp

from adjust.model.errors import SurveyError
from survey.folder.locking import BusyError
from survey.folder.text import suggestion
from survey.report.language import LANGUAGES, message, speaking
from survey.report.modules import WEB as SHARED
from survey.workbench.bodies import (
    DECISIONS,
    JOBS,
    VIEWS,
    Asked,
    Body,
    BodyError,
    distance_of,
    json_of,
    run_of,
    size_of,
    whole_of,
)
from survey.workbench.guard import LONGEST_BODY, Guard, TooLongError
from survey.workbench.live import Live

if TYPE_CHECKING:
    from survey.workbench.pages.beginning import Beginning
    from survey.workbench.session import Workbench

    Shown = Workbench | Beginning

WEB = Path(__file__).parent / "web"
_KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".json": "application/json",
          ".svg": "image/svg+xml", ".png": "image/png", ".woff2": "font/woff2"}  # fmt: skip
_LOOK_S, _PATIENCE_S = 2.0, 10.0
_MOST_ROWS = 200_000  # of image points at once, where not all are asked for
_Handler = Callable[[Request], Awaitable[Response]]


@dataclass(frozen=True)
class Way:
    """An address of the interface. calls: what of ``survey.Workbench`` it is; changes: whether files may change."""

    method: str
    path: str
    calls: tuple[str, ...]
    handler: _Handler
    changes: bool = False


class Server:
    """What is served, and the one thread in which everything about the project runs."""

    def __init__(self, shown: "Shown | Callable[[], Shown]", token: str, cookie: str = "labsurvey") -> None:
        """Questions wait where ``shown`` is still to be read; ``opened`` says when it is, or why it cannot be."""
        self.token, self.cookie = token, cookie
        self.opened: Future[Shown] = Future()
        self._project: Workbench | None = None
        self.live, self._worker = Live(), ThreadPoolExecutor(1, "workbench")
        self._running, self._asked = "", asyncio.Event()
        self.patience_s = _PATIENCE_S
        self._files = {f"/{p.relative_to(at).as_posix()}": p for at in (SHARED, WEB) for p in at.rglob("*")
                       if p.suffix in _KINDS}  # fmt: skip
        self.told = threading.Event()  # a page that it cannot be
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

    def ways(self) -> tuple[Way, ...]:
        """All addresses of the interface."""
        return (
            Way("GET", "/api/state", ("state",), self._state),
            Way("GET", "/api/points", ("points",), self._points),
            Way("GET", "/api/image/{camera}/{epoch}", ("picture",), self._image),
            *(Way("GET", f"/api/{path}", view.calls, self._view(view)) for path, view in VIEWS.items()),
            Way("GET", "/api/capture", ("capture_status",), self._capture),
            Way("GET", "/api/capture/{camera}", ("capture_picture",), self._captured),
            Way("GET", "/api/halves", ("cross_validate",), self._halves),
            Way("GET", "/api/statistics/{part}", ("statistics_part",), self._statistics),
            Way("POST", "/api/preview", ("preview",), self._preview),
            Way("POST", "/api/cancel", ("cancel",), self._cancel),
            *(Way("POST", f"/api/{path}", decision.calls, self._decision(decision), decision.changes)
              for path, decision in DECISIONS.items()),
            Way("POST", "/api/save", ("save",), self._save, True),
            Way("POST", "/api/runs/{number}/pin", ("pin",), self._pin, True),
            *(Way("POST", f"/api/jobs/{name}", job.calls, self._job(name), job.changes)
              for name, job in JOBS.items()),
            Way("POST", "/api/jobs/{name}", (), self._no_job),
        )

    def app(self) -> ASGIApp:
        """The application, guarded."""
        routes = [Route(way.path, self._said(way), methods=[way.method]) for way in self.ways()]
        routes.append(Route("/{path:path}", self._file, methods=["GET"]))
        app = Starlette(routes=[*routes, WebSocketRoute("/live", self.live.serve)], lifespan=self._lifespan)
        return Guard(app, self.token, self.cookie)

    def end(self) -> None:
        """Give up what runs, and the messages to pages."""
        if self._project is not None:
            self._project.cancel()
        self.live.post(None)

    @asynccontextmanager
    async def _lifespan(self, _app: Starlette) -> AsyncIterator[None]:
        self.live.begin()
        tasks = [asyncio.create_task(work()) for work in (self._open, self._watch_folder)]
        yield
        for task in tasks:
            task.cancel()
        self.end()
        self._worker.shutdown(wait=False, cancel_futures=True)

    async def _open(self) -> None:
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
            await asyncio.wait_for(self._asked.wait(), _LOOK_S)
            await asyncio.wait_for(self.live.joined.wait(), self.patience_s)
        try:
            await self._run("adjust", self.bench.adjust)
        except (SurveyError, OSError) as error:
            self.live.post({"type": "error", "error": str(error)})

    async def _watch_folder(self) -> None:
        told: tuple[str, ...] = ()
        while True:
            await asyncio.sleep(_LOOK_S)
            if self._project is None:
                continue
            changed = await asyncio.to_thread(self.bench.changed_files)
            if changed != told and not self._running:  # else it may be what is being written here
                told = changed
                self.live.post({"type": "folder", "changed": list(changed), "lock": self.bench.holder()})

    def _progress(self, step: int, omega: float) -> None:
        self.live.post({"type": "progress", "what": self._running, "step": step, "omega": omega})

    async def _run(self, what: str, work: Callable[[], Any]) -> Any:
        """In the one thread, in turn; pages hear of the new state where there is one."""
        version = self.shown.version
        if version == 0 and what == "view":  # what there is, while the first solution is waited for
            return await asyncio.to_thread(work)

        def working() -> Any:
            self._running = what
            try:
                return work()
            finally:
                self._running = ""

        try:
            spoken = copy_context()  # the language of who asks
            return await asyncio.get_running_loop().run_in_executor(self._worker, spoken.run, working)
        finally:
            if self._project is not None and (self._project.version != version or what == "save"):
                self.live.post({"type": "state", "version": self.bench.version, "unsaved": self.bench.n_unsaved})

    def _said(self, way: Way) -> _Handler:
        """What its owner can mend is an answer of one line."""

        async def answering(request: Request) -> Response:
            asked = request.headers.get("x-language", "en")
            with speaking(asked if asked in LANGUAGES else "en"):
                try:
                    await asyncio.shield(asyncio.wrap_future(self.opened))
                except SurveyError as error:
                    return JSONResponse({"error": message(str(error))}, 409, background=BackgroundTask(self.told.set))
                return await said(request)

        async def said(request: Request) -> Response:
            if way.changes and self.shown.read_only:
                return JSONResponse({"error": message("the project is open for reading only")}, 403)
            try:
                return await way.handler(request)
            except SurveyError as error:
                from survey.workbench.situation import CancelledError, ChangedError

                kind = {"cancelled": True} if isinstance(error, CancelledError) else {}
                kind |= {"retry": True} if isinstance(error, ChangedError | BusyError) else {}
                return JSONResponse({"error": message(str(error)), "version": self.shown.version, **kind}, 409)
            except OSError as error:
                return JSONResponse({"error": f"{error.filename}: {error.strerror}"}, 409)
            except (BodyError, ClientDisconnect) as error:
                return JSONResponse({"error": message(f"not understood: {error}")}, 400)
            except TooLongError:
                return JSONResponse({"error": f"more than {LONGEST_BODY} bytes"}, 413)

        return answering

    # reading

    async def _file(self, request: Request) -> Response:
        path = self._files.get("/index.html" if request.url.path == "/" else request.url.path)
        if path is None:
            return JSONResponse({"error": "no such page"}, 404)
        return Response(self._page() if path.suffix == ".html" else path.read_bytes(), media_type=_KINDS[path.suffix])

    def _page(self) -> bytes:
        """The page, which names all modules: they come at once and not one after the other has named it."""
        modules = sorted(name[1:] for name in self._files if name.endswith(".js") and name != "/report.js")
        named = (f'<link rel="modulepreload" href="{name}">\n' for name in modules)
        text = (WEB / "index.html").read_text(encoding="utf-8")
        return text.replace("</head>", "".join(named) + "</head>").encode()

    async def _state(self, _request: Request) -> Response:
        self._asked.set()
        found = await asyncio.to_thread(self.shown.state)
        response = JSONResponse(found | {"running": self._running})
        response.set_cookie(self.cookie, self.token, httponly=True, samesite="strict")
        return response

    def _view(self, view: Asked) -> _Handler:
        async def answering(request: Request) -> Response:
            return JSONResponse(await self._run(view.what, lambda: view.run(self.bench, request)))

        return answering

    async def _points(self, request: Request) -> Response:
        q = request.query_params
        camera, _, epoch = q.get("image", "").partition("/")
        known, most = whole_of(request, "layout"), min(whole_of(request, "worst") or 0, _MOST_ROWS)
        data = await self._run("view", lambda: self.bench.points(camera, epoch, most, known))
        return Response(data, media_type="application/octet-stream")

    async def _statistics(self, request: Request) -> Response:
        from survey.solution.records import solution_json

        part = request.path_params["part"]
        found = await self._run("statistics", lambda: self.bench.statistics_part(part))
        return Response(solution_json(found), media_type="application/json")

    async def _halves(self, request: Request) -> Response:
        from survey.folder.plain import plain

        distance, bench = distance_of(request), self.bench
        found = await asyncio.to_thread(bench.cross_validate, distance)  # of values that nobody changes: others go on
        told = {"version": bench.version, "cameras": [c.summary() | c.pixels() for c in found.cameras],
                "notes": [message(note) for note in found.notes]}  # fmt: skip
        return JSONResponse(plain(found.summary() | told))

    async def _image(self, request: Request) -> Response:
        from survey.workbench import pictures

        key = request.path_params["camera"], request.path_params["epoch"]
        project = self.bench.situation.everything
        size = size_of(request)
        if key not in project.images:
            return JSONResponse({"error": message("no such image")}, 404)
        tag = pictures.etag(project.detected.get(key), project.images[key], size)
        kept = {"ETag": tag, "Cache-Control": "private, no-cache"}
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers=kept)
        data, kind = await asyncio.to_thread(self.bench.picture, *key, size)
        return Response(data, media_type=kind, headers=kept)

    async def _capture(self, _request: Request) -> Response:
        return JSONResponse(await asyncio.to_thread(self.shown.capture_status))

    async def _captured(self, request: Request) -> Response:
        camera, size = request.path_params["camera"], size_of(request)
        data, kind = await asyncio.to_thread(self.shown.capture_picture, camera, size)
        return Response(data, media_type=kind)

    # acting

    async def _preview(self, request: Request) -> Response:
        body = Body(await json_of(request))
        excluded, included = body.changes()
        names, out = (excluded, True) if excluded else (included, False)
        return JSONResponse(await self._run("view", lambda: self.bench.preview(*names, excluded=out)))

    def _decision(self, decision: Asked) -> _Handler:
        async def answering(request: Request) -> Response:
            body = Body(await json_of(request))
            await self._run("adjust", lambda: decision.run(self.bench, body, request))
            state = await asyncio.to_thread(self.bench.state)
            return JSONResponse(state | VIEWS["changes"].run(self.bench, request))

        return answering

    async def _pin(self, request: Request) -> Response:
        number, pinned = run_of(request), Body(await json_of(request)).flag("pinned")
        run = await self._run("pin", lambda: self.bench.pin(number, pinned))
        return JSONResponse(run.as_dict())

    async def _save(self, _request: Request) -> Response:
        said = (await self._run("save", self.bench.save)).summary()
        from survey.workbench.views.project import in_words

        told = {"summary": in_words(said["summary"]), "warnings": [*map(message, said["warnings"])]}
        return JSONResponse(said | told)

    def _job(self, name: str) -> _Handler:
        """A job: what it said, and the state after it."""
        async def answering(request: Request) -> Response:
            from survey.workbench.pictures import found_in

            body = Body(await json_of(request))
            bench = self.shown if name in ("init", "show") else self.bench

            def found(report: Any) -> None:
                self.live.post({"type": "detected"} | found_in(report))

            told = await self._run(name, lambda: JOBS[name].run(bench, body, found))
            if name in ("init", "show"):
                await self._run("adjust", lambda: self._show(Path(told.summary["folder"])))
            return JSONResponse(told.as_dict() | {"state": await asyncio.to_thread(self.bench.state)})

        return answering

    async def _no_job(self, request: Request) -> Response:
        name = request.path_params["name"]
        raise SurveyError(f"there is no job {name!r}; {suggestion(name, JOBS)}")

    def _show(self, folder: Path) -> None:
        """Another project from now on; one of which nothing is found yet says what is missing."""
        from survey.workbench.session import Workbench

        bench = Workbench(folder, read_only=self.shown.read_only, watch=self._progress)
        if not bench.situation.everything.is_empty:
            with suppress(SurveyError):
                bench.adjust()
        self.shown = self._project = bench

    async def _cancel(self, _request: Request) -> Response:
        self.bench.cancel()
        return JSONResponse({})
