"""Checks the memory that learners need before they begin."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from nht.recipes.run.demonstrations import transitions_asked
from nht.recipes.run.environments import base_env
from nht.recipes.sections import Training

MEMINFO = Path("/proc/meminfo")
FLAGS_AND_STEPS = 2 + 8
"""Bytes of a stored step beside its numbers in single precision: two flags, and how many rewards it adds up."""
SHARE = 0.9
"""Share of the free memory that buffers may take: the rest is for networks, environments and other programs."""


def check_memory(configs: Sequence[Training]) -> None:
    """Check that the replay buffers of all learners fit.

    Raises:
        MemoryError: if not; says what one needs and how many would fit.
    """
    needed, free = replay_bytes(configs[0]), free_bytes(configs[0].device)
    if free is None or needed * len(configs) <= SHARE * free:
        return
    raise MemoryError(
        f"{len(configs)} learners need {_told(needed * len(configs))}, {_told(needed)} each for its replay buffer, and "
        f"{_told(free)} are free: {int(SHARE * free // needed)} learners would fit, or lower algo.buffer_size."
    )


def replay_bytes(config: Training) -> int:
    """Size of one learner's full replay buffer, demonstrations included [bytes]; 0 for an algorithm without one."""
    steps = min(getattr(config.algo, "buffer_size", 0), config.algo.total_frames)
    if not steps:
        return 0
    steps += transitions_asked(config)
    env = base_env(config.env, seed=0, num_envs=1)
    numbers = 2 * env.observation_spec["observation"].shape[-1] + env.action_spec.shape[-1] + 1
    env.close()
    return steps * (4 * numbers + FLAGS_AND_STEPS)


def free_bytes(device: str) -> int | None:
    """Free memory on the device [bytes]; None where the system does not say."""
    if device.startswith("cuda"):
        return int(torch.cuda.mem_get_info(torch.device(device))[0]) if torch.cuda.is_available() else None
    try:
        lines = MEMINFO.read_text().splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")), None)


def _told(size: int) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e8 else f"{size / 1e6:.1f} MB"
