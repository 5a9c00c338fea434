"""The state of what is steered, without any viewer: it moves as training would, and nobody can do harm."""

import pytest
import torch
from torchrl.envs import TransformedEnv

import nht
from nht.envs import make_env
from nht.recipes.live.commands import Commands
from nht.recipes.live.interfaces import kind_name
from nht.recipes.live.pace import keep_pace
from nht.recipes.live.session import FAILED, OVER, PERSON, POLICY, RUNNING, SUCCESS
from nht.transforms import ActionMapTransform
from steered import map_file, moves, random_map, session
from tiny_runs import start


@pytest.fixture
def two(tmp_path):
    files = [map_file(tmp_path), map_file(tmp_path, "svd", kind=nht.SVD)]
    opened = session(f"map.file={files[0]}", f"maps=[{files[1]}]", "seed=3")
    yield opened
    opened.close()


@pytest.mark.parametrize("saturation", ["scale", "clip"])
@pytest.mark.parametrize("made", [{}, {"offset": "constant"}, {"kind": nht.LASER}, {"kind": nht.SCL}])
def test_it_moves_bit_for_bit_as_training_would(tmp_path, made, saturation):
    map = random_map(**made)
    map.saturation = saturation
    map.set_action_scale(4.0)  # beyond the motors' limits
    nht.save_map(map, tmp_path / "map.safetensors")
    steered = session(f"map.file={tmp_path / 'map.safetensors'}", "seed=5")
    env = TransformedEnv(make_env("wam_wipe", 1, seed=5), ActionMapTransform(map))
    current = env.reset()
    generator = torch.Generator().manual_seed(1)
    for _ in range(20):
        action = 2 * torch.rand(1, 2, generator=generator) - 1
        current = env.step(current.set("action", action))["next"]
        moves(steered, action[0].tolist(), 1)
        for key in ("joint_angle", "tool_position", "goal"):
            assert torch.equal(steered.observed[key], current[key])
        assert torch.equal(steered.actuation, current["actuation"])
    steered.close()


def test_all_interfaces_are_there_and_named_after_their_kinds(two):
    assert list(two.interfaces) == ["nht", "svd", "jacobian", "joints"]
    assert [each.action_dim for each in two.interfaces.values()] == [2, 2, 6, 7]


def test_files_of_one_kind_get_numbers(tmp_path):
    files = [map_file(tmp_path, name, seed=seed) for seed, name in enumerate(("a", "b"))]
    opened = session(f"map.file={files[0]}", f"maps=[{files[1]}]")
    assert list(opened.interfaces)[:2] == ["nht", "nht 2"]
    opened.close()


def test_wrapped_maps_have_the_name_of_what_they_wrap():
    inner = random_map()
    assert kind_name(nht.Residual(nht.Aligned(inner), 0.1)) == "nht"


def test_another_interface_moves_the_same_arm_on(two):
    moves(two, [1.0, 0.5], 5)
    before = two.observed["joint_angle"].clone()
    two.choose("joints")
    assert torch.equal(two.observed["joint_angle"], before)
    assert not two.commands.latest().any()
    moves(two, [1.0, 0, 0, 0, 0, 0, 0], 1)
    change = two.observed["joint_angle"] - before
    assert change[0, 0] > 0.01
    assert change[0, 1:].abs().max() < 1e-3
    with pytest.raises(KeyError, match="no interface 'pca': choose from"):
        two.choose("pca")


def test_effects_of_the_axes_are_what_an_action_does(two):
    for interface in two.interfaces.values():
        effects = interface.axis_effects(two.observed)
        still = interface.decode(torch.zeros(1, interface.action_dim), two.observed)
        for axis, action in enumerate(torch.eye(interface.action_dim)):
            moved = interface.decode(action[None], two.observed) - still
            assert torch.allclose(effects[:, axis], moved[0], atol=1e-6)


def test_a_reset_is_the_same_start_and_goal_and_the_next_goal_another(two):
    start = two.observed.clone()
    moves(two, [0.3, 0.3], 10)
    two.reset()
    assert two.steps == 0
    assert all(torch.equal(two.observed[key], start[key]) for key in ("joint_angle", "goal"))
    moves(two, [0.3, 0.3], 3)
    first = two.observed["joint_angle"].clone()
    two.reset()
    moves(two, [0.3, 0.3], 3)
    assert torch.equal(two.observed["joint_angle"], first)
    two.next_goal()
    assert not torch.equal(two.observed["goal"], start["goal"])
    assert torch.equal(two.observed["joint_angle"], start["joint_angle"])


def test_an_end_stands_still_until_the_next_episode(tmp_path):
    opened = session(f"map.file={map_file(tmp_path)}", "max_episode_steps=4")
    moves(opened, [0.1, 0.0], 9)
    assert (opened.steps, opened.ended, opened.outcome) == (4, True, OVER)
    opened.next_goal()
    assert (opened.steps, opened.outcome, opened.episode) == (0, RUNNING, 2)
    opened.close()


def test_a_failure_lasts_and_ends_nothing(two):
    two.choose("joints")
    moves(two, [0.0, 1.0, 0, 0, 0, 0, 0], 20)
    assert (two.outcome, two.ended) == (FAILED, False)
    assert not two.at_rest


def test_success_is_told(two):
    two.succeeded = True
    assert two.outcome == SUCCESS
    assert two.at_rest


def test_what_is_posted_happens_before_the_next_step_and_mistakes_become_the_message(two):
    two.post(lambda now: now.choose("svd"))
    two.post(lambda now: now.choose("pca"))
    two.post(lambda now: now.save())
    assert two.interface.name == "nht"
    two.settle()
    assert two.interface.name == "svd"
    assert two.message == "nothing is recorded: press record, and move."


def test_without_a_run_no_policy_drives(two):
    with pytest.raises(ValueError, match="no policy: start with run=FOLDER"):
        two.drive(POLICY)
    with pytest.raises(ValueError, match="driver must be person or policy"):
        two.drive("nobody")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "ddpg"
    start("ddpg", folder, "algo.total_frames=400", "evaluation.every=400")
    return folder


def test_a_policy_drives_until_a_hand_is_on_the_pad(run, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    opened = session(f"run={run}")
    assert opened.driver == POLICY
    opened.step()
    assert opened.driving == POLICY
    assert torch.equal(opened.action, opened.pilot.action(opened._start[0]))
    moves(opened, [0.5] * 7, 1)
    assert (opened.driving, opened.action[0, 0]) == (PERSON, 0.5)
    moves(opened, [0.0] * 7, 1)
    assert opened.driving == PERSON  # a hand that rests at zero still holds it
    clock[0] += 1.0
    opened.step()
    assert opened.driving == POLICY
    opened.close()


@pytest.mark.parametrize("algorithm", ["ddpg", "td3", "sac", "ppo"])
def test_the_critic_is_that_of_the_run(algorithm, tmp_path):
    folder = tmp_path / algorithm
    start(algorithm, folder, "algo.total_frames=400", "evaluation.every=400")
    opened = session(f"run={folder}")
    opened.step()
    assert opened.pilot.no_critic == ""
    value = opened.value()
    assert isinstance(value, float)
    assert opened.pilot.critic.judges_actions == (algorithm != "ppo")
    opened.choose("jacobian")
    moves(opened, [1.0, 0, 0, 0, 0, 0], 1)
    assert (opened.value() != value) or algorithm == "ppo"
    opened.close()


def test_a_run_without_checkpoints_drives_without_a_critic(run, tmp_path):
    import shutil

    copy = tmp_path / "bare"
    shutil.copytree(run, copy, ignore=shutil.ignore_patterns("checkpoints"))
    opened = session(f"run={copy}")
    opened.step()
    assert opened.value() is None
    assert opened.pilot.no_critic.endswith("keeps no checkpoint.")
    opened.close()


def test_the_last_who_moved_is_heard_and_who_leaves_lets_go():
    commands = Commands(2)
    commands.ask([0.5, 0.0], "a")
    commands.ask([0.0, 3.0], "b")
    assert commands.latest().tolist() == [[0.0, 1.0]]
    commands.drop("a")
    assert commands.latest().any()
    commands.drop("b")
    assert not commands.latest().any()


@pytest.mark.parametrize("asked", [[1.0], [1.0, 2.0, 3.0], [float("nan"), 0.0], [float("inf"), 0.0], []])
def test_what_makes_no_sense_is_left_out(asked):
    commands = Commands(2)
    commands.ask([0.5, 0.5])
    commands.ask(asked)
    assert commands.latest().tolist() == [[0.5, 0.5]]


def test_who_asked_hears_once_when_the_motors_get_it(two):
    heard = []
    two.commands.on_reached = lambda source, stamp: heard.append((source, stamp))
    two.commands.ask([0.1, 0.0], "pad", 12.5)
    two.step()
    two.step()
    assert heard == [("pad", 12.5)]


def test_a_pause_holds_time(two):
    two.paused = True
    moves(two, [1.0, 0.0], 3)
    assert two.steps == 0


class Clock:
    """Time that passes only while somebody sleeps."""

    def __init__(self):
        self.now = 50.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.mark.parametrize(("speed", "expected"), [(1.0, 50), (0.5, 25), (2.0, 100)])
def test_time_passes_at_the_speed_that_was_asked_for(two, monkeypatch, speed, expected):
    clock = Clock()
    monkeypatch.setattr("nht.recipes.live.pace.time", clock)
    two.speed, two.goes_on, shown = speed, False, []
    keep_pace(two, lambda _: shown.append(two.steps), lambda: clock.now < 51.0)
    assert abs(two.steps - expected) <= 1
    assert 45 <= len(shown) <= 51


def test_the_next_episode_begins_by_itself_if_wanted(tmp_path, monkeypatch):
    clock = Clock()
    monkeypatch.setattr("nht.recipes.live.pace.time", clock)
    opened = session(f"map.file={map_file(tmp_path)}", "max_episode_steps=10")
    keep_pace(opened, lambda _: None, lambda: clock.now < 52.0)
    assert opened.episode == 2
    opened.goes_on = False
    keep_pace(opened, lambda _: None, lambda: clock.now < 60.0)
    assert opened.episode == 2
    opened.close()


def test_slow_steps_are_shown_on_their_way(two, monkeypatch):
    clock = Clock()
    monkeypatch.setattr("nht.recipes.live.pace.time", clock)
    shown = {0.2: [], 1.0: []}
    for speed, parts in shown.items():
        two.speed = speed
        keep_pace(two, parts.append, lambda end=clock.now + 1.0: clock.now < end)
    assert set(shown[1.0][1:]) == {1.0}
    assert max(shown[0.2]) <= 1.0
    assert len({round(part, 1) for part in shown[0.2]}) >= 4
