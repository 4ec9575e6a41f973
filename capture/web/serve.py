"""The web server of ``labcapture view``: loopback only, read-only unless moving was allowed at the start.

A page of another site that the same browser shows must not reach it: the Host header has to name this machine (else DNS
rebinding would do), commands need a token that only the printed address holds, and no other origin is accepted.
"""

import json
import signal
import socket
import sys
import threading
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from adjust.model.errors import SurveyError
from capture.plan.plan import read_plan
from capture.web.state import LiveView, SessionView, View, png_of
from survey.report.modules import WEB as SHARED
from survey.workbench import guard

_WEB = Path(__file__).parent
_KINDS = {".js": "text/javascript", ".css": "text/css", ".json": "application/json", ".svg": "image/svg+xml"}
_FILES = {"/": (_WEB / "page.html", "text/html")} | {
    f"/{path.name}": (path, _KINDS[path.suffix])
    for at in (SHARED, _WEB) for path in at.glob("*") if path.suffix in _KINDS
}  # fmt: skip
_HEADERS = {**guard.HEADERS, "Cache-Control": "no-store"}
_LONGEST_BODY, _LONGEST_PX = 4096, 1600
_ENDINGS = {signal.SIGINT, signal.SIGTERM}


class PageServer(ThreadingHTTPServer):
    """Serves one view. token: what commands must bring; None where nothing may be commanded."""

    daemon_threads = True

    def __init__(self, view: View, host: str = "127.0.0.1", port: int = 0, token: str | None = None) -> None:
        self.view, self.token = view, token
        address = guard.loopback_address(host)
        if ":" in address:
            self.address_family = socket.AF_INET6
        try:
            super().__init__((address, port), _Handler)
        except OSError as error:
            raise guard.port_error(port, error) from error

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that leaves in the middle of an answer is no error of ours."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)

    @property
    def url(self) -> str:
        """Where the page is, without the token."""
        host, port = self.server_address[:2]
        text = host.decode() if isinstance(host, bytes | bytearray) else str(host)
        return f"http://[{text}]:{port}/" if ":" in text else f"http://{text}:{port}/"


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    timeout = 30

    def do_GET(self) -> None:
        """Page, status, images."""
        path = urlsplit(self.path).path
        if not self._is_from_here():
            return
        if path in _FILES:
            file, kind = _FILES[path]
            self._answer(file.read_bytes(), f"{kind}; charset=utf-8")
        elif path == "/status.json":
            said = {**self.server.view.status(), "may_move": self.server.token is not None}
            self._answer(json.dumps(said).encode(), "application/json")
        elif path.startswith("/image/") and path.endswith(".png"):
            shown = self.server.view.shown(unquote(path.removeprefix("/image/").removesuffix(".png")))
            if shown is None:
                self._refuse(HTTPStatus.NOT_FOUND, "no image yet")
            else:
                longest_px = None if "size=full" in urlsplit(self.path).query.split("&") else _LONGEST_PX
                self._answer(png_of(shown.image, longest_px), "image/png")
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "no such page")

    def do_HEAD(self) -> None:
        """What GET would answer, without its body."""
        self.do_GET()

    def do_POST(self) -> None:
        """Commands to the table."""
        if not self._is_from_here() or not self._may_move():
            return
        try:
            length = int(self.headers.get("Content-Length", "0"))
            if not 0 <= length <= _LONGEST_BODY:
                raise ValueError(f"{length} bytes")
            body = json.loads(self.rfile.read(length) or b"{}")
            words = [str(word) for word in body.get("jog", [])]
        except (ValueError, AttributeError, TypeError) as error:
            return self._refuse(HTTPStatus.BAD_REQUEST, f"not understood: {error}")
        path = urlsplit(self.path).path
        try:
            if path == "/stop":
                self.server.view.stop()
            elif path == "/jog":
                self.server.view.jog(words)
            else:
                return self._refuse(HTTPStatus.NOT_FOUND, "no such command")
        except SurveyError as error:
            return self._refuse(HTTPStatus.CONFLICT, str(error))
        return self._answer(b"{}", "application/json")

    def _is_from_here(self) -> bool:
        """Whether the browser believes to talk to this machine, and no page of another site talks through it.

        The port is what the browser was told: behind a forwarded one it is not ours.
        """
        if guard.is_from_here(self.headers.get("Host", ""), self.headers.get("Origin")):
            return True
        self._refuse(HTTPStatus.FORBIDDEN, guard.NOT_FROM_HERE)
        return False

    def _may_move(self) -> bool:
        token = self.server.token
        if token is None:
            self._refuse(HTTPStatus.FORBIDDEN, "read-only; start it with --live --allow-move to turn the table")
            return False
        if not guard.is_token(self.headers.get("X-Token", ""), token):
            self._refuse(HTTPStatus.FORBIDDEN, guard.WRONG_TOKEN)
            return False
        return True

    def _refuse(self, status: HTTPStatus, reason: str) -> None:
        self._answer(json.dumps({"error": reason}).encode(), "application/json", status)

    def _answer(self, data: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(data)), **_HEADERS}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not worth a line each."""


def serve(
    path: Path, *, host: str, port: int, live: bool, allow_move: bool, say: Callable[[str], None]
) -> int:
    """Serve until Ctrl-C; the exit code. Raises SurveyError."""
    plan = read_plan(path)
    guard.loopback_address(host)
    if allow_move and not live:
        raise SurveyError("--allow-move needs --live: while a session runs, the session alone moves the table")
    token = guard.new_token() if allow_move else None
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDINGS)  # in all threads from here on: this one waits for them
    try:
        view: View = LiveView(plan, allow_move) if live else SessionView(plan)
    except BaseException:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        raise
    try:
        with PageServer(view, host, port, token) as server:
            print(server.url + (f"#{token}" if token else ""), flush=True)
            say("Ctrl-C ends it")
            threading.Thread(target=server.serve_forever, daemon=True).start()
            signal.sigwait(_ENDINGS)
            if token is not None:
                view.stop()
            server.shutdown()
    finally:
        view.close()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return 0
