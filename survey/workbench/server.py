"""The local server of ``labsurvey open``: one project, one browser on this machine, a token.

Everything that it answers stands in the table of :mod:`survey.workbench.addresses`, what runs meanwhile in
:mod:`survey.workbench.work`.
"""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp

from adjust.model.errors import SurveyError
from survey.report.language import LANGUAGES, message, speaking
from survey.report.modules import WEB as SHARED
from survey.workbench.addresses import WAYS, Way, answered
from survey.workbench.guard import Guard
from survey.workbench.pages.files import Files
from survey.workbench.work import Work

if TYPE_CHECKING:
    from survey.workbench.work import Shown

WEB = Path(__file__).parent / "web"


class Server:
    """What is served, to whoever has the token."""

    def __init__(self, shown: "Shown | Callable[[], Shown]", token: str, cookie: str = "labsurvey") -> None:
        self.work, self.token, self.cookie = Work(shown), token, cookie

    def app(self) -> ASGIApp:
        """The application, guarded."""
        routes = [Route(way.path, self._answering(way), methods=[way.method]) for way in WAYS]
        routes.append(Route("/{path:path}", Files([SHARED, WEB]).serve, methods=["GET"]))
        app = Starlette(routes=[*routes, WebSocketRoute("/live", self.work.live.serve)], lifespan=self._lifespan)
        return Guard(app, self.token, self.cookie)

    def end(self) -> None:
        """Give up what runs, and the messages to pages."""
        self.work.end()

    @asynccontextmanager
    async def _lifespan(self, _app: Starlette) -> AsyncIterator[None]:
        self.work.live.begin()
        tasks = [asyncio.create_task(task()) for task in (self.work.open, self.work.watch_folder)]
        yield
        for task in tasks:
            task.cancel()
        self.work.close()

    def _answering(self, way: Way) -> Callable[[Request], Awaitable[Response]]:
        """What answers at an address, in the language that is asked for, once there is what is shown."""

        async def answering(request: Request) -> Response:
            asked = request.headers.get("x-language", "en")
            with speaking(asked if asked in LANGUAGES else "en"):
                try:
                    await asyncio.shield(asyncio.wrap_future(self.work.opened))
                except SurveyError as error:
                    told = BackgroundTask(self.work.told.set)
                    return JSONResponse({"error": message(str(error))}, 409, background=told)
                response = await answered(self.work, way, request)
                if way.signs_in:
                    response.set_cookie(self.cookie, self.token, httponly=True, samesite="strict")
                return response

        return answering
