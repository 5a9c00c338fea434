"""Every test draws the same numbers each time, on one thread, and sends nothing anywhere."""

import os
from importlib.util import find_spec

# Read once, when torch and wandb are imported.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["WANDB_MODE"] = "offline"
os.environ["WANDB_SILENT"] = "true"

import pytest
import torch
from hypothesis import settings

from fresh_process import DRAW, run
from nht.envs.dm_control import MISSING

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(0)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item):
    yield from _skipped_without_dm_control()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    yield from _skipped_without_dm_control()


def _skipped_without_dm_control():
    """What is refused for want of dm_control, which Python 3.13 has only where it was asked for twice."""
    try:
        return (yield)
    except ImportError as error:
        if find_spec("dm_control") is None and "dm_control" in str(error):
            pytest.skip(MISSING)
        raise


@pytest.fixture(scope="session")
def can_render():
    if all(run(DRAW, MUJOCO_GL=platform).returncode for platform in ("egl", "osmesa")):
        pytest.skip("neither EGL nor OSMesa is installed")
