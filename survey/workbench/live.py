"""Listening in a thread of its own, and messages to all pages that are open."""

import asyncio
import json
import socket
import threading
from contextlib import suppress
from typing import Protocol

from starlette.types import ASGIApp
from starlette.websockets import WebSocket, WebSocketDisconnect

from survey.workbench import guard


class Live:
    """Messages to all pages that are open; ``post`` may be called from any thread.

    What holds until it is told otherwise, by its type in `STANDING`, is told to a page that joins later, too.
    """

    STANDING = ("state", "folder")

    def __init__(self) -> None:
        self._queues: set[asyncio.Queue[dict[str, object] | None]] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._standing: dict[str, dict[str, object]] = {}
        self.joined = asyncio.Event()

    def begin(self) -> None:
        """Belong to the loop that runs."""
        self._loop = asyncio.get_running_loop()

    def post(self, message: dict[str, object] | None) -> None:
        """Send to all; None ends them."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._put, message)

    def _put(self, message: dict[str, object] | None) -> None:
        if message is not None and message["type"] in self.STANDING:
            self._standing[message["type"]] = message
        for queue in self._queues:
            queue.put_nowait(message)

    async def serve(self, page: WebSocket) -> None:
        """Until the page or the server goes."""
        await page.accept()
        queue: asyncio.Queue[dict[str, object] | None] = asyncio.Queue()
        for message in self._standing.values():
            queue.put_nowait(message)
        self._queues.add(queue)
        self.joined.set()
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


class Served(Protocol):
    """What is listened for: an application, and how what runs for its pages is given up."""

    def app(self) -> ASGIApp:
        """The application, guarded."""

    def end(self) -> None:
        """Give up what runs."""


class Listening:
    """A server in a thread of its own, so that the signals of this one stay ours whatever a library does to them."""

    def __init__(self, server: Served, host: str, port: int) -> None:
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
        """What runs for pages that are still open ends first: the server would wait for it."""
        self._server.end()
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
