"""What of all that asks for something is let through to the application."""

from collections.abc import Mapping

from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from survey.workbench import guard

LONGEST_BODY = 1 << 20


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
        if n > LONGEST_BODY:
            raise TooLongError
        return message

    return receiving


class TooLongError(Exception):
    """A body of more than ``LONGEST_BODY`` bytes."""
