"""The page without a browser: what is sent to whom, and that it follows the session."""

import json
import urllib.request

import numpy as np
import pytest
from websockets.sync.client import connect

from nht.recipes.live.basis import AXIS_COLOURS, bars_html, linear_rgb, present_basis, rgb
from nht.recipes.live.opening import open_page
from nht.recipes.live.page import motor_names
from steered import config, map_file, moves


@pytest.fixture
def opened(tmp_path):
    words = [f"map.file={map_file(tmp_path)}", "port=0", "seed=1", f"out={tmp_path / 'by-hand'}"]
    with open_page(config(*words)) as found:
        yield found


def frames(session, page, count):
    for _ in range(count):
        session.settle()
        session.step()
        page.show()


def test_the_page_is_served_at_its_address(opened):
    _, page = opened
    with urllib.request.urlopen(page.address) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read()[:2000]


def test_a_pad_is_told_the_axes_and_what_it_says_moves_the_robot(opened):
    session, page = opened
    with connect(f"{page.address.replace('http', 'ws')}/pad") as pad:
        told = json.loads(pad.recv(timeout=10))
        assert told["axes"] == 2
        assert tuple(told["colours"]) == AXIS_COLOURS
        before = session.observed["joint_angle"].clone()
        pad.send(json.dumps({"action": [0.5, -0.5], "stamp": 7}))
        for _ in range(500):
            frames(session, page, 1)
            if session.commands.latest().any():
                break
        frames(session, page, 2)
        assert not session.observed["joint_angle"].equal(before)
        heard = [json.loads(pad.recv(timeout=10)) for _ in range(2)]
        assert {"reached": 7} in heard
        assert {"action": [0.5, -0.5]} in heard
        session.choose("jacobian")
        frames(session, page, 1)
        assert json.loads(pad.recv(timeout=10))["axes"] == 6


@pytest.mark.parametrize(
    "said",
    [
        {"action": "left"},
        {"action": [None, 1]},
        {"action": [1, 2, 3]},
        {"stamp": "now", "action": [0.0, 0.0]},
    ],
)
def test_pads_that_make_no_sense_harm_nothing(opened, said):
    session, page = opened
    page._heard("pad", said)
    frames(session, page, 1)
    assert session.commands.latest().tolist() == [[0.0, 0.0]]


def test_pictures_follow_episodes_recording_and_other_interfaces(opened, tmp_path):
    session, page = opened
    session.post(lambda now: now.record(True))
    session.commands.ask([0.5, 0.5])
    frames(session, page, 12)
    session.post(lambda now: now.choose("joints"))
    session.post(lambda now: now.next_goal())
    frames(session, page, 12)
    session.post(lambda now: now.save())
    frames(session, page, 1)
    assert (tmp_path / "by-hand").exists()


def test_a_robot_that_runs_away_stays_in_sight(tmp_path):
    """It stands where it stood, and the floor's grid passes beneath it; unfollowed, it leaves."""
    with open_page(config("env=half_cheetah", "port=0", f"out={tmp_path / 'by-hand'}")) as (session, page):
        stage, mirror = page._stage, page._mirror
        page.show()
        root, grid = mirror.root, np.array(stage._grid.node.position) + mirror.walked()

        def shown():
            return (np.array(stage._world.node.position) + mirror.data.subtree_com[root])[:2]

        start = shown()
        session.commands.ask([1.0, 1.0, 1.0, -1.0, -1.0, -1.0], "a")
        for _ in range(40):
            session.step()
            page.show()
        gone = mirror.walked()
        assert np.abs(gone).max() > 0.05
        assert np.allclose(shown(), start, atol=1e-4)
        assert np.allclose(grid - stage._grid.node.position, np.fmod(gone, 1.0), atol=1e-4)
        page._controls.follow.value = False
        page.show()
        assert np.allclose(shown() - start, gone[:2], atol=1e-4)
        assert np.allclose(stage._grid.node.position, grid, atol=1e-4)


def test_an_arm_has_no_grid_and_nothing_to_follow(opened):
    _, page = opened
    page.show()
    assert page._stage._grid is None
    assert not page._controls.follow.visible
    assert not np.any(page._stage._world.node.position)


def test_the_bars_show_every_motor_and_tell_the_axes(opened):
    session, page = opened
    moves(session, [0.3, 0.0], 1)
    page.show()
    basis = present_basis(session, page._tool)
    text = bars_html(
        basis,
        [f"<{i}>" for i in range(7)],
        session.actuation[0].double().numpy(),
        session.task.actuation_bounds,
    )
    assert text.count("<rect") == 7 * 3
    assert "&lt;6&gt;" in text
    assert "axis 2" in text
    assert "angle to the Jacobian" in text


def test_colours_are_read_and_darkened():
    assert rgb("#D55E00") == (213, 94, 0)
    assert all(dark <= light for dark, light in zip(linear_rgb("#D55E00"), rgb("#D55E00"), strict=True))


def test_motors_have_the_names_of_actuators_or_joints_or_numbers(opened):
    model = opened[0].task.model
    assert motor_names(model, 7)[:2] == ["base_yaw", "shoulder_pitch"]
    assert motor_names(model, 3) == ["motor 1", "motor 2", "motor 3"]
