"""A package of one's own, `tests/outside`: its map, task and algorithm run through everything we have."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

OUTSIDE = Path(__file__).parents[1] / "outside"
TINY = [
    "env=six_reach",
    "env.options.max_episode_steps=25",
    "algo.frames_per_batch=100",
    "algo.total_frames=400",
    "algo.updates_per_batch=2",
    "algo.warmup_frames=0",
    "algo.hidden=[16]",
    "algo.buffer_size=1000",
    "evaluation.every=200",
    "evaluation.episodes=3",
    "evaluation.video=false",
    "run.checkpoint_every=200",
    "run.wandb=false",
]


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """Runs Python in an empty folder, with the package installed."""
    place, work = tmp_path_factory.mktemp("installed"), tmp_path_factory.mktemp("work")
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
    ]
    source = tmp_path_factory.mktemp("source") / "outside"
    subprocess.run(["cp", "-r", str(OUTSIDE), str(source)], check=True)  # building writes beside the source
    subprocess.run([*pip, "--target", str(place), str(source)], check=True, capture_output=True)

    def run(*arguments):
        command = [sys.executable, *map(str, arguments)]
        environment = os.environ | {"PYTHONPATH": str(place)}
        done = subprocess.run(command, cwd=work, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    run.work = work
    return run


CODE = """
import sys
import gymnasium, nht
from nht.recipes import collect_demos, compare_maps, ddpg, evaluate, report, train_map
from nht.recipes.agents.table import find_algorithm
from nht.recipes.config import CollectDemos, CompareMaps, DDPG, Evaluate, Report, TrainMap
from nht.recipes.launch import configure

tiny = sys.argv[1:]
assert configure(DDPG, "ddpg", ["env=six_reach_wide"]).env.options == {"radius": 0.1}
collect_demos.main(configure(CollectDemos, "collect_demos", ["env=six_reach", "demos.transitions=600", "out=demos"]))
demos = nht.load_demos("demos", env="six_reach")
assert demos.manifest["expert"] == "ReachExpert" and bool(demos.data["success"][-1])
train = ["env=six_reach", "run.wandb=false", "map=two_sided", "map.args={size: 0.5}", "demos.path=demos"]
train += ["map.max_steps=250"]
train_map.main(configure(TrainMap, "train_map", [*train, "out=map.safetensors"]))
try:
    train_map.main(configure(TrainMap, "train_map", [*train[:3], "demos.path=demos", "map.args={sise: 0.5}", "out=x"]))
except ValueError as error:
    assert "map.args ['sise'] are not arguments of 'two_sided'" in str(error), error
map = nht.load_map("map.safetensors", allow=("six_joints",))
assert map.size == 0.5 and map.context_keys == ("joint_angle",), map
own = ["map=six_joints.two_sided:TwoSided", "map.file=map.safetensors", "map.allow=[six_joints]", "run.folder=by_path"]
ddpg.main(configure(DDPG, "ddpg", [*tiny, "demos.path=demos", *own]))
ddpg.main(configure(DDPG, "ddpg", [*tiny, "demos.path=demos", "map=two_sided", "map.max_steps=250", "run.folder=run"]))
again = ["demos.path=demos", "map=two_sided", "map.max_steps=250", "run.folder=run", "run.resume=true"]
ddpg.main(configure(DDPG, "ddpg", [*tiny, *again, "algo.total_frames=600"]))
held = find_algorithm("held_ddpg")
held.train(configure(held.schema, "held_ddpg", [*tiny, "map=none", "run.folder=held"]))
for run in ("run", "held"):
    evaluate.main(configure(Evaluate, "evaluate", [f"run={run}", "episodes=3", "video=false"]))
report.main(configure(Report, "report", ["run.wandb=false", "video=false", "runs=[run,held]", "out=report"]))
compare = ["run.wandb=false", "env=six_reach", "demos.path=demos", "maps=[two_sided,svd]", "action_dims=[2]"]
compare += ["map.max_steps=250"]
compare_maps.main(configure(CompareMaps, "compare_maps", [*compare, "out=compared"]))
env = gymnasium.make("nht.envs:nht/SixReach-v0")
env.reset(seed=0)
steps = 1
while not env.step(env.action_space.sample())[3]:
    steps += 1
assert steps == 100, steps
print("all done")
"""


def test_map_task_and_algorithm_of_ones_own(python):
    assert python("-c", CODE, *TINY).endswith("all done\n")


@pytest.mark.slow
def test_the_command_line_and_a_search(python):
    python("-m", "nht.recipes.collect_demos", "env=six_reach", "demos.transitions=600", "out=shared")
    told = ["env=six_reach", "map=two_sided", "map.max_steps=250", "demos.path=shared"]
    python("-m", "six_joints.held_ddpg", *TINY, *told)
    assert (python.work / "runs" / "held_ddpg-six_reach-two_sided-seed0" / "metrics.csv").exists()
    search = ["search=smoke", "search.env=six_reach", "search.recipe=held_ddpg", "search.configs=1"]
    base = "search.base=[" + ",".join([*TINY[2:3], *TINY[4:], "map.max_steps=250"]) + "]"
    more = ["search.interfaces=[two_sided,raw]", "search.total_frames=400", "search.best_frames=400"]
    python("-m", "nht.recipes.search", *search, base, *more, "demos.path=shared", "folder=searched")
    python("-m", "nht.recipes.report", "searched", "run.wandb=false", "video=false")
    assert "| two_sided |" in (python.work / "searched" / "report" / "report.md").read_text()
