"""Every task as a native vector environment: against Gymnasium's own SyncVectorEnv, and against TorchRL's side."""

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector as wrappers
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

from nht.envs import TASKS, GymnasiumEnv, GymnasiumVectorEnv, gymnasium_id, make_env

COPIES = 3
WIPE = "nht/WAMWipe-v0"


@pytest.fixture(params=sorted(TASKS))
def name(request):
    return request.param


def wipe(**options):
    return gymnasium.make_vec(WIPE, num_envs=COPIES, **options)


def play(env, count, seed=0):
    """What every step of random actions returns."""
    env.action_space.seed(seed)
    return [env.step(env.action_space.sample()) for _ in range(count)]


@pytest.mark.filterwarnings("error")
def test_make_vec(name):
    env = gymnasium.make_vec(gymnasium_id(name), num_envs=COPIES)
    assert type(env) is GymnasiumVectorEnv
    single = gymnasium.make(gymnasium_id(name))
    assert env.single_observation_space == single.observation_space
    assert env.single_action_space == single.action_space
    assert env.metadata == single.metadata | {"autoreset_mode": AutoresetMode.NEXT_STEP}
    assert env.spec.id == single.spec.id
    observations, infos = env.reset(seed=0)
    for observation, *outcome, info in [(observations, infos), *play(env, 3)]:
        assert observation in env.observation_space
        assert [(entry.shape, entry.dtype) for entry in outcome] in (
            [],
            [((COPIES,), np.float64), ((COPIES,), bool), ((COPIES,), bool)],
        )
        assert {key.removeprefix("_") for key in info} == set(single.reset()[1])
        assert all(len(value) == COPIES for value in info.values())
    env.close()


def test_many_copies_on_two_threads():
    options = {"num_envs": 64, "vectorization_mode": "vector_entry_point", "start": "random"}
    one, two = (gymnasium.make_vec(WIPE, num_threads=threads, **options) for threads in (1, 2))
    assert two.unwrapped.task.num_threads == 2
    for env in (one, two):
        env.reset(seed=0)
    for ours, theirs in zip(play(one, 5), play(two, 5), strict=True):
        for left, right in zip(ours[:4], theirs[:4], strict=True):
            np.testing.assert_array_equal(left, right)


# Agreement with SyncVectorEnv.


def follower(name, limit, task, row):
    """A single environment that starts its episodes where the copy ``row`` of a task stands."""
    env = GymnasiumEnv(name, max_episode_steps=limit)

    def reset(rows=None):
        saved = task.state_dict()
        alone = {key: value[row : row + 1] for key, value in saved.items() if key != "rng"}
        env.task.load_state_dict(alone | {"rng": saved["rng"]})

    env.task.reset = reset
    return env


def assert_same_infos(ours, theirs):
    assert ours.keys() == theirs.keys()
    for key in [key for key in theirs if not key.startswith("_")]:
        mask = theirs[f"_{key}"]
        np.testing.assert_array_equal(ours[f"_{key}"], mask, err_msg=key)
        if isinstance(theirs[key], dict):
            assert_same_infos(ours[key], theirs[key])
            continue
        for left, right in zip(ours[key][mask], theirs[key][mask], strict=True):
            np.testing.assert_array_equal(left, right, err_msg=key)
            assert left.dtype == right.dtype


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("name", ["hopper", "wam_wipe", "ant"])
def test_equals_gymnasiums_sync_vector_env(name, mode):
    limit = 12
    ours = gymnasium.make_vec(
        gymnasium_id(name), COPIES, max_episode_steps=limit, autoreset_mode=mode.value
    ).unwrapped
    singles = [partial(follower, name, limit, ours.task, row) for row in range(COPIES)]
    theirs = SyncVectorEnv(singles, autoreset_mode=mode)
    ours.reset(seed=0)
    ours.task.steps[:] = [0, 3, 3]  # ends at the same time, and at different ones
    theirs.reset()
    ours.action_space.seed(0)
    ends = np.zeros(COPIES, dtype=int)
    for _ in range(40):
        actions = ours.action_space.sample()
        *mine, infos = ours.step(actions)
        *their, their_infos = theirs.step(actions)
        for left, right in zip(mine, their, strict=True):
            np.testing.assert_array_equal(left, right)
            assert left.dtype == right.dtype
        assert_same_infos(infos, their_infos)
        over = mine[2] | mine[3]
        ends += over
        if mode is AutoresetMode.DISABLED and over.any():
            observations, infos = ours.reset(options={"reset_mask": over})
            their_observations, their_infos = theirs.reset(options={"reset_mask": over})
            np.testing.assert_array_equal(observations, their_observations)
            assert_same_infos(infos, their_infos)
    assert (ends >= 2).all()


# Agreement with TorchRL's side.


def test_equals_the_batched_environment(name):
    limits = {"max_episode_steps": 20, "seed": 7}
    batched = make_env(name, num_envs=COPIES, **limits)
    vector = gymnasium.make_vec(
        gymnasium_id(name), num_envs=COPIES, autoreset_mode=AutoresetMode.SAME_STEP, **limits
    )
    tensordict = batched.reset()
    observations, infos = vector.reset()
    vector.action_space.seed(0)
    ends = 0
    for _ in range(50):
        assert_same_state(observations, infos, tensordict)
        actions = vector.action_space.sample()
        frame, tensordict = batched.step_and_maybe_reset(tensordict.set("action", torch.tensor(actions)))
        observations, rewards, terminations, truncations, infos = vector.step(actions)
        after = frame["next"]
        np.testing.assert_array_equal(rewards.astype(np.float32), after["reward"][:, 0])
        np.testing.assert_array_equal(terminations, after["terminated"][:, 0])
        np.testing.assert_array_equal(truncations, after["truncated"][:, 0])
        if (over := terminations | truncations).any():
            ends += 1
            last = np.stack(infos["final_obs"][over])
            final = {key: value[over] for key, value in infos.pop("final_info").items()}
            assert_same_state(last, final, after[torch.tensor(over)])
            assert infos.pop("final_obs")[~over].tolist() == [None] * (COPIES - over.sum())
    assert ends >= 2


def assert_same_state(observations, infos, tensordict):
    values = {key: value for key, value in infos.items() if not key.startswith(("_", "final"))}
    for key, value in (values | {"observation": observations}).items():
        np.testing.assert_array_equal(value.reshape(len(value), -1), tensordict[key].numpy(), err_msg=key)


# Resets.


def test_a_seed_repeats_and_no_seed_does_not():
    env = wipe(start="random")
    first, again, other = (env.reset(seed=seed)[0] for seed in (1, np.int64(1), 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(env.reset()[0], other)
    assert len(np.unique(first, axis=0)) == COPIES
    unseeded = [wipe(start="random").reset()[0] for _ in range(2)]
    assert not np.array_equal(*unseeded)


@pytest.mark.parametrize("sequence", [list, tuple, np.array])
def test_a_seed_for_each_copy(sequence):
    """Each starts as a single environment does, and the episodes after that are repeatable."""
    env, seeds = wipe(start="random", max_episode_steps=2), [5, 3, 5]
    first = env.reset(seed=sequence(seeds))[0]
    singles = [gymnasium.make(WIPE, start="random").reset(seed=seed)[0] for seed in seeds]
    np.testing.assert_array_equal(first, singles)
    later = play(env, 6)
    again = env.reset(seed=seeds)[0]
    np.testing.assert_array_equal(first, again)
    for left, right in zip(later, play(env, 6), strict=True):
        np.testing.assert_array_equal(left[0], right[0])
    env.reset(seed=[5, 3, 6])
    assert not np.array_equal(play(env, 3)[-1][0][:2], later[2][0][:2]), "all seeds make the later episodes"


def test_a_copy_without_a_seed_starts_anywhere():
    env = wipe(start="random")
    starts = [env.reset(seed=[1, None, 1])[0] for _ in range(2)]
    np.testing.assert_array_equal((starts[0] == starts[1]).all(axis=1), [True, False, True])
    mask = np.array([False, False, True])
    masked = env.reset(seed=[1, 2, 3], options={"reset_mask": mask})[0]
    np.testing.assert_array_equal(masked[:2], starts[1][:2])


@pytest.mark.parametrize("mode", ["SAME_STEP", "same_step", "SameStep", "same-step", AutoresetMode.SAME_STEP])
def test_a_mode_may_be_written_as_it_is_written_elsewhere(mode):
    assert wipe(autoreset_mode=mode).metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_torchrl_wraps_it(mode):
    """The modes that ``GymWrapper`` takes."""
    limits = {"max_episode_steps": 4, "seed": 7}
    env = GymWrapper(gymnasium.make_vec(WIPE, num_envs=COPIES, autoreset_mode=mode, **limits))
    check_env_specs(env)
    env.set_seed(1)
    batched = make_env("wam_wipe", num_envs=COPIES, max_episode_steps=4, seed=1)
    batched.task.rng = env.unwrapped.task.rng
    torch.manual_seed(0)
    mine = env.rollout(10, break_when_any_done=False)
    assert mine["next", "done"][..., 0].any(0).tolist() == [False, False, False, True] * 2 + [False] * 2
    assert (mine["next", "observation"][:, 3] != mine["observation"][:, 4]).any(), "its own last observation"


def test_copies_that_wait_are_not_stepped_along():
    env = wipe(max_episode_steps=2)
    env.reset(seed=0)
    env.unwrapped.task.steps[1] = 1
    play(env, 1)
    ended = env.unwrapped.task.state[1].copy()
    stepped = []
    real = env.unwrapped.task.step
    env.unwrapped.task.step = lambda actions, rows=None: stepped.append(rows) or real(actions, rows)
    play(env, 1)
    assert stepped[0].tolist() == [0, 2]
    assert (env.unwrapped.task.state[1] != ended).any(), "it was reset"


@pytest.mark.parametrize("mode", AutoresetMode)
def test_a_masked_reset_touches_its_rows_only(mode):
    env = wipe(start="random", autoreset_mode=mode)
    env.reset(seed=0)
    before = play(env, 4)[-1][0]
    mask = np.array([False, True, False])
    options = {"reset_mask": mask}
    observations, infos = env.reset(options=options)
    assert set(options) == {"reset_mask"}
    np.testing.assert_array_equal((observations != before).any(axis=1), mask)
    np.testing.assert_array_equal(infos["_success"], mask)
    np.testing.assert_array_equal(env.unwrapped.task.steps, [4, 0, 4])


def test_a_first_reset_of_some_leaves_the_others_waiting():
    mask = np.array([False, True, False])
    env = wipe()
    env.reset(options={"reset_mask": mask})
    env.step(env.action_space.sample())
    np.testing.assert_array_equal(env.unwrapped.task.steps, [0, 1, 0])
    manual = wipe(autoreset_mode=AutoresetMode.DISABLED)
    manual.reset(options={"reset_mask": mask})
    with pytest.raises(ResetNeeded, match=r"\[0, 2\]"):
        manual.step(manual.action_space.sample())


def test_ended_copies_wait_for_a_manual_reset():
    env = wipe(max_episode_steps=2, autoreset_mode="Disabled")
    env.reset(seed=0)
    play(env, 2)
    with pytest.raises(ResetNeeded, match=r"copies \[0, 1, 2\] have ended.*reset_mask"):
        env.step(env.action_space.sample())
    env.reset()
    env.step(env.action_space.sample())


def test_an_action_that_is_not_finite_ends_its_copy_only():
    env = wipe()
    env.reset(seed=0)
    actions = np.zeros(env.action_space.shape, dtype=np.float32)
    actions[1, 2] = np.nan
    _, _, terminations, _, infos = env.step(actions)
    for flags in (terminations, infos["diverged"], infos["failure"]):
        np.testing.assert_array_equal(flags, [False, True, False])
    _, rewards, terminations, _, infos = env.step(actions)  # ignored where it resets
    assert rewards[1] == 0
    assert not terminations.any()
    assert not infos["diverged"].any()


def test_what_is_returned_belongs_to_the_caller():
    env = wipe(max_episode_steps=3, autoreset_mode=AutoresetMode.SAME_STEP)
    reference = wipe(max_episode_steps=3, autoreset_mode=AutoresetMode.SAME_STEP)
    for copy in (env, reference):
        copy.reset(seed=0)
        copy.action_space.seed(0)
    for _ in range(8):
        *outcome, infos = env.step(env.action_space.sample())
        *expected, _ = reference.step(reference.action_space.sample())
        for left, right in zip(outcome, expected, strict=True):
            np.testing.assert_array_equal(left, right)
        for array in [*outcome, *infos.values()]:
            if isinstance(array, np.ndarray) and array.dtype != object:
                array[:] = ~array if array.dtype == bool else 1e3


# Gymnasium's wrappers.


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_episode_statistics(mode):
    length = 5
    env = wrappers.RecordEpisodeStatistics(wipe(max_episode_steps=length, autoreset_mode=mode))
    env.reset(seed=0)
    rounds = 3
    ends = [infos for *_, infos in play(env, rounds * (length + 1)) if "episode" in infos]
    assert len(ends) >= rounds
    for infos in ends:
        np.testing.assert_array_equal(infos["episode"]["l"], length)
        np.testing.assert_array_equal(infos["episode"]["r"], -length)


def test_statistics_of_a_masked_reset():
    env = wrappers.RecordEpisodeStatistics(wipe(max_episode_steps=5, autoreset_mode=AutoresetMode.DISABLED))
    env.reset(seed=0)
    play(env, 3)
    env.reset(options={"reset_mask": np.array([True, False, False])})
    infos = play(env, 2)[-1][-1]
    np.testing.assert_array_equal(infos["episode"]["l"], [0, 5, 5])


def test_other_wrappers():
    env = wrappers.RescaleAction(wipe(max_episode_steps=4), np.float32(-1), np.float32(1))
    env = wrappers.DictInfoToList(wrappers.ClipReward(wrappers.NormalizeObservation(env), -0.5, 0.5))
    env.reset(seed=0)
    for observations, rewards, _, _, infos in play(env, 10):
        assert observations.shape == env.observation_space.shape
        assert set(rewards) <= {-0.5, 0.0}
        assert [set(info) for info in infos] == [
            {"success", "failure", "diverged", "joint_angle", "tool_position", "goal"}
        ] * COPIES


# Pictures, the end, and bad input.


@pytest.mark.usefixtures("can_render")
def test_a_picture_of_every_copy():
    env = wipe(render_mode="rgb_array")
    env.reset(seed=0)
    pictures = env.render()
    assert [picture.shape for picture in pictures] == [(480, 640, 3)] * COPIES
    assert not np.array_equal(pictures[0], pictures[1]), "their goals differ"
    env.close()
    env.close()


def test_closing_twice():
    env = wipe()
    env.reset()
    assert env.render() is None
    env.close()
    env.close()
    assert env.closed
    with pytest.raises(RuntimeError, match="closed"):
        env.step(env.action_space.sample())


@pytest.mark.parametrize(
    ("error", "message", "options"),
    [
        (
            ValueError,
            r"render_mode must be None or one of \['rgb_array'\], got 'ansi'",
            {"render_mode": "ansi"},
        ),
        (
            ValueError,
            r"one of \['NextStep', 'SameStep', 'Disabled'\], or its name, got 'never'",
            {"autoreset_mode": "never"},
        ),
        (TypeError, "unexpected keyword argument 'nonesuch': its options are", {"nonesuch": 1}),
        (ValueError, "max_episode_steps must be at least 1, got 0", {"max_episode_steps": 0}),
    ],
)
def test_wrong_options(error, message, options):
    with pytest.raises(error, match=message):
        wipe(**options)


@pytest.mark.parametrize(
    ("error", "message", "arguments"),
    [
        (TypeError, r"seed must be an int, or 3 of them, got 'one'", {"seed": "one"}),
        (TypeError, r"seed must be an int, or 3 of them, got \[1, 2.5, 3\]", {"seed": [1, 2.5, 3]}),
        (ValueError, r"one for each of the 3 copies, got 2", {"seed": [1, 2]}),
        (TypeError, "array of bool, got list", {"options": {"reset_mask": [True, False, True]}}),
        (TypeError, "array of bool, got int64", {"options": {"reset_mask": np.array([1, 0, 1])}}),
        (ValueError, r"shape \(3,\)", {"options": {"reset_mask": np.array([True])}}),
        (ValueError, "name a copy", {"options": {"reset_mask": np.zeros(3, dtype=bool)}}),
    ],
)
def test_wrong_resets(error, message, arguments):
    env = wipe()
    env.reset(seed=0)
    before = env.unwrapped.task.state.copy()
    with pytest.raises(error, match=message):
        env.reset(**arguments)
    np.testing.assert_array_equal(env.unwrapped.task.state, before)


def test_wrong_steps():
    env = wipe()
    with pytest.raises(ResetNeeded, match="call reset before the first step"):
        env.step(env.action_space.sample())
    env.reset()
    with pytest.raises(ValueError, match=r"expected actuation of shape \(3, 7\), got \(7,\)"):
        env.step(env.single_action_space.sample())
