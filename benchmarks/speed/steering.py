"""How soon a hand on the pad reaches the motors, and how often the page is renewed.

    OMP_NUM_THREADS=1 python benchmarks/speed/steering.py

Steers WAMWipe through an untrained NHT (10 numbers of context, two layers of 256) at real time. Without a browser, a
pad of ours sends a new action every 37 ms, and a viewer takes what comes and draws nothing. With Chromium, the mouse
drags the page's own pad: headless it draws in software on the same cores, which a graphics card would do, and therefore
runs at the lowest priority. Both measure from the clock of the pad before a command leaves until the step that executes
it begins; it is the same clock, as all runs on one machine. Updates are pictures that were sent, messages of them that
arrived, and those that Chromium drew. Writes ``results/steering/steering.csv``. Takes a minute, and Debian's
``chromium`` with ``pip install playwright``.
"""

from __future__ import annotations

import csv
import json
import os
import platform
import shutil
import statistics
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import torch
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

import nht
from nht.recipes.config import Steer
from nht.recipes.launch import configure
from nht.recipes.live.opening import open_page
from nht.recipes.live.pace import keep_pace

HERE = Path(__file__).parents[1]
WARM_UP, SECONDS = 3.0, 15.0
PAUSE = 0.037
"""Between two commands [s], so that they come at all moments of a step of 20 ms."""
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


class Counts:
    """What was measured, from any thread, while it is ``on``."""

    def __init__(self) -> None:
        self.on = False
        self.late: list[float] = []
        self.shown = self.messages = self.drawn = 0


def steer(counts: Counts, drive: Callable[[str, Counts], None]) -> None:
    """Run a page until ``drive``, in a thread of its own, has ended."""
    map = nht.NHT(context_dim=10, actuation_dim=7, action_dim=2)
    map.context_keys = ("tool_position", "joint_angle")
    with tempfile.TemporaryDirectory() as folder:
        nht.save_map(map, f"{folder}/nht.safetensors")
        words = [f"map.file={folder}/nht.safetensors", "port=0", f"out={folder}/none"]
        with open_page(configure(Steer, "steer", words)) as (session, page):
            tell = session.commands.on_reached

            def reached(pad: object, stamp: float) -> None:
                if counts.on and stamp:
                    counts.late.append(1e3 * time.time() - stamp)
                if tell is not None:
                    tell(pad, stamp)

            def show(part: float) -> None:
                page.show(part)
                counts.shown += counts.on

            session.commands.on_reached = reached
            hand = threading.Thread(target=drive, args=(page.address, counts))
            hand.start()
            keep_pace(session, show, hand.is_alive)


def by_socket(address: str, counts: Counts) -> None:
    """A pad without a page, and a viewer that takes all messages and draws nothing."""
    socket = address.replace("http", "ws")
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    with connect(socket, subprotocols=[protocol], max_size=None, compression=None) as viewer:
        threading.Thread(target=count_messages, args=(viewer, counts), daemon=True).start()
        with connect(f"{socket}/pad") as pad:
            start = time.monotonic()
            while (passed := time.monotonic() - start) < WARM_UP + SECONDS:
                counts.on = passed > WARM_UP
                action = [0.1 * (int(passed * 2) % 3 - 1), 0.1 * ((passed * 7) % 1.0)]
                pad.send(json.dumps({"action": action, "stamp": 1e3 * time.time()}))
                time.sleep(PAUSE)
            counts.on = False


def count_messages(viewer: ClientConnection, counts: Counts) -> None:
    with suppress(ConnectionClosed):
        for _ in viewer:
            counts.messages += counts.on


def by_mouse(address: str, counts: Counts) -> None:
    """The page in Chromium, whose pad the mouse drags."""
    from playwright.sync_api import sync_playwright

    def arrived(_: object) -> None:
        counts.messages += counts.on

    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        polite = Path(folder) / "chromium"
        polite.write_text(f'#!/bin/sh\nexec nice -n 19 {shutil.which("chromium")} "$@"\n')
        polite.chmod(0o755)
        browser = playwright.chromium.launch(executable_path=polite, args=FLAGS)
        page = browser.new_page(viewport={"width": 640, "height": 400})
        page.on(
            "websocket", lambda opened: opened.url.endswith("/pad") or opened.on("framereceived", arrived)
        )
        page.goto(address)
        pad = page.frame_locator("#pad").locator("#pad")
        pad.wait_for()
        time.sleep(10)  # until the scene is drawn
        page.evaluate("window.drawn = 0; (function count() { drawn += 1; requestAnimationFrame(count); })()")
        box = pad.bounding_box()
        assert box is not None
        across, down = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(across, down)
        page.mouse.down()
        start = time.monotonic()
        while (passed := time.monotonic() - start) < WARM_UP + SECONDS:
            if passed > WARM_UP and not counts.on:
                counts.on, first = True, page.evaluate("drawn")
            page.mouse.move(across + 10 * ((passed * 3) % 1.0), down + 10 * ((passed * 7) % 1.0))
            time.sleep(PAUSE)
        counts.on = False
        counts.drawn = page.evaluate("drawn") - first
        page.mouse.up()
        browser.close()


def row(name: str, counts: Counts) -> dict[str, object]:
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=HERE, capture_output=True, text=True)
    return {
        "driven by": name,
        "commands": len(counts.late),
        "median_ms": round(statistics.median(counts.late), 1),
        "ninetieth_ms": round(statistics.quantiles(counts.late, n=10)[-1], 1),
        "largest_ms": round(max(counts.late), 1),
        "within_100_ms": round(sum(late < 100 for late in counts.late) / len(counts.late), 4),
        "shown_per_s": round(counts.shown / SECONDS, 1),
        "messages_per_s": round(counts.messages / SECONDS, 1) if counts.messages else "",
        "drawn_per_s": round(counts.drawn / SECONDS, 1) if counts.drawn else "",
        "load": round(os.getloadavg()[0], 1),
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "torch": torch.__version__,
        "commit": commit.stdout.strip(),
    }


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    ways = {"a pad and a viewer that draws nothing": by_socket}
    if shutil.which("chromium"):
        ways["mouse in headless Chromium"] = by_mouse
    for name, drive in ways.items():
        counts = Counts()
        steer(counts, drive)
        rows.append(row(name, counts))
        print(rows[-1], flush=True)
    with open(HERE / "results" / "steering" / "steering.csv", "w", newline="") as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main()
