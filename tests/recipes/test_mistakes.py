"""What is wrong is told in one line, before anything is trained, and leaves nothing behind."""

import sys

import pytest
import torch

import nht
from nht.recipes import collect_demos, compare_maps, ddpg, evaluate, export_map, report, train_map
from nht.recipes.config import (
    DDPG,
    CollectDemos,
    CompareMaps,
    Evaluate,
    ExportMap,
    Report,
    TrainMap,
)
from nht.recipes.launch import launch
from nht.recipes.run.ranks import usable_device


@pytest.fixture
def told(tmp_path, monkeypatch):
    """Runs a recipe in an empty folder, in which no map can be trained; gives the error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(nht, "train_map", lambda *_, **__: pytest.fail("a map was trained"))

    def run(recipe, schema, *words, positional=None):
        name = recipe.__name__.rsplit(".", 1)[-1]
        monkeypatch.setattr(sys, "argv", [name, *words])
        with pytest.raises(SystemExit) as ended:
            launch(recipe.main, schema, name, positional=positional)
        error = str(ended.value)
        assert error.startswith("error: ")
        assert len(error.splitlines()) == 1
        assert len(error) < 1_000
        return error

    return run


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize(("recipe", "schema"), [(ddpg, DDPG), (train_map, TrainMap)])
def test_a_gpu_that_is_not_there_is_told_and_no_folder_is_left(told, tmp_path, recipe, schema):
    assert "device=cuda needs a GPU that PyTorch can use" in told(recipe, schema, "device=cuda")
    assert "device=cuda:3 needs a GPU" in told(recipe, schema, "device=cuda:3")
    assert "device=gpu is none that PyTorch knows" in told(recipe, schema, "device=gpu")
    assert list(tmp_path.iterdir()) == []


def test_a_gpu_beyond_those_there_are_is_told(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert usable_device("cuda:1") == torch.device("cuda", 1)
    assert usable_device("cuda") == torch.device("cuda")
    with pytest.raises(ValueError, match="device=cuda:2 is not there: PyTorch sees 2 GPUs"):
        usable_device("cuda:2")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["env.options.start=nowhere"], "start must be one of ('fixed', 'random'), got 'nowhere'"),
        (["env.options.strat=fixed"], "unexpected keyword argument 'strat': its options are"),
        (["env.name=moon"], "unknown environment 'moon': choose from"),
        (["env.suite=theirs"], "unknown env.suite 'theirs': choose from"),
        (["env=gymnasium", "env.name=Moon-v0"], "gymnasium has no environment 'Moon-v0'"),
        (
            ["env=gymnasium", "env.name=InvertedPendulum-v5", "+env.options.width=1000000000000"],
            "InvertedPendulum-v5 cannot be made with the options {'width': 1000000000000}: ",
        ),
        (["env=torchrl", "env.name=nowhere:make"], "No module named 'nowhere'"),
        (["map.kind=pca"], "unknown"),
    ],
)
def test_wrong_tasks_and_options_are_told_before_the_map_is_trained(told, tmp_path, words, message):
    assert message in told(ddpg, DDPG, *words, "run.folder=run")
    assert list(tmp_path.iterdir()) == []


def test_a_report_of_garbage_says_what_is_wrong(told, tmp_path):
    def report_of(folder, *files):
        (tmp_path / folder).mkdir()
        for name, content in files:
            (tmp_path / folder / name).write_bytes(content)
        before = sorted(tmp_path.rglob("*"))
        error = told(report, Report, folder, positional="folder")
        assert folder in error
        assert sorted(tmp_path.rglob("*")) == before
        return error

    assert "no metrics.csv in or below" in report_of("empty")
    assert "lacks the columns" in report_of("search", ("rows.csv", b"hi\n"))
    assert "is not YAML" in report_of("yaml", ("metrics.csv", b"frames\n"), ("config.yaml", b": ["))
    report_of("bytes", ("metrics.csv", bytes(range(256))), ("config.yaml", b"recipe: ddpg\n"))
    report_of("rows", ("rows.csv", bytes(range(256))))
    assert "no metrics.csv in or below" in told(report, Report, "runs=[nowhere (1)]", positional="folder")
    assert "name a folder of runs" in told(report, Report, positional="folder")


@pytest.mark.parametrize(
    ("recipe", "schema", "words", "message"),
    [
        (evaluate, Evaluate, ["run=nowhere"], "nowhere holds no run"),
        (export_map, ExportMap, ["file=nowhere", "out=map.onnx"], "nowhere"),
        (collect_demos, CollectDemos, ["source=hdf5", "source.path=a=b (1)", "out=x"], "a=b (1)"),
        (compare_maps, CompareMaps, ["demos.path=it's not there"], "it's not there"),
        (train_map, TrainMap, ["demos.path=a,b", "out=x"], "a,b"),
    ],
)
def test_files_that_are_not_there_are_named(told, tmp_path, recipe, schema, words, message):
    assert message in told(recipe, schema, *words)
    assert list(tmp_path.iterdir()) == []
