"""Ports that carry lines of text: TCP by the standard library, everything else by pyserial."""

import contextlib
import select
import socket
import time
from collections.abc import Mapping
from typing import Any, Protocol
from urllib.parse import urlsplit

from capture.devices.turntable import TurntableError
from survey.folder.extras import library

_CONNECT_S = 3.0


class Port(Protocol):
    """What of pyserial's interface is used; all raise OSError where the connection is lost."""

    def write(self, data: bytes) -> Any:
        """Send all of it."""
        ...

    def read_until(self, end: bytes) -> bytes:
        """Up to and with ``end``, less where the time is over before."""
        ...

    def reset_input_buffer(self) -> None:
        """Forget what has arrived."""
        ...

    def close(self) -> None:
        """Disconnect."""
        ...


class TcpPort:
    """``socket://host:port`` without pyserial, which waits 0.3 s at every close: too long for a stop."""

    def __init__(self, url: str, timeout_s: float) -> None:
        parts = urlsplit(url)
        if parts.hostname is None or parts.port is None:
            raise ValueError(f"{url}: write socket://HOST:PORT")
        self._timeout_s, self._buffer = timeout_s, b""
        self._socket = socket.create_connection((parts.hostname, parts.port), timeout=_CONNECT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def write(self, data: bytes) -> None:
        """Send all of it."""
        self._socket.settimeout(_CONNECT_S)
        self._socket.sendall(data)

    def read_until(self, end: bytes) -> bytes:
        """Up to and with ``end``, less where the time is over before."""
        last = time.monotonic() + self._timeout_s
        while end not in self._buffer:
            if not select.select([self._socket], [], [], max(0.0, last - time.monotonic()))[0]:
                break
            self._receive()
        head, found, rest = self._buffer.partition(end)
        self._buffer = rest
        return head + found

    def _receive(self) -> None:
        data = self._socket.recv(4096)
        if not data:
            raise ConnectionError("the other side has closed the connection")
        self._buffer += data

    def reset_input_buffer(self) -> None:
        """Forget what has arrived."""
        while select.select([self._socket], [], [], 0)[0]:
            self._receive()
        self._buffer = b""

    def close(self) -> None:
        """Disconnect."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


def open_port(url: str, timeout_s: float, settings: Mapping[str, int | float | str]) -> Port:
    """A port by pyserial's URL. Raises OSError or ValueError; TurntableError where pyserial is missing."""
    if url.startswith("socket://"):
        return TcpPort(url, timeout_s)
    serial = library("serial", "serial", f"{url}: serial ports need pyserial", TurntableError)
    port: Port = serial.serial_for_url(url, timeout=timeout_s, write_timeout=1.0, **settings)
    return port
