"""Who may talk to a page that is served on this machine: nobody but a browser on it that knows the token.

A page of another site that the same browser shows must not reach it: the Host header has to name this machine (else DNS
rebinding would do), no other origin is accepted, and what changes anything needs a token that only the printed address
holds.
"""

import ipaddress
import secrets
from collections.abc import Mapping
from urllib.parse import urlsplit

from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from adjust.model.errors import SurveyError

LONGEST_BODY = 1 << 20
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob:; connect-src 'self'; frame-ancestors 'none'; "
    "base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
NOT_FROM_HERE = "this page is for this machine only"
WRONG_TOKEN = "the token is missing or wrong; use the address that was printed"


def is_this_machine(host: str) -> bool:
    """Whether the name in a Host header, whatever the port, is this machine's own: no name that others can give."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def is_from_here(host: str, origin: str | None, needed: bool = False) -> bool:
    """Whether the browser believes to talk to this machine, and no page of another site talks through it.

    The port is what the browser was told: behind a forwarded one it is not ours. needed: an origin has to be given.
    """
    same = not needed if origin is None else origin.partition("://")[2] == host
    return is_this_machine(host) and same


def new_token() -> str:
    """128 random bits as text."""
    return secrets.token_urlsafe(16)


def is_token(given: str, token: str) -> bool:
    """Whether a text is the token, in a time that does not tell how much of it is right."""
    return secrets.compare_digest(given.encode("utf-8", "surrogateescape"), token.encode())


def loopback_address(host: str, port: int = 8780) -> str:
    """The address to listen on; raises SurveyError for anything that others could reach."""
    text = "127.0.0.1" if host == "localhost" else host
    try:
        address = ipaddress.ip_address(text)
    except ValueError as error:
        raise SurveyError(f"--host {host!r}: not an address; the page is served on 127.0.0.1 or ::1") from error
    if not address.is_loopback:
        raise SurveyError(
            f"--host {host}: others could reach the laboratory there; the page is served on loopback only, so from "
            f"another machine go through: ssh -L {port}:127.0.0.1:{port} THIS_MACHINE"
        )
    return text


def port_error(number: int, error: OSError) -> SurveyError:
    """What to say where a port cannot be listened on."""
    return SurveyError(f"port {number} cannot be used ({error.strerror}); name another with --port, 0 takes a free one")


class Guard:
    """Refuses everything that does not come from a browser on this machine that has the token.

    token: what requests must bring in the header X-Token; images and the socket by a cookie of the name ``cookie``,
    which no script can read and no other site sends.
    """

    def __init__(self, app: ASGIApp, token: str, cookie: str) -> None:
        self.app, self.token, self.cookie = app, token, cookie

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers = {k.decode("latin-1"): v.decode("latin-1") for k, v in scope["headers"]}
        refused = self.refused(scope, headers)
        if refused is not None and scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
            return
        answer = _with_headers(send)
        if refused is not None:
            await JSONResponse({"error": refused[1]}, refused[0])(scope, receive, answer)
            return
        await self.app(scope, _limited(receive) if scope["type"] == "http" else receive, answer)

    def refused(self, scope: Scope, headers: Mapping[str, str]) -> tuple[int, str] | None:
        """Why a request is refused, with the status, or None."""
        is_socket, path, method = scope["type"] == "websocket", scope["path"], scope.get("method")
        if not is_from_here(headers.get("host", ""), headers.get("origin"), needed=is_socket):
            return 403, NOT_FROM_HERE
        if not (is_socket or path.startswith("/api/")):
            return None if method in ("GET", "HEAD") else (405, "only GET")
        by_cookie = is_socket or (method in ("GET", "HEAD") and path.startswith("/api/image/"))
        if not is_token(headers.get("x-token", ""), self.token) and not (by_cookie and self._in_cookie(headers)):
            return 403, WRONG_TOKEN
        if method == "POST" and headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            return 415, "the body has to be application/json"
        return None

    def _in_cookie(self, headers: Mapping[str, str]) -> bool:
        found = (c.strip().partition("=") for c in headers.get("cookie", "").split(";"))
        return any(name == self.cookie and is_token(value, self.token) for name, _, value in found)


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            extra = dict(HEADERS)
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
        if n > LONGEST_BODY:
            raise TooLongError
        return message

    return receiving


class TooLongError(Exception):
    """A body of more than ``LONGEST_BODY`` bytes."""
