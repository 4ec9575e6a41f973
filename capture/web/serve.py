"""The web server of ``labcapture view``: loopback only, read-only unless moving was allowed at the start."""

import asyncio
import json
import signal
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Scope

from adjust.model.errors import SurveyError
from capture.plan.plan import read_plan
from capture.web.state import LiveView, SessionView, View, png_of
from survey.report.modules import WEB as SHARED
from survey.workbench import guard
from survey.workbench.live import Listening

_WEB = Path(__file__).parent
_KINDS = {".js": "text/javascript", ".css": "text/css", ".json": "application/json", ".svg": "image/svg+xml"}
_FILES = {"/": (_WEB / "page.html", "text/html")} | {
    f"/{path.name}": (path, _KINDS[path.suffix])
    for at in (SHARED, _WEB) for path in at.glob("*") if path.suffix in _KINDS
}  # fmt: skip
_LONGEST_PX = 1600
_ENDINGS = {signal.SIGINT, signal.SIGTERM}


class _Guard(guard.Guard):
    """Whoever sits at this machine may look; a command needs the token."""

    def refused(self, scope: Scope, headers: Mapping[str, str]) -> tuple[int, str] | None:
        """See ``Guard``."""
        if not guard.is_from_here(headers.get("host", ""), headers.get("origin")):
            return 403, guard.NOT_FROM_HERE
        if scope["method"] in ("GET", "HEAD"):
            return None
        if not self.token:
            return 403, "read-only; start it with --live --allow-move to turn the table"
        return None if guard.is_token(headers.get("x-token", ""), self.token) else (403, guard.WRONG_TOKEN)


class Pages:
    """What is served of a view. token: what commands must bring; None where nothing may be commanded."""

    def __init__(self, view: View, token: str | None = None) -> None:
        self.view, self.token = view, token

    def app(self) -> ASGIApp:
        """The application, guarded."""
        routes = [
            Route("/status.json", self._status), Route("/image/{camera}.png", self._image),
            *(Route(path, self._command, methods=["POST"]) for path in ("/jog", "/stop")),
            Route("/{path:path}", _file),
        ]  # fmt: skip
        return _Guard(Starlette(routes=routes, exception_handlers={Exception: _shown}), self.token or "", "labcapture")

    def end(self) -> None:
        """Nothing runs but what is asked for."""

    def _status(self, _request: Request) -> Response:
        return JSONResponse({**self.view.status(), "may_move": self.token is not None})

    def _image(self, request: Request) -> Response:
        shown = self.view.shown(request.path_params["camera"])
        if shown is None:
            return JSONResponse({"error": "no image yet"}, 404)
        longest_px = None if request.query_params.get("size") == "full" else _LONGEST_PX
        return Response(png_of(shown.image, longest_px), media_type="image/png")

    async def _command(self, request: Request) -> Response:
        """To the table."""
        try:
            words = [str(word) for word in json.loads(await request.body() or b"{}").get("jog", [])]
            if request.url.path == "/stop":
                await asyncio.to_thread(self.view.stop)
            else:
                await asyncio.to_thread(self.view.jog, words)
        except guard.TooLongError:
            return JSONResponse({"error": f"more than {guard.LONGEST_BODY} bytes"}, 413)
        except (ValueError, AttributeError, TypeError) as error:
            return JSONResponse({"error": f"not understood: {error}"}, 400)
        except SurveyError as error:
            return JSONResponse({"error": str(error)}, 409)
        return JSONResponse({})


def _file(request: Request) -> Response:
    if request.url.path not in _FILES:
        return JSONResponse({"error": "no such page"}, 404)
    path, kind = _FILES[request.url.path]
    return Response(path.read_bytes(), media_type=kind)


def _shown(_request: Request, error: Exception) -> Response:
    """A bug is shown to whoever has started this."""
    traceback.print_exception(error)
    return JSONResponse({"error": "the program has failed; see its terminal"}, 500)


def serve(
    path: Path, *, host: str, port: int, live: bool, allow_move: bool, say: Callable[[str], None]
) -> int:
    """Serve until Ctrl-C; the exit code. Raises SurveyError."""
    plan = read_plan(path)
    address = guard.loopback_address(host)
    if allow_move and not live:
        raise SurveyError("--allow-move needs --live: while a session runs, the session alone moves the table")
    token = guard.new_token() if allow_move else None
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDINGS)  # in all threads from here on: this one waits for them
    try:
        view: View = LiveView(plan, allow_move) if live else SessionView(plan)
        try:
            with Listening(Pages(view, token), address, port) as listening:
                print(listening.address + (f"#{token}" if token else ""), flush=True)
                say("Ctrl-C ends it")
                signal.sigwait(_ENDINGS)
                if token is not None:
                    view.stop()
        finally:
            view.close()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return 0
