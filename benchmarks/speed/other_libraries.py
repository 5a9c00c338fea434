"""What one learner costs with other libraries, in the settings of ``population.py``: core-seconds per 1,000,000 steps.

Each is measured as its users run it, with one thread, without test episodes, after a first run that compiles and fills:

- ``stable-baselines3`` and ``sbx`` (JAX), by how long a second call of ``learn`` takes;
- ``cleanrl``, by two lengths of the script as it is published, with layers and number of updates set to ours. It needs
  Gymnasium 0.29, in which WAMWipe does not run: its task is HalfCheetah-v4, whose physics costs as much.

They need environments of their own: ``pip install sbx-rl gymnasium[mujoco]`` and this package without its dependencies;
``pip install gymnasium==0.29.1 mujoco==2.3.7 tyro tensorboard torch`` for CleanRL, and a checkout of it.

    python benchmarks/speed/other_libraries.py {stable-baselines3 | sbx} {search | paper | ppo} [COPIES]
    python benchmarks/speed/other_libraries.py cleanrl {search | paper | ppo} CHECKOUT
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

MEAN_BATCH = 144  # of the paper's Table 2
OFF_POLICY = {  # layers, batch, steps an update, steps measured
    "search": ([128, 128], MEAN_BATCH, 10, 4_000),
    "paper": ([256, 256, 256], 256, 5, 1_000),
}
ON_POLICY_STEPS = 2_048


def with_learn(library: str, setting: str, copies: int) -> float:
    """Core-seconds per step of stable-baselines3, or of SBX, which has its interface."""
    import gymnasium
    import numpy as np
    from stable_baselines3.common.noise import NormalActionNoise
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    module = importlib.import_module("sbx" if library == "sbx" else "stable_baselines3")
    device = {} if library == "sbx" else {"device": "cpu"}
    if setting == "ppo":
        env = VecNormalize(DummyVecEnv([lambda: gymnasium.make("HalfCheetah-v5")] * copies), gamma=0.99)
        steps, layers = ON_POLICY_STEPS, {"net_arch": [64, 64]}
        model = module.PPO(
            "MlpPolicy", env, n_steps=steps // copies, batch_size=64, policy_kwargs=layers, seed=0, **device
        )
    else:
        hidden, batch, per_update, steps = OFF_POLICY[setting]
        env = DummyVecEnv([partial(gymnasium.make, "nht.envs:nht/WAMWipe-v0")] * copies)
        model = module.DDPG(
            "MlpPolicy",
            env,
            learning_starts=0,
            buffer_size=100_000,
            batch_size=batch,
            train_freq=max(1, per_update // copies),
            gradient_steps=max(1, copies // per_update),
            action_noise=NormalActionNoise(np.zeros(7), 0.1 * np.ones(7)),
            policy_kwargs={"net_arch": hidden},
            seed=0,
            **device,
        )
    model.learn(steps, reset_num_timesteps=False)
    began = time.process_time()
    model.learn(steps, reset_num_timesteps=False)
    return (time.process_time() - began) / steps


def with_cleanrl(setting: str, checkout: Path) -> float:
    """Core-seconds per step of CleanRL's script."""
    name = "ppo_continuous_action.py" if setting == "ppo" else "ddpg_continuous_action.py"
    script = (checkout / "cleanrl" / name).read_text()
    words = ["--env-id", "HalfCheetah-v4", "--no-cuda"]
    short = ON_POLICY_STEPS
    if setting != "ppo":
        hidden, batch, per_update, short = OFF_POLICY[setting]
        words += ["--batch-size", str(batch), "--learning-starts", str(batch), "--policy-frequency", "1"]
        script = script.replace("256)", f"{hidden[0]})").replace("nn.Linear(256,", f"nn.Linear({hidden[0]},")
        due = "if global_step > args.learning_starts:"
        assert due in script
        script = script.replace(due, due[:-1] + f" and global_step % {per_update} == 0:")
        if len(hidden) == 3:
            script = script.replace("self.fc2(x)", "self.fc2b(F.relu(self.fc2(x)))").replace(
                "        self.fc2 =",
                f"        self.fc2b = nn.Linear({hidden[0]}, {hidden[0]})\n        self.fc2 =",
            )
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / name
        file.write_text(f"import torch; torch.set_num_threads(1)\n{script}")
        costs = []
        for steps in (short, 3 * short):
            before = children()
            env = os.environ | {"PYTHONPATH": str(checkout)}
            command = [sys.executable, str(file), *words, "--total-timesteps", str(steps)]
            subprocess.run(command, cwd=scratch, env=env, check=True, capture_output=True)
            costs.append(children() - before)
    return (costs[1] - costs[0]) / (2 * short)


def children() -> float:
    """Processor seconds of all processes that were started and ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Print one measurement as JSON."""
    if len(sys.argv) < 3:
        return print(__doc__)
    library, setting, *more = sys.argv[1:]
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    if library == "cleanrl":
        seconds = with_cleanrl(setting, Path(more[0]))
    else:
        seconds = with_learn(library, setting, int(more[0]) if more else 1)
    print(json.dumps({"core_seconds": seconds * 1e6, "evaluations": 0.0, "memory": 0.0}))


if __name__ == "__main__":
    main()
