"""Who may talk to a page that is served on this machine: nobody but a browser on it that knows the token.

A page of another site that the same browser shows must not reach it: the Host header has to name this machine (else DNS
rebinding would do), no other origin is accepted, and what changes anything needs a token that only the printed address
holds.
"""

import ipaddress
import secrets
from urllib.parse import urlsplit

from adjust.model.errors import SurveyError

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
