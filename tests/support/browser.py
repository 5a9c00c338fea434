"""A headless Chromium, the system's own: nothing is downloaded."""

import shutil
from contextlib import contextmanager
from importlib.util import find_spec

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = [
    "--no-sandbox",  # tests may run as root
    "--use-angle=swiftshader",  # draws without a GPU
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]


def chromium():
    """Path of the browser, or None."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


def missing():
    """What a test in the browser lacks here; empty if nothing."""
    if chromium() is None:
        return "there is no Chromium: Debian's package is called chromium"
    return "" if find_spec("playwright") else "playwright is not installed: pip install playwright"


@contextmanager
def browser():
    """Chromium, as playwright drives it."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium(), args=FLAGS)
        yield started
        started.close()


def open_page(browser, address, width=800, height=500):
    """The page of a running steer, once the pad and the scene are there; small, as it is drawn in software."""
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(120_000)  # drawn in software, on cores that others use, too
    page.asked, page.errors = [], []
    page.on("request", lambda request: page.asked.append(request.url))
    page.on("websocket", lambda opened: page.asked.append(opened.url))
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    page.goto(address)
    page.locator("[data-clock]").wait_for()
    page.frame_locator("#pad").get_by_text("1 ▸").wait_for()
    return page


def pad_centre(page):
    page.locator("#pad").scroll_into_view_if_needed()
    box = page.frame_locator("#pad").locator("#pad").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


@contextmanager
def held(page, x, y):
    """The mouse holds the pad's knob ``x`` to the right and ``y`` up, in [-1, 1]."""
    across, down = pad_centre(page)
    page.mouse.move(across, down)
    page.mouse.down()
    page.mouse.move(across + 80 * x, down - 80 * y, steps=4)
    yield
    page.mouse.up()
