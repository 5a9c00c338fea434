"""Whether an X server answers at the display that the environment names."""

from __future__ import annotations

import os
import socket
from typing import Any


def display_answers(seconds: float = 2.0) -> bool:
    """Whether a server answers at the display that ``DISPLAY`` names; over ssh or under cron there may be none."""
    host, _, number = os.environ.get("DISPLAY", "").rpartition(":")
    screen = number.partition(".")[0]
    if not screen.isdecimal():
        return False
    if host in ("", "unix"):
        # Abstract first, as X clients do.
        return any(
            _connects(socket.AF_UNIX, f"{root}/tmp/.X11-unix/X{screen}", seconds) for root in ("\0", "")
        )
    return any(
        _connects(family, address[:2], seconds)
        for family, _, _, _, address in _addresses(host, 6000 + int(screen))
        if family in (socket.AF_INET, socket.AF_INET6)
    )


def _addresses(host: str, port: int) -> list[Any]:
    try:
        return socket.getaddrinfo(host.partition("/")[0], port, type=socket.SOCK_STREAM)
    except OSError:
        return []


def _connects(family: int, address: Any, seconds: float) -> bool:
    with socket.socket(family, socket.SOCK_STREAM) as client:
        client.settimeout(seconds)
        try:
            client.connect(address)
        except OSError:
            return False
    return True
