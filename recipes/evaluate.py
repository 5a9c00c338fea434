"""Test a finished run's policy, and film it.

python -m nht.recipes.evaluate run=runs/ddpg-wam_wipe-nht-seed0 video=true
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from torchrl.envs import TransformedEnv

from nht.recipes.agents.policy import load_policy
from nht.recipes.config import Evaluate
from nht.recipes.launch import launch
from nht.recipes.run.environments import lasting_failures, mapped_env
from nht.recipes.run.evaluation import evaluate
from nht.recipes.run.saved_run import kept_map, read_config
from nht.recipes.run.video import record_video


def main(config: Evaluate) -> None:
    """Test a policy, film it, and print the result."""
    folder = Path(config.run)
    trained = read_config(folder, config.allow)
    env = lasting_failures(trained.env)
    env = replace(env, options=env.options | config.env_options)
    map = kept_map(folder, trained, allow=config.allow)

    def build(copies: int) -> TransformedEnv:
        return mapped_env(env, map, seed=config.seed, num_envs=copies)

    tests = build(config.episodes)
    policy = load_policy(folder, tests, trained)
    outcome = evaluate(tests, policy)
    for name, value in outcome.metrics().items():
        print(f"{name:>12}  {value:.3f}")
    if config.video:
        video = folder / "evaluation.mp4"
        record_video(build(config.video_episodes), policy, video)
        print(f"{video}, {video.with_suffix('.png')}")


if __name__ == "__main__":
    launch(main, Evaluate, "evaluate")
