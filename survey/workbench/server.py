"""The local server of ``labsurvey open``: one project, one browser on this machine, a token.

Everything that it answers is a method of :class:`survey.workbench.session.Workbench` or a function of
``survey.workbench.views``; here stand the addresses, the guard and the messages while something runs.
"""

import asyncio
import json
import socket
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from adjust.model.errors import SurveyError
from survey.folder.locking import BusyError
from survey.solution.earlier.runs import pin_run
from survey.workbench import cameras, guard, pictures, views
from survey.workbench.session import CancelledError, ChangedError, Workbench

WEB = Path(__file__).parent / "web"
_KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".json": "application/json",
          ".svg": "image/svg+xml", ".png": "image/png", ".woff2": "font/woff2"}  # fmt: skip
_LONGEST_BODY = 1 << 20
_LOOK_S = 2.0
_MOST_ROWS = 200_000  # of image points at once, where not all are asked for
_Handler = Callable[[Request], Awaitable[Response]]


class Live:
    """Messages to all pages that are open; ``post`` may be called from any thread."""

    def __init__(self) -> None:
        self._queues: set[asyncio.Queue[dict[str, Any] | None]] = set()
        self._loop: asyncio.AbstractEventLoop | None = None

    def begin(self) -> None:
        """Belong to the loop that runs."""
        self._loop = asyncio.get_running_loop()

    def post(self, message: dict[str, Any] | None) -> None:
        """Send to all; None ends them."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._put, message)

    def _put(self, message: dict[str, Any] | None) -> None:
        for queue in self._queues:
            queue.put_nowait(message)

    async def serve(self, page: WebSocket) -> None:
        """Until the page or the server goes."""
        await page.accept()
        queue: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()
        self._queues.add(queue)
        gone = asyncio.create_task(_until_gone(page))
        try:
            while not gone.done():
                taken = asyncio.create_task(queue.get())
                await asyncio.wait({taken, gone}, return_when=asyncio.FIRST_COMPLETED)
                if not taken.done() or taken.result() is None:
                    taken.cancel()
                    break
                await page.send_text(json.dumps(taken.result()))
        finally:
            self._queues.discard(queue)
            gone.cancel()
            with suppress(RuntimeError, WebSocketDisconnect):
                await page.close()


async def _until_gone(page: WebSocket) -> None:
    with suppress(WebSocketDisconnect):
        while True:
            await page.receive_text()


class Guard:
    """Refuses everything that does not come from a browser on this machine that has the token.

    token: what requests must bring in the header X-Token; images and the socket by a cookie of the name ``cookie``,
    which no script can read and no other site sends.
    """

    def __init__(self, app: ASGIApp, token: str, cookie: str, read_only: bool) -> None:
        self.app, self.token, self.cookie, self.read_only = app, token, cookie, read_only

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers = {k.decode("latin-1"): v.decode("latin-1") for k, v in scope["headers"]}
        refused = self._refused(scope, headers)
        if refused is not None and scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
            return
        answer = _with_headers(send)
        if refused is not None:
            await JSONResponse({"error": refused[1]}, refused[0])(scope, receive, answer)
            return
        await self.app(scope, _limited(receive) if scope["type"] == "http" else receive, answer)

    def _refused(self, scope: Scope, headers: Mapping[str, str]) -> tuple[int, str] | None:
        is_socket, path, method = scope["type"] == "websocket", scope["path"], scope.get("method")
        if not guard.is_from_here(headers.get("host", ""), headers.get("origin"), needed=is_socket):
            return 403, guard.NOT_FROM_HERE
        if not (is_socket or path.startswith("/api/")):
            return None if method in ("GET", "HEAD") else (405, "only GET")
        by_cookie = is_socket or (method in ("GET", "HEAD") and path.startswith("/api/image/"))
        if not guard.is_token(headers.get("x-token", ""), self.token) and not (by_cookie and self._in_cookie(headers)):
            return 403, guard.WRONG_TOKEN
        if method == "POST" and self.read_only:
            return 403, "the project is open for reading only"
        if method == "POST" and headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            return 415, "the body has to be application/json"
        return None

    def _in_cookie(self, headers: Mapping[str, str]) -> bool:
        found = (c.strip().partition("=") for c in headers.get("cookie", "").split(";"))
        return any(name == self.cookie and guard.is_token(value, self.token) for name, _, value in found)


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            extra = dict(guard.HEADERS)
            names = {k.lower() for k, _ in message["headers"]}
            extra |= {} if b"cache-control" in names else {"Cache-Control": "no-store"}
            message["headers"] = [*message["headers"], *((k.encode(), v.encode()) for k, v in extra.items())]
        await send(message)

    return sending


def _limited(receive: Receive) -> Receive:
    """A body of so many bytes that were read, whatever was announced."""
    n = 0

    async def receiving() -> Message:
        nonlocal n
        message = await receive()
        n += len(message.get("body", b""))
        if n > _LONGEST_BODY:
            raise _TooLongError
        return message

    return receiving


class _TooLongError(Exception):
    pass


class Server:
    """What is served, and the one thread in which everything about the project runs."""

    def __init__(self, bench: Workbench, token: str, cookie: str = "labsurvey") -> None:
        self.bench, self.token, self.cookie = bench, token, cookie
        self.live, self._worker = Live(), ThreadPoolExecutor(1, "workbench")
        self._running = ""
        self._files = {f"/{p.relative_to(WEB).as_posix()}": p for p in WEB.rglob("*") if p.suffix in _KINDS}
        bench.watch = self._progress

    def app(self) -> ASGIApp:
        """The application, guarded."""
        get: dict[str, _Handler] = {
            "/api/state": self._state, "/api/points": self._points, "/api/image/{camera}/{epoch}": self._image,
            "/api/readings": self._view(views.readings), "/api/parameters": self._view(views.parameters),
            "/api/scene": self._view(views.scene), "/api/findings": self._view(views.findings),
            "/api/changes": self._view(_changes), "/api/loops": self._view(views.loops),
            "/api/table_residuals": self._view(views.table_residuals), "/api/camera/{camera}": self._camera,
            "/api/camera/{camera}/difference": self._difference, "/api/runs": self._view(views.runs),
            "/api/compare": self._compare,
            "/api/statistics/{part}": self._statistics,
        }  # fmt: skip
        post: dict[str, _Handler] = {
            "/api/preview": self._preview, "/api/exclusions": self._exclusions, "/api/adjust": self._adjust,
            "/api/definition": self._definition,
            "/api/undo": self._act("undo"), "/api/redo": self._act("redo"), "/api/save": self._save,
            "/api/runs/{number:int}/restore": self._restore, "/api/runs/{number:int}/pin": self._pin,
            "/api/reload": self._reload, "/api/cancel": self._cancel,
        }  # fmt: skip
        routes = [Route(path, self._said(f), methods=["GET"]) for path, f in get.items()]
        routes += [Route(path, self._said(f), methods=["POST"]) for path, f in post.items()]
        routes.append(Route("/{path:path}", self._file, methods=["GET"]))
        app = Starlette(routes=[*routes, WebSocketRoute("/live", self.live.serve)], lifespan=self._lifespan)
        return Guard(app, self.token, self.cookie, self.bench.read_only)

    @asynccontextmanager
    async def _lifespan(self, _app: Starlette) -> AsyncIterator[None]:
        self.live.begin()
        tasks = [asyncio.create_task(self._watch_folder())]
        if self.bench.version == 0:
            tasks.append(asyncio.create_task(self._first()))
        yield
        for task in tasks:
            task.cancel()
        self.bench.cancel()
        self.live.post(None)
        self._worker.shutdown(wait=False, cancel_futures=True)

    async def _first(self) -> None:
        """The first adjustment, while the page already shows what there is."""
        try:
            await self._run("adjust", self.bench.adjust)
        except (SurveyError, OSError) as error:
            self.live.post({"type": "error", "error": str(error)})

    async def _watch_folder(self) -> None:
        told: tuple[str, ...] = ()
        while True:
            await asyncio.sleep(_LOOK_S)
            changed = await asyncio.to_thread(self.bench.changed_files)
            if changed != told and not self._running:  # else it may be what is being written here
                told = changed
                self.live.post({"type": "folder", "changed": list(changed), "lock": self.bench.holder()})

    def _progress(self, step: int, omega: float) -> None:
        self.live.post({"type": "progress", "what": self._running, "step": step, "omega": omega})

    async def _run(self, what: str, work: Callable[[], Any]) -> Any:
        """In the one thread, in turn; pages hear of the new state where there is one."""
        version = self.bench.version

        def working() -> Any:
            self._running = what
            try:
                return work()
            finally:
                self._running = ""

        try:
            return await asyncio.get_running_loop().run_in_executor(self._worker, working)
        finally:
            if self.bench.version != version or what == "save":
                self.live.post({"type": "state", "version": self.bench.version, "unsaved": self.bench.n_unsaved})

    def _said(self, handler: _Handler) -> _Handler:
        """What its owner can mend is an answer of one line."""

        async def answering(request: Request) -> Response:
            try:
                return await handler(request)
            except CancelledError as error:
                return JSONResponse({"error": str(error), "cancelled": True}, 409)
            except (ChangedError, BusyError) as error:
                return JSONResponse({"error": str(error), "version": self.bench.version, "retry": True}, 409)
            except SurveyError as error:
                return JSONResponse({"error": str(error), "version": self.bench.version}, 409)
            except OSError as error:
                return JSONResponse({"error": f"{error.filename}: {error.strerror}"}, 409)
            except (_BodyError, ClientDisconnect) as error:
                return JSONResponse({"error": f"not understood: {error}"}, 400)
            except _TooLongError:
                return JSONResponse({"error": f"more than {_LONGEST_BODY} bytes"}, 413)

        return answering

    # reading

    async def _file(self, request: Request) -> Response:
        path = self._files.get("/index.html" if request.url.path == "/" else request.url.path)
        if path is None:
            return JSONResponse({"error": "no such page"}, 404)
        return Response(path.read_bytes(), media_type=_KINDS[path.suffix])

    async def _state(self, _request: Request) -> Response:
        found = await asyncio.to_thread(views.state, self.bench)
        response = JSONResponse(found | {"running": self._running})
        response.set_cookie(self.cookie, self.token, httponly=True, samesite="strict")
        return response

    def _view(self, view: Callable[[Workbench], dict[str, Any]]) -> _Handler:
        async def answering(_request: Request) -> Response:
            return JSONResponse(await self._run("view", lambda: view(self.bench)))

        return answering

    async def _points(self, request: Request) -> Response:
        q = request.query_params
        camera, _, epoch = q.get("image", "").partition("/")
        worst = int(q["worst"]) if q.get("worst", "").isdecimal() else 0
        data = await self._run("view", lambda: views.points(self.bench, camera, epoch, min(worst, _MOST_ROWS)))
        return Response(data, media_type="application/octet-stream")

    async def _statistics(self, request: Request) -> Response:
        part = request.path_params["part"]
        return JSONResponse(await self._run("statistics", lambda: views.statistics_part(self.bench, part)))

    async def _compare(self, request: Request) -> Response:
        a, b = (int(q) if (q := request.query_params.get(k, "")).isdecimal() else None for k in "ab")
        most = request.query_params.get("most", "")
        found = await self._run("compare", lambda: self.bench.compare(a, b))
        return JSONResponse(found.as_dict(int(most) if most.isdecimal() else None))

    async def _camera(self, request: Request) -> Response:
        camera, distance = request.path_params["camera"], _distance(request)
        return JSONResponse(await self._run("view", lambda: cameras.camera_view(self.bench, camera, distance)))

    async def _difference(self, request: Request) -> Response:
        camera, distance, q = request.path_params["camera"], _distance(request), request.query_params
        run = int(q["run"]) if q.get("run", "").isdecimal() else None
        other, bench = q.get("other", ""), self.bench
        return JSONResponse(await self._run("view", lambda: cameras.lens_change(bench, camera, run, other, distance)))

    async def _image(self, request: Request) -> Response:
        key = request.path_params["camera"], request.path_params["epoch"]
        project = self.bench.situation.everything
        asked = request.query_params.get("size", "1600")
        size = None if asked == "full" else int(asked) if asked.isdecimal() and 0 < int(asked) <= 4096 else 1600
        if key not in project.images:
            return JSONResponse({"error": "no such image"}, 404)
        tag = pictures.etag(project.detected.get(key), project.images[key], size)
        kept = {"ETag": tag, "Cache-Control": "private, no-cache"}
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers=kept)
        data, kind = await asyncio.to_thread(pictures.picture, project.images, key, size)
        return Response(data, media_type=kind, headers=kept)

    # acting

    async def _preview(self, request: Request) -> Response:
        body = _Body(await _json(request))
        excluded, included = body.changes()
        names, out = (excluded, True) if excluded else (included, False)
        return JSONResponse(await self._run("view", lambda: self.bench.preview(*names, excluded=out)))

    async def _exclusions(self, request: Request) -> Response:
        body = _Body(await _json(request))
        excluded, included = body.changes()
        return await self._decided(lambda: self.bench.decide(
            exclude=excluded, include=included, reason=body.text("reason"), author=body.text("author"), base=body.base()
        ))  # fmt: skip

    async def _definition(self, request: Request) -> Response:
        """One of: {group, factor}, {parameter, treatment}, {datum: kind, points, stations}."""
        body = _Body(await _json(request))
        base, bench = body.base(), self.bench
        if body.text("group"):
            return await self._decided(lambda: bench.set_sigma_scale(body.text("group"), body.number("factor"), base))
        if body.text("parameter"):
            name, treatment = body.text("parameter"), body.text("treatment")
            return await self._decided(lambda: bench.set_treatment(name, treatment, base))
        kind, points, stations = body.text("datum"), body.names("points"), body.names("stations")
        return await self._decided(lambda: bench.set_datum(kind, points, stations, base))

    async def _decided(self, work: Callable[[], Any]) -> Response:
        await self._run("adjust", work)
        return JSONResponse(await asyncio.to_thread(views.state, self.bench) | _changes(self.bench))

    async def _adjust(self, request: Request) -> Response:
        mode = _Body(await _json(request)).text("mode")
        return await self._decided(lambda: self.bench.adjust("cold" if mode == "cold" else "warm"))

    def _act(self, verb: str) -> _Handler:
        async def answering(request: Request) -> Response:
            base = _Body(await _json(request)).base()
            return await self._decided(lambda: getattr(self.bench, verb)(base))

        return answering

    async def _restore(self, request: Request) -> Response:
        number, base = request.path_params["number"], _Body(await _json(request)).base()
        return await self._decided(lambda: self.bench.restore(number, base))

    async def _pin(self, request: Request) -> Response:
        number, pinned = request.path_params["number"], _Body(await _json(request)).flag("pinned")
        run = await self._run("pin", lambda: pin_run(self.bench.folder, number, pinned))
        return JSONResponse(run.as_dict())

    async def _reload(self, _request: Request) -> Response:
        return await self._decided(self.bench.reload)

    async def _save(self, _request: Request) -> Response:
        outcome = await self._run("save", self.bench.save)
        return JSONResponse(outcome.summary())

    async def _cancel(self, _request: Request) -> Response:
        self.bench.cancel()
        return JSONResponse({})


def _changes(bench: Workbench) -> dict[str, Any]:
    found = bench.changes
    return {"version": bench.version, "changes": None if found is None else found.as_dict(500)}


def _distance(request: Request) -> float:
    """What a request says of how far a point is, m; at infinity where it says nothing. Raises SurveyError."""
    text = request.query_params.get("distance_m", "inf")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not value > 0.0:
        raise SurveyError(f"distance_m: found {text!r}; expected metres, or inf")
    return value


class _BodyError(Exception):
    pass


async def _json(request: Request) -> Any:
    body = await request.body()
    try:
        return json.loads(body or b"{}")
    except (ValueError, RecursionError) as error:
        raise _BodyError(str(error)) from error


class _Body:
    """What a request says, checked."""

    def __init__(self, values: Any) -> None:
        if not isinstance(values, dict):
            raise _BodyError("expected an object")
        self._values = values

    def text(self, key: str) -> str:
        value = self._values.get(key, "")
        if not isinstance(value, str):
            raise _BodyError(f"{key}: expected a text")
        return value

    def number(self, key: str) -> float:
        value = self._values.get(key)
        if type(value) not in (int, float):
            raise _BodyError(f"{key}: expected a number")
        return float(str(value))

    def names(self, key: str) -> list[str]:
        value = self._values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(x, str) for x in value):
            raise _BodyError(f"{key}: expected a list of names")
        return value

    def flag(self, key: str) -> bool:
        value = self._values.get(key, True)
        if type(value) is not bool:
            raise _BodyError(f"{key}: expected true or false")
        return value

    def base(self) -> int | None:
        value = self._values.get("base")
        if value is not None and type(value) is not int:
            raise _BodyError("base: expected the version of a solution")
        return value

    def changes(self) -> tuple[list[str], list[str]]:
        """Names to exclude and to include, of ``changes: [{name} or {what, id}, excluded]``."""
        found = self._values.get("changes", [])
        if not isinstance(found, list) or not found or not all(isinstance(c, dict) for c in found):
            raise _BodyError("changes: expected a list of {what, id, excluded}")
        names: tuple[list[str], list[str]] = ([], [])
        for c in found:
            name = c.get("name", c.get("id") if c.get("what") == "reading" else f"{c.get('what')}:{c.get('id')}")
            if not isinstance(name, str) or type(c.get("excluded")) is not bool:
                raise _BodyError("changes: expected {what, id, excluded}")
            names[0 if c["excluded"] else 1].append(name)
        return names


class Listening:
    """A server in a thread of its own, so that the signals of this one stay ours whatever a library does to them."""

    def __init__(self, server: Server, host: str, port: int) -> None:
        import uvicorn

        config = uvicorn.Config(server.app(), host=host, port=port, log_level="critical", access_log=False,
                                ws="websockets-sansio", timeout_graceful_shutdown=1, server_header=False,
                                ws_max_size=1 << 16)  # fmt: skip
        self._socket = _bound(host, port)
        self._server, self._program = server, uvicorn.Server(config)
        self._thread = threading.Thread(target=self._program.run, args=([self._socket],), daemon=True)

    @property
    def address(self) -> str:
        """Where the page is, without the token."""
        host, port = self._socket.getsockname()[:2]
        return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"

    def __enter__(self) -> "Listening":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Sockets of pages that are still open end first: the server would wait for them."""
        self._server.bench.cancel()
        self._server.live.post(None)
        self._program.should_exit = True
        self._thread.join(10.0)
        self._socket.close()


def _bound(host: str, port: int) -> socket.socket:
    found = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind((host, port))
        found.listen(128)
    except OSError as error:
        found.close()
        raise guard.port_error(port, error) from error
    return found
