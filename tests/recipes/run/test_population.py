"""Learners that train together become what each would be alone, whatever befalls the others."""

import json

import pandas
import pytest
import torch

import populations
from nht.recipes import evaluate, report
from nht.recipes.config import Evaluate, Report
from nht.recipes.launch import configure
from nht.recipes.run.population import DIVERGED_FILE
from nht.recipes.run.saved_run import read_config
from populations import MAINS, OWN

MORE = {"ddpg": ["algo.updates_per_batch=10"], "ppo": []}
RATE = {"ddpg": "actor_learning_rate", "ppo": "learning_rate"}
FRAME = pandas.testing.assert_frame_equal


@pytest.fixture(params=sorted(MAINS))
def algorithm(request):
    return request.param


def of(algorithm, names, *overrides):
    return {name: [*OWN[algorithm][name], *MORE[algorithm], *overrides] for name in names}


def same_policy(one, other):
    return (one / "policy.safetensors").read_bytes() == (other / "policy.safetensors").read_bytes()


def test_a_population_is_as_many_runs(algorithm, tmp_path, monkeypatch):
    """Every setting that may differ does, and the maps, too."""
    learners = of(algorithm, "abc")
    for seed, (name, told) in enumerate(learners.items()):
        file = populations.map_of(tmp_path / "maps", seed, hidden=(8,) if name != "c" else (6, 6))
        told += ["map=nht", f"map.file={file}"]
    with populations.watched(monkeypatch) as together:
        found = populations.train(algorithm, tmp_path / "together", learners)
    for learner, (name, told) in enumerate(learners.items()):
        with populations.watched(monkeypatch) as alone:
            expected = populations.train(algorithm, tmp_path / "alone", {name: told})[name]
        for loss, values in alone.items():
            torch.testing.assert_close(
                together[loss][:10, learner],
                values[:10],
                rtol=1e-5,
                atol=1e-5,  # ppo's objective is a mean about 0 of terms about 1
                msg=lambda text, n=loss: f"{n}: {text}",
            )
        FRAME(found[name], expected, rtol=1e-3, atol=1e-3)
    for loss, values in together.items():
        assert not torch.equal(values[:, 0], values[:, 1]), loss


@pytest.mark.slow
def test_seeds_are_as_many_runs(algorithm, tmp_path, capsys):
    told = ["seed=4", "seeds=3", *MORE[algorithm]]
    MAINS[algorithm](populations.config(algorithm, tmp_path / "together", *told))
    shown = capsys.readouterr().out
    for seed in (4, 5, 6):
        folder = tmp_path / "together" / f"seed-{seed}"
        alone = populations.train(
            algorithm, tmp_path / "alone", {str(seed): [f"seed={seed}", *MORE[algorithm]]}
        )
        FRAME(populations.metrics(folder), alone[str(seed)], rtol=1e-3, atol=1e-3)
        present = {entry.name for entry in folder.iterdir()}
        assert {
            "config.yaml",
            "metrics.csv",
            "map.safetensors",
            "policy.safetensors",
            "whole.json",
        } <= present
        assert (read_config(folder).seed, read_config(folder).seeds) == (seed, None)
        assert f"seed-{seed}" in shown
    assert (tmp_path / "together" / "checkpoints").is_dir()


@pytest.mark.slow
def test_one_seed_is_a_run(algorithm, tmp_path):
    MAINS[algorithm](populations.config(algorithm, tmp_path / "one", "seed=4", "seeds=1"))
    alone = populations.train(algorithm, tmp_path / "alone", {"own": ["seed=4"]})["own"]
    FRAME(populations.metrics(tmp_path / "one" / "seed-4"), alone)
    assert same_policy(tmp_path / "one" / "seed-4", tmp_path / "alone" / "own")


@pytest.mark.slow
def test_who_is_beside_a_learner_does_not_matter(algorithm, tmp_path):
    few = populations.train(algorithm, tmp_path / "few", of(algorithm, "ab"))
    many = populations.train(
        algorithm, tmp_path / "many", of(algorithm, "ac") | {"d": of(algorithm, "b", "seed=9")["b"]}
    )
    FRAME(many["a"], few["a"], rtol=1e-5, atol=1e-6)


def test_beside_others_of_the_same_settings_it_is_the_same_bit_for_bit(algorithm, tmp_path):
    def seeds(*given):
        return {str(seed): [f"seed={seed}", *MORE[algorithm]] for seed in given}

    few = populations.train(algorithm, tmp_path / "few", seeds(1, 2))
    many = populations.train(algorithm, tmp_path / "many", seeds(1, 7, 8))
    FRAME(many["1"], few["1"], check_exact=True)


@pytest.mark.parametrize("where", [pytest.param(200, marks=pytest.mark.slow), 300])
def test_stopped_it_goes_on_as_if_it_had_not_been(algorithm, where, tmp_path, monkeypatch):
    learners = of(
        algorithm, "abc", "algo.total_frames=400", "evaluation.every=200"
    )  # and checkpoints between
    whole = populations.train(algorithm, tmp_path / "whole", learners)
    with pytest.raises(KeyboardInterrupt), populations.breaking_off(monkeypatch, where):
        populations.train(algorithm, tmp_path / "stopped", learners)
    resumed = {name: [*told, "run.resume=true"] for name, told in learners.items()}
    found = populations.train(algorithm, tmp_path / "stopped", resumed)
    for name in learners:
        FRAME(found[name], whole[name])
        assert same_policy(tmp_path / "stopped" / name, tmp_path / "whole" / name)


@pytest.mark.slow
def test_whole_it_is_left_as_it_is(algorithm, tmp_path, capsys):
    learners = of(algorithm, "ab")
    populations.train(algorithm, tmp_path / "run", learners)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*") if path.is_file()}
    capsys.readouterr()
    populations.train(
        algorithm, tmp_path / "run", {n: [*told, "run.resume=auto"] for n, told in learners.items()}
    )
    after = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*") if path.is_file()}
    assert {path: at for path, at in after.items() if path.name != ".owner"} == {
        path: at for path, at in before.items() if path.name != ".owner"
    }
    assert "2 learners" in capsys.readouterr().out


def test_a_learner_that_diverges_harms_no_other(algorithm, tmp_path, capsys):
    def learners(rate):
        return {
            name: [*OWN[algorithm]["a"], f"seed={seed}", *MORE[algorithm], f"algo.{RATE[algorithm]}={own}"]
            for name, seed, own in (("a", 1, 0.001), ("b", 2, rate), ("c", 3, 0.002))
        }

    sound = populations.train(algorithm, tmp_path / "sound", learners(0.003))
    configs = learners(1e30)
    for told in configs.values():
        told.append("algo.total_frames=400")
    populations.MAINS[algorithm](
        *[populations.config(algorithm, tmp_path / "lost" / name, *told) for name, told in configs.items()],
        together=str(tmp_path / "lost"),
    )
    lost = tmp_path / "lost" / "b"
    note = json.loads((lost / DIVERGED_FILE).read_text())
    assert "training diverged" in note["reason"] or "steps diverged" in note["reason"]
    rows = len(populations.metrics(lost)) if (lost / "metrics.csv").exists() else 0
    assert rows == note["frames"] // 100 - 1  # those before
    assert not {"policy.safetensors", "whole.json"} & {entry.name for entry in lost.iterdir()}
    assert "diverged" in capsys.readouterr().out
    for name in "ac":
        found = populations.metrics(tmp_path / "lost" / name)
        assert len(found) == 4
        if algorithm == "ddpg":  # ppo's learning rates fall towards total_frames
            FRAME(found.iloc[:2], sound[name])
        assert (tmp_path / "lost" / name / "policy.safetensors").exists()


@pytest.mark.slow
def test_a_map_that_gives_no_numbers_harms_no_other(algorithm, tmp_path):
    lost = populations.Lost(10, 7, 2)
    lost.context_keys = ("tool_position", "joint_angle")
    file = populations.nht.save_map(lost, tmp_path / "lost.safetensors")
    other = populations.map_of(tmp_path / "maps", 1, hidden=(6,))  # applied by itself, like the lost one
    told = ["map.kind=populations:Lost", f"map.file={file}", "map.allow=[populations]"]

    def learners(*middle):
        maps = [f"map.file={populations.map_of(tmp_path / 'maps', 0)}", "map=nht"]
        return {
            name: [*OWN[algorithm]["a"], f"seed={seed}", *MORE[algorithm], *(middle if name == "b" else maps)]
            for name, seed in (("a", 1), ("b", 2), ("c", 3))
        }

    sound = populations.train(
        algorithm,
        tmp_path / "sound",
        learners("map=nht", f"map.file={other}"),
    )
    configs = learners(*told)
    MAINS[algorithm](
        *[populations.config(algorithm, tmp_path / "run" / name, *words) for name, words in configs.items()],
        together=str(tmp_path / "run"),
    )
    note = json.loads((tmp_path / "run" / "b" / DIVERGED_FILE).read_text())
    assert note["frames"] == 100
    assert "every one of 100 steps diverged" in note["reason"]
    for name in "ac":
        FRAME(populations.metrics(tmp_path / "run" / name), sound[name])


@pytest.mark.slow
def test_all_of_them_diverge(algorithm, tmp_path):
    learners = {
        name: [f"seed={seed}", *MORE[algorithm], f"algo.{RATE[algorithm]}=1e30", "algo.total_frames=400"]
        for name, seed in (("a", 1), ("b", 2))
    }
    with pytest.raises(FloatingPointError, match=r"all 2 learners diverged; the first: .*training diverged"):
        populations.train(algorithm, tmp_path / "run", learners)
    assert (tmp_path / "run" / "a" / DIVERGED_FILE).exists()


@pytest.mark.slow
def test_a_diverged_learner_stays_so_when_the_others_go_on(algorithm, tmp_path, monkeypatch):
    learners = of(algorithm, "abc", "algo.total_frames=400")
    learners["b"].append(f"algo.{RATE[algorithm]}=1e30")
    for told in learners.values():
        told.append("run.resume=auto")

    def run(folder):
        configs = [populations.config(algorithm, folder / name, *told) for name, told in learners.items()]
        MAINS[algorithm](*configs, together=str(folder))
        return {name: populations.metrics(folder / name) for name in "ac"}

    whole = run(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt), populations.breaking_off(monkeypatch, 400):
        run(tmp_path / "stopped")
    note = (tmp_path / "stopped" / "b" / DIVERGED_FILE).read_text()
    found = run(tmp_path / "stopped")
    assert (tmp_path / "stopped" / "b" / DIVERGED_FILE).read_text() == note
    for name in "ac":
        FRAME(found[name], whole[name])
    run(tmp_path / "stopped")  # it is whole


@pytest.mark.slow
def test_the_last_evaluation_may_have_more_episodes(algorithm, tmp_path, monkeypatch):
    from nht.recipes.run import record

    seen, evaluate_all = [], record.evaluate

    def watch(env, policy):
        seen.append(tuple(env.batch_size))
        return evaluate_all(env, policy)

    monkeypatch.setattr(record, "evaluate", watch)
    populations.train(algorithm, tmp_path / "run", of(algorithm, "ab", "evaluation.final_episodes=5"))
    assert seen == [(2, 3), (2, 5)]


@pytest.fixture
def seeds(tmp_path):
    MAINS["ddpg"](populations.config("ddpg", tmp_path / "seeds", "seeds=3"))
    return tmp_path / "seeds"


def test_a_learner_is_evaluated_like_any_run(seeds, capsys):
    evaluate.main(configure(Evaluate, "evaluate", [f"run={seeds / 'seed-1'}", "episodes=2", "video=false"]))
    assert "eval_return" in capsys.readouterr().out


def test_a_report_takes_a_folder_of_seeds(seeds):
    report.main(
        configure(Report, "report", ["run.wandb=false", "video=false", f"folder={seeds}", "metric=return"])
    )
    curves = pandas.read_csv(seeds / "report" / "curves.csv")
    assert sorted(curves["seed"].unique()) == [0, 1, 2]
    assert len(curves) == 6
    assert "| raw | 3 | 200 |" in (seeds / "report" / "return-table.md").read_text()
    report.main(
        configure(Report, "report", ["run.wandb=false", "video=false", f"folder={seeds}", "metric=return"])
    )  # not thrown by its own files
