"""Every option is read: a field of a configuration that no recipe looks at is a promise not kept.

The recipes run, small, while the fields of their configurations are watched.
"""

import contextlib
import sys
from collections import defaultdict
from dataclasses import dataclass, field, fields, is_dataclass
from unittest.mock import MagicMock

import pytest

import tiny_runs
from nht.recipes import (
    collect_demos,
    compare_maps,
    evaluate,
    export_map,
    inspect_demos,
    report,
    search,
    steer,
    train_map,
    workspace,
)
from nht.recipes import config as schemas
from nht.recipes.agents.table import ALGORITHMS, Algorithm
from nht.recipes.launch import configure

CHECKS = ("__post_init__", "_check_unit", "_check_positive", "_check_least", "scale_is_set")
"""Looking whether a value is good, or copying it, is not reading it."""
ELSEWHERE = {
    "AlgoConfig.num_envs",  # becomes env.num_envs when a configuration is made
    "SearchConfig.best_frames",  # of the best runs, which this search has none of
    "SearchConfig.seed",  # of demonstrations that the search collects, and of draws from a space
}


class Reads:
    """Which fields of which dataclasses are read while it watches."""

    def __init__(self, patch):
        self.found, self._patch, self._watched = defaultdict(set), patch, set()

    def watch(self, schema):
        for kind in {schema, *sections(schema)} - self._watched:
            self._watched.add(kind)
            self._watch(kind)

    def _watch(self, kind):
        found, names = self.found[kind], {entry.name for entry in fields(kind)}

        def look(self, name):
            if name in names:
                code = sys._getframe(1).f_code
                if code.co_name not in CHECKS and not code.co_filename.endswith("dataclasses.py"):
                    found.add(name)
            return object.__getattribute__(self, name)

        self._patch.setattr(kind, "__getattribute__", look)

    def unread(self):
        """``Class.field`` of what nobody read, under the class that declares the field."""
        return {
            f"{declarer(kind, entry.name).__name__}.{entry.name}"
            for kind in self._watched
            for entry in fields(kind)
            if entry.name not in self.found[kind]
        }


def sections(schema):
    """The dataclasses in the fields of a dataclass."""
    made = [entry.default_factory() for entry in fields(schema) if callable(entry.default_factory)]
    kinds = {type(value) for value in made if is_dataclass(value)}
    return kinds.union(*map(sections, kinds))


def declarer(kind, name):
    return next(parent for parent in reversed(kind.__mro__) if name in getattr(parent, "__annotations__", {}))


@dataclass
class Section:
    size: int = 1
    depth: int = 2


@dataclass
class Root:
    section: Section = field(default_factory=Section)
    seed: int = 0
    out: str = ""


def test_an_unread_option_is_noticed(monkeypatch):
    reads = Reads(monkeypatch)
    reads.watch(Root)
    config = Root()
    assert reads.unread() == {"Root.section", "Root.seed", "Root.out", "Section.size", "Section.depth"}
    assert config.section.size + config.seed == 1
    config.out = "written, not read"
    assert reads.unread() == {"Root.out", "Section.depth"}


class InProcess:
    """A cluster of this process alone."""

    def __init__(self, *_):
        pass

    def run(self, work, jobs, folder):
        for job in jobs:
            work(job, folder)
            yield job

    def close(self):
        pass


@pytest.fixture
def reads(monkeypatch):
    reads = Reads(monkeypatch)
    for schema in [
        getattr(schemas, name) for name in schemas.__all__ if is_dataclass(getattr(schemas, name))
    ]:
        if schema is not schemas.Training:
            reads.watch(schema)
    for name in ALGORITHMS:
        reads.watch(ALGORITHMS[name].schema)
    return reads


def test_every_option_is_read(reads, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(recipe, schema, name, *overrides):
        recipe.main(configure(schema, name, overrides))

    run(collect_demos, schemas.CollectDemos, "collect_demos", "demos.transitions=300", "out=demos")
    small = ["demos.path=demos", "map.max_steps=20", "map.hidden=[8]", "map.lipschitz=2.0"]
    run(train_map, schemas.TrainMap, "train_map", *small, "out=map.safetensors")
    for algorithm in tiny_runs.RECIPES:
        own = ["map=nht", *small, "algo.total_frames=100", "evaluation.every=100", "run.checkpoint_every=100"]
        tiny_runs.train(algorithm, tmp_path / "runs" / algorithm, *own)
    tiny_runs.train("ddpg", tmp_path / "runs" / "wandb", *own, "run.wandb=true", "algo.buffer_size=500")
    run(evaluate, schemas.Evaluate, "evaluate", "run=runs/ddpg", "episodes=2", "video_episodes=1")
    source = ["source=policy", "source.path=runs/ddpg", "demos.transitions=10", "out=policy"]
    with contextlib.suppress(RuntimeError):  # hardly trained, it may not succeed
        run(collect_demos, schemas.CollectDemos, "collect_demos", *source)
    with pytest.raises(FileNotFoundError):
        run(
            collect_demos,
            schemas.CollectDemos,
            "collect_demos",
            "source=hdf5",
            "source.path=none",
            "out=none",
        )
    with pytest.raises(FileNotFoundError):
        run(
            collect_demos, schemas.CollectDemos, "collect_demos", "source=minari", "source.path=x", "out=none"
        )
    run(inspect_demos, schemas.InspectDemos, "inspect_demos", "demos=demos")
    compared = [*small, "maps=[svd]", "action_dims=[2]", "out=compared"]
    run(compare_maps, schemas.CompareMaps, "compare_maps", *compared)
    run(export_map, schemas.ExportMap, "export_map", "file=map.safetensors", "out=map.pt2")
    run(report, schemas.Report, "report", "folder=runs")
    monkeypatch.setattr(
        workspace, "import_module", lambda _: MagicMock()
    )  # an extra, whose views need a server
    run(workspace, schemas.Workspace, "workspace", "entity=somebody")
    monkeypatch.setattr("nht.recipes.steer.keep_pace", lambda *_: None)
    run(steer, schemas.Steer, "steer", "run=runs/ddpg", "maps=[map.safetensors]", "port=0")
    monkeypatch.setattr("nht.recipes.study.cluster.Cluster", InProcess)
    monkeypatch.setattr(Algorithm, "train", lambda *_: None)
    told = ["search=smoke", "search.best_seeds=0", "demos.path=demos", "folder=search"]
    run(search, schemas.Search, "search", *told)
    assert reads.unread() - ELSEWHERE == set()
