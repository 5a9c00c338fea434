"""Every test draws the same numbers each time, on one thread, and sends nothing anywhere."""

import os

# Read once, when torch and wandb are imported.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["WANDB_MODE"] = "offline"
os.environ["WANDB_SILENT"] = "true"

import pytest
import torch
from hypothesis import settings

from fresh_process import DRAW, run

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def can_render():
    if all(run(DRAW, MUJOCO_GL=platform).returncode for platform in ("egl", "osmesa")):
        pytest.skip("neither EGL nor OSMesa is installed")
