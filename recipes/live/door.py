"""One port for the page and its pads: what arrives is led to the viewer, or to the pads' own connection."""

from __future__ import annotations

import asyncio
import errno
import json
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from typing import Any, Self
from urllib.parse import urlsplit

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

PAD_PATH = "/pad"
LOCAL = "127.0.0.1"
LONGEST_HEAD = 65_536
"""Bytes of a request's head, at most."""
LED_ON = 65_536
"""Bytes that are led on at once."""

Heard = Callable[[str, dict[str, Any]], object]
"""Called with a pad's name and what it said; with nothing said when it has left."""


class Door:
    """A port that browsers come to.

    The viewer listens on a port of this machine that nobody else needs to know. Connections from pages of other sites
    are refused: a page elsewhere in the browser must not drive the robot.

    Args:
        host: address that it listens on.
        port: of it; 0 takes one that is free.

    Raises:
        OSError: if the port is in use or the address is not this machine's; says what to do.
    """

    def __init__(self, host: str = LOCAL, port: int = 8080) -> None:
        self.host = host
        self._socket = _bound(host, port)
        self.port: int = self._socket.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="door", daemon=True)
        self._pads: dict[str, ServerConnection] = {}
        self._told: dict[str, Any] = {}
        self._viewer = self._pad_port = 0
        self._heard: Heard | None = None
        self._open = threading.Event()
        self._stop: asyncio.Event | None = None

    @property
    def address(self) -> str:
        """Where a browser finds the page."""
        shown = "localhost" if self.host in (LOCAL, "0.0.0.0", "::", "") else self.host
        return f"http://{shown}:{self.port}"

    def open(self, viewer: int, heard: Heard) -> None:
        """Let browsers in.

        Args:
            viewer: port of this machine that the viewer listens on.
            heard: told what pads say, in another thread.
        """
        self._viewer, self._heard = viewer, heard
        self._thread.start()
        self._open.wait(10)

    def tell(self, news: dict[str, Any], pad: str | None = None) -> None:
        """Send something to all pads, and to those that come later; or to one pad alone."""
        if pad is None:
            self._told |= news
        text = json.dumps(news)
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._send, text, pad)

    def _send(self, text: str, pad: str | None) -> None:
        for name, connection in list(self._pads.items()):
            if pad in (None, name):
                self._loop.create_task(_sent(connection, text))

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        self._stop = asyncio.Event()
        async with serve(self._serve_pad, LOCAL, 0, compression=None) as pads:
            self._pad_port = next(iter(pads.sockets)).getsockname()[1]
            async with await asyncio.start_server(self._enter, sock=self._socket, limit=LONGEST_HEAD):
                self._open.set()
                await self._stop.wait()
        for task in asyncio.all_tasks(self._loop) - {asyncio.current_task()}:
            task.cancel()

    async def _serve_pad(self, connection: ServerConnection) -> None:
        name = str(connection.id)
        self._pads[name] = connection
        try:
            await _sent(connection, json.dumps(self._told))
            async for text in connection:
                with suppress(ValueError):
                    said = json.loads(text)
                    if isinstance(said, dict) and self._heard is not None:
                        self._heard(name, said)
        except ConnectionClosed:
            pass
        finally:
            self._pads.pop(name, None)
            if self._heard is not None:
                self._heard(name, {})

    async def _enter(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Read the head of the first request, and lead the connection on to where it wants to go."""
        try:
            head = await reader.readuntil(b"\r\n\r\n")
            path, headers = _parsed(head)
            if not _same_site(headers):
                await _refuse(writer)
                return
            port = self._pad_port if path.partition("?")[0] == PAD_PATH else self._viewer
            inner, outer = await asyncio.open_connection(LOCAL, port)
        except (OSError, ValueError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            writer.close()
            return
        outer.write(head)
        await asyncio.gather(_pipe(reader, outer), _pipe(inner, writer))

    def close(self) -> None:
        """Close the port and all connections. A second call does nothing."""
        if self._thread.is_alive() and self._stop is not None:
            with suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(5)
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _bound(host: str, port: int) -> socket.socket:
    if not 0 <= port <= 65_535:
        raise ValueError(f"port must be in 0 ... 65535, got {port}.")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            told = f"port {port} of {host} is in use: choose another, port={port + 1}, or port=0 for any that is free."
        elif error.errno == errno.EACCES:
            told = f"port {port} is not for everybody: choose one above 1023, port=8080."
        else:
            told = f"cannot listen on {host}, port {port}: {error.strerror or error}. host=127.0.0.1 is this machine."
        raise OSError(error.errno, told) from error


def _parsed(head: bytes) -> tuple[str, dict[str, str]]:
    """Path and headers of a request."""
    first, *lines = head.decode("latin-1").split("\r\n")
    _, path, _ = first.split(" ", 2)
    pairs = (line.partition(":") for line in lines if ":" in line)
    return path, {name.strip().lower(): value.strip() for name, _, value in pairs}


def _same_site(headers: dict[str, str]) -> bool:
    """Whether a request comes from our own page, or from no page at all."""
    origin = headers.get("origin")
    return origin is None or urlsplit(origin).netloc == headers.get("host")


async def _refuse(writer: asyncio.StreamWriter) -> None:
    status = HTTPStatus.FORBIDDEN
    writer.write(
        f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n".encode()
    )
    with suppress(OSError):
        await writer.drain()
    writer.close()


async def _sent(connection: ServerConnection, text: str) -> None:
    with suppress(ConnectionClosed):
        await connection.send(text)


async def _pipe(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Lead everything from one end to the other until either closes."""
    with suppress(OSError, asyncio.CancelledError):
        while chunk := await reader.read(LED_ON):
            writer.write(chunk)
            await writer.drain()
    with suppress(OSError, RuntimeError):
        writer.close()
