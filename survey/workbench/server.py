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
from survey.commands.parser import port_error
from survey.folder.locking import BusyError
from survey.workbench import guard, pictures, views
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
    except OSError as error:
        found.close()
        raise port_error(port, error) from error
    return found
