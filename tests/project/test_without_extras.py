"""The package alone: it maps, trains and simulates, imports late, and what needs an extra says which."""

import json
from pathlib import Path

import pytest

import fresh_process

HIDDEN = f"""
import sys
sys.path.insert(0, {str(Path(fresh_process.__file__).parent)!r})
from without_extras import EXTRAS, hide
"""
WORK = """
hide()
import torch, gymnasium, nht, nht.envs, nht.transforms
from torchrl.envs import TransformedEnv

steps = torch.arange(300)
angles = torch.randn(300, 7)
context = {"joint_angle": angles}
demos = nht.Demos.from_tensors(actuation=angles @ torch.randn(7, 7), context=context, episode=steps // 30)
trained = nht.train_map(demos, nht.NHT(7, 7, 2, (8,)), context_keys=["joint_angle"], max_steps=20)
nht.save_map(trained.map, folder + "/map.safetensors")
map = nht.load_map(folder + "/map.safetensors")
env = nht.envs.make_env("wam_wipe", 2, seed=0)
mapped = TransformedEnv(env, nht.transforms.ActionMapTransform(map))
assert mapped.rollout(3)["action"].shape == (2, 3, 2)
single = gymnasium.make("nht/WAMWipe-v0")
wrapped = nht.transforms.ActionMapWrapper(single, map)
wrapped.reset(seed=0)
assert wrapped.step(wrapped.action_space.sample())[0] is not None
assert not EXTRAS & set(sys.modules), EXTRAS & set(sys.modules)

def told(function, *arguments):
    try:
        function(*arguments)
    except ImportError as error:
        return str(error)
    return "no error"

import json
print(json.dumps({
    "minari": told(nht.from_minari, "a/b-v0"),
    "to minari": told(nht.to_minari, demos, "a/b-v0"),
    "hdf5": told(nht.from_hdf5, folder + "/none.h5"),
    "onnx": told(nht.export_map, map, folder + "/map.onnx"),
    "dm_control": told(nht.envs.make_dm_control, "cheetah-run"),
    "hand": told(nht.envs.make_gymnasium, "AdroitHandDoor-v1"),
    "gymnasium": told(nht.envs.make_gymnasium, "HalfCheetah-v5"),
    "recipes": told(__import__, "nht.recipes.launch"),
}))
"""


def output(code):
    done = fresh_process.run(code)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    return json.loads(output(f"{HIDDEN}folder = {str(tmp_path_factory.mktemp('files'))!r}\n{WORK}"))


@pytest.mark.parametrize(
    ("asked", "extra"),
    [
        ("minari", "nht[minari]"),
        ("to minari", "nht[minari]"),
        ("hdf5", "nht[minari]"),
        ("onnx", "nht[onnx]"),
        ("dm_control", "nht[dm_control]"),
        ("hand", "nht[hand]"),
        ("gymnasium", "gymnasium[mujoco]"),
        ("recipes", "nht[recipes]"),
    ],
)
def test_what_needs_an_extra_says_which(told, asked, extra):
    assert f"pip install '{extra}'" in told[asked]


@pytest.mark.parametrize("recipe", ["ddpg", "collect_demos", "report", "search"])
def test_a_recipe_without_its_extra_ends_in_one_line(recipe):
    run = f'import runpy; sys.argv = ["{recipe}"]; runpy._run_module_as_main("nht.recipes.{recipe}")'
    done = fresh_process.run(f"{HIDDEN}hide()\n{run}")
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "the recipes need hydra, " in done.stderr
    assert "pip install 'nht[recipes]'" in done.stderr


def test_a_search_without_ray_ends_in_one_line(tmp_path):
    run = f"""
hide({{"ray"}})
import runpy
sys.argv = ["search", "search=smoke", "folder={tmp_path / "search"}"]
runpy._run_module_as_main("nht.recipes.search")
"""
    done = fresh_process.run(HIDDEN + run)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == "error: searches need Ray: pip install 'nht[search]'."
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


LATE = (
    "torch",
    "tensordict",
    "torchrl",
    "mujoco",
    "pandas",
    "hydra",
    "wandb",
    "matplotlib",
    "scipy",
    "minari",
)


@pytest.mark.parametrize(
    ("module", "never"),
    [
        ("nht", {*LATE, "gymnasium", "numpy"}),
        ("nht.envs", {*LATE}),
        ("nht.maps", {"torchrl", "mujoco", "gymnasium", "pandas"}),
        ("nht.recipes", {*LATE}),
        ("nht.recipes.ddpg", {"wandb", "minari", "h5py", "dm_control"}),
    ],
)
def test_nothing_is_imported_before_it_is_needed(module, never):
    found = output(f"import sys, {module}\nprint(*set({sorted(never)}) & set(sys.modules))")
    assert found.split() == []
