"""The page in a real browser, headless: what people see, drag, press and record."""

import math
import re
import signal
import subprocess
import sys
import threading
import time

import pytest

import nht
from browser import browser, held, missing, open_page, pad_centre
from steered import map_file

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(missing()), reason=missing()),
    pytest.mark.timeout(600),
]


class Steering:
    """``steer`` in a process of its own, as people start it."""

    def __init__(self, *words):
        command = [sys.executable, "-m", "nht.recipes.steer", "port=0", *map(str, words)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.said = []
        self._reader = threading.Thread(target=lambda: self.said.extend(self.process.stdout), daemon=True)
        self._reader.start()
        until(lambda: any("steer at" in line for line in self.said) or self.process.poll() is not None, 120)
        assert self.process.poll() is None, self.said
        self.address = re.search(r"http://\S+?:\d+", "".join(self.said))[0]

    def interrupt(self):
        """Ctrl-C; gives the exit status."""
        self.process.send_signal(signal.SIGINT)
        status = self.process.wait(30)
        self._reader.join(10)
        return status


def until(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.05)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("steer")


@pytest.fixture(scope="module")
def steering(folder):
    files = [map_file(folder, "nht"), map_file(folder, "svd", kind=nht.SVD)]
    running = Steering(f"map.file={files[0]}", f"maps=[{files[1]}]", f"out={folder / 'by-hand'}")
    yield running
    if running.process.poll() is None:
        running.process.kill()


@pytest.fixture(scope="module")
def opened():
    with browser() as started:
        yield started


@pytest.fixture(scope="module")
def page(steering, opened):
    found = open_page(opened, steering.address)
    yield found
    found.close()


def choose(page, interface):
    page.get_by_label("Interface").click()
    page.get_by_role("option", name=interface, exact=True).click()
    page.get_by_text(f"person through {interface}").wait_for()


def press(page, name):
    page.get_by_role("button", name=name, exact=True).click()


def joints_now(page):
    """The grey bars: what each motor gets."""
    return page.evaluate(
        "[...document.querySelectorAll('[data-basis] rect[fill=\"#888\"]')].map((bar) => +bar.getAttribute('width'))"
    )


def basis_now(page):
    """The bars of the axes, which show the same columns as the arrows."""
    return page.evaluate(
        "[...document.querySelectorAll('[data-basis] rect:not([fill=\"#888\"])')].map((bar) => bar.outerHTML)"
    )


def tool_now(page):
    """Where the tool is [m]."""
    return [float(part) for part in page.locator("[data-tool]").inner_text().split()]


def picture(page):
    """The scene, without the panel, once nothing in it changes any more."""
    place = page.locator("canvas[data-engine]").bounding_box()
    shots = [b"", b" "]
    end = time.monotonic() + 60
    while shots[-1] != shots[-2]:
        assert time.monotonic() < end, "the picture never stands still"
        shots.append(page.screenshot(clip=place))
    return shots[-1]


def test_the_page_loads_and_asks_nothing_of_other_machines(page, steering):
    ours = (steering.address, steering.address.replace("http", "ws"), "data:", "blob:", "about:")
    assert [url for url in page.asked if not url.startswith(ours)] == []
    assert page.errors == []
    until(lambda: len(basis_now(page)) == 14)
    first = page.locator("[data-clock]").inner_text()
    until(lambda: page.locator("[data-clock]").inner_text() != first)


def test_a_drag_on_the_pad_moves_the_tool_and_letting_go_stops_it(page):
    press(page, "Next goal")
    before, seen = tool_now(page), picture(page)
    with held(page, 0.9, 0.0):
        until(lambda: math.dist(tool_now(page), before) > 0.05)
    until(lambda: not any(joints_now(page)))
    time.sleep(1)  # what is written lags behind by some frames
    after = tool_now(page)
    assert picture(page) != seen
    assert tool_now(page) == after
    assert page.evaluate("steerLatency.length") > 0


def test_arrow_keys_drive_and_are_not_the_camera_s(page):
    choose(page, "nht")
    press(page, "Next goal")
    before = tool_now(page)
    page.locator("canvas[data-engine]").click(position={"x": 30, "y": 300})
    page.keyboard.down("ArrowUp")
    until(lambda: math.dist(tool_now(page), before) > 0.05)
    page.keyboard.up("ArrowUp")
    until(lambda: not any(joints_now(page)))
    page.get_by_label("Interface").focus()  # where arrow keys have another meaning
    time.sleep(1)
    after = tool_now(page)
    page.keyboard.press("ArrowUp", delay=500)
    page.keyboard.press("Escape")
    assert tool_now(page) == after


def test_a_game_pad_drives(page):
    page.evaluate("navigator.getGamepads = () => [{connected: true, axes: [0.8, 0, 0, 0]}]")
    until(lambda: max(joints_now(page)) > 5)
    page.evaluate("navigator.getGamepads = () => [{connected: true, axes: [0, 0, 0, 0]}]")
    until(lambda: not any(joints_now(page)))
    page.evaluate("navigator.getGamepads = () => []")


def test_another_interface_changes_arrows_bars_and_sliders(page):
    frame = page.frame_locator("#pad")
    choose(page, "nht")
    until(lambda: len(basis_now(page)) == 14)
    bars, seen = basis_now(page), picture(page)
    choose(page, "svd")
    until(lambda: basis_now(page) != bars)
    assert picture(page) != seen  # nothing but the arrows can have changed
    choose(page, "joints")
    until(lambda: frame.locator("input[type=range]").count() == 5)
    choose(page, "jacobian")
    until(lambda: frame.locator("input[type=range]").count() == 4)
    choose(page, "nht")
    until(lambda: frame.locator("input[type=range]").count() == 0)


def test_a_slider_drives_a_third_axis_and_springs_back(page):
    choose(page, "joints")
    slider = page.frame_locator("#pad").locator("input[data-axis='4']")
    slider.wait_for()
    box = slider.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.9, box["y"] + box["height"] / 2, steps=4)
    until(lambda: joints_now(page)[4] > 5)
    page.mouse.up()
    until(lambda: not any(joints_now(page)))
    choose(page, "nht")


@pytest.fixture
def other(steering, opened):
    """The page of somebody else."""
    found = open_page(opened, steering.address)
    yield found
    found.close()


def test_several_viewers_see_the_same(page, other):
    choose(page, "svd")
    other.get_by_text("person through svd").wait_for()
    with held(page, 0.0, 0.8):
        knob = other.frame_locator("#pad").locator("#knob")
        until(lambda: float(knob.evaluate("(knob) => parseFloat(knob.style.top)")) < 40)
    choose(other, "nht")
    page.get_by_text("person through nht").wait_for()


def test_a_tab_that_is_closed_in_mid_drag_lets_go_and_the_recording_goes_on(page, other):
    press(page, "Record")
    page.get_by_text("● recording").or_(page.get_by_text(": 0 steps")).first.wait_for()
    across, down = pad_centre(other)
    other.mouse.move(across, down)
    other.mouse.down()
    other.mouse.move(across + 60, down, steps=3)
    until(lambda: max(joints_now(page)) > 5)
    other.close()
    until(lambda: not any(joints_now(page)))
    kept = int(page.locator("[data-recorded]").inner_text())
    until(lambda: int(page.locator("[data-recorded]").inner_text()) > kept)
    press(page, "Stop")
    press(page, "Discard last")
    until(lambda: page.locator("[data-recorded]").inner_text() == "0")


def test_what_is_recorded_trains(page, folder, steering):
    choose(page, "jacobian")
    press(page, "Next goal")
    press(page, "Record")
    for way in ((0.9, 0.3), (-0.3, 0.9)):
        with held(page, *way):
            kept = int(page.locator("[data-recorded]").inner_text())
            until(lambda kept=kept: int(page.locator("[data-recorded]").inner_text()) > kept + 15)
        press(page, "Next goal")
    press(page, "Stop")
    press(page, "Save")
    page.get_by_text("saved in").wait_for()
    demos = nht.load_demos(folder / "by-hand", env="wam_wipe")
    assert demos.manifest["expert"] == "person"
    assert demos.manifest["episodes"] == 2
    trained = nht.train_map(demos, nht.SVD(7, 2), context_keys=[])
    assert trained.metrics["training_error"] < 0.2


def test_ctrl_c_ends_everything_even_in_mid_recording(page, folder, steering):
    press(page, "Record")
    with held(page, 0.9, 0.0):
        kept = int(page.locator("[data-recorded]").inner_text())
        until(lambda: int(page.locator("[data-recorded]").inner_text()) > kept + 5)
        assert steering.interrupt() == 0
    assert "Traceback" not in "".join(steering.said)
    assert f"saved in {folder / 'by-hand-2'}" in "".join(steering.said)
    assert len(nht.load_demos(folder / "by-hand-2")) > 5
