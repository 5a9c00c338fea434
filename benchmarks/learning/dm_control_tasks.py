"""Runs every task of dm_control's suite through an action map, and reports which work.

    MUJOCO_GL=egl OMP_NUM_THREADS=1 python benchmarks/learning/dm_control_tasks.py

Two copies of each task are built, checked against their specs, and driven for 50 steps by uniform random actions
through an untrained NHT of k = max(1, n // 2) dimensions (raw actuation where there is one motor), whose context is the
whole observation. "saved": after 5 of 10 steps the simulators are saved and loaded; the other 5 steps and the start of
the next episode come out the same, to the bit. MUJOCO_GL=egl is for quadruped-escape alone, which hands its terrain to
OpenGL when an episode starts and fails without a display.
"""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path
from typing import Any

import mujoco
import pandas
import torch
from dm_control import suite
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

import nht
from nht.envs import ForeignEnv, make_dm_control
from nht.transforms import ActionMapTransform

STEPS = 50
RESULTS = Path(__file__).parents[1] / "results" / "dm_control_tasks" / "dm_control_tasks.csv"


def driven(env: ForeignEnv, n: int, width: int) -> TransformedEnv:
    map = nht.NHT(width, n, max(1, n // 2), hidden=(32,)) if n > 1 else nht.Identity(1)
    keys = ["observation"] if map.context_dim else None
    return TransformedEnv(env, ActionMapTransform(map, keys, action_scale=1.0))


def goes_on_exactly(env: TransformedEnv) -> bool:
    start = env.rollout(5, break_when_any_done=False)[:, -1]["next"].exclude("reward")
    saved, actions = env.base_env.task.state_dict(), [env.full_action_spec.rand()["action"] for _ in range(5)]

    def go_on() -> torch.Tensor:
        current, seen = start.clone(), []
        for action in actions:
            frame, current = env.step_and_maybe_reset(current.set("action", action))
            seen.append(frame["next", "observation"].clone())
        return torch.stack([*seen, env.reset()["observation"]])

    first = go_on()
    env.base_env.task.load_state_dict(saved)
    return torch.equal(first, go_on())


def tried(name: str) -> dict[str, Any]:
    row: dict[str, Any] = {"task": name}
    torch.manual_seed(0)
    try:
        with closing(make_dm_control(name, num_envs=2, seed=0)) as env:
            n, width = env.action_spec.shape[-1], env.task.observation_sizes["observation"]
            through = driven(env, n, width)
            check_env_specs(through)
            begun = time.perf_counter()
            data = through.rollout(STEPS, break_when_any_done=False)
            seconds = time.perf_counter() - begun
            assert all(data["next", key].isfinite().all() for key in ("observation", "reward"))
            return row | {
                "motors": n,
                "k": through.action_spec.shape[-1],
                "observation": width,
                "limit": env.task.max_episode_steps,
                "reward": f"{data['next', 'reward'].mean():.3g}",
                "steps_per_second": round(2 * STEPS / seconds),
                "saved": goes_on_exactly(through),
                "result": "runs",
            }
    except (AssertionError, RuntimeError, ValueError, mujoco.FatalError) as error:
        return row | {"result": f"{type(error).__name__}: {str(error).splitlines()[0][:100]}"}


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for domain, task in sorted(suite.ALL_TASKS):
        rows.append(tried(f"{domain}-{task}"))
        print(rows[-1])
    table = pandas.DataFrame(rows).convert_dtypes()
    table.to_csv(RESULTS, index=False)
    print(f"{(table['result'] == 'runs').sum()} of {len(table)} run, {table['saved'].sum()} go on exactly")


if __name__ == "__main__":
    main()
