"""What a search draws: the distributions of the paper's tables, and draws that depend on nothing but their place."""

import json
import math

import numpy as np
import pytest
from scipy import stats

from nht.recipes.config import Search
from nht.recipes.launch import configure
from nht.recipes.study.space import Distribution, draw_settings, write_search_manifest

SPACE = {
    "agent": {"algo.gamma": {"uniform": [0.9, 0.99]}, "map.action_scale": {"exponential": [1.0, 10.0]}},
    "raw": {"map.action_scale": {"exponential": [0.1, 10.0]}},
    "nht": {"map.hidden_units": {"geometric": [16, 1024]}, "map.activation": {"choice": ["relu", "tanh"]}},
}


def drawn(kind, values, number=4_000):
    distribution = Distribution.parse("x", {kind: values})
    return np.array([distribution.at(q) for q in np.random.default_rng(0).random(number)])


def test_uniform():
    assert stats.kstest(drawn("uniform", [2.0, 5.0]), stats.uniform(2, 3).cdf).pvalue > 0.01


def test_exponential_is_uniform_in_the_logarithm():
    values = drawn("exponential", [1e-4, 1e-2])
    assert stats.kstest(np.log10(values), stats.uniform(-4, 2).cdf).pvalue > 0.01


def test_geometric_is_that_in_whole_numbers():
    values = drawn("geometric", [16, 1024])
    assert values.dtype == np.int64
    assert values.min() >= 16
    assert values.max() <= 1024
    assert np.median(values) == pytest.approx(128, rel=0.1)


def test_integers_and_choices_are_equally_likely():
    for values in (drawn("integer", [3, 6]), drawn("choice", [3, 4, 5, 6])):
        found, counts = np.unique(values, return_counts=True)
        assert found.tolist() == [3, 4, 5, 6]
        assert stats.chisquare(counts).pvalue > 0.01


def test_interfaces_share_the_draw_of_the_agent():
    for number in range(20):
        nht, svd, raw = (draw_settings(SPACE, 0, number, name) for name in ("nht", "svd", "raw"))
        assert {name: nht[name] for name in svd} == svd
        assert nht["algo.gamma"] == raw["algo.gamma"]
        # The same quantile of another range: log10 scale from 0 to 1, and from -1 to 1.
        assert math.log10(raw["map.action_scale"]) == pytest.approx(
            2 * math.log10(svd["map.action_scale"]) - 1
        )
    assert set(nht) == {"algo.gamma", "map.action_scale", "map.hidden_units", "map.activation"}


def test_a_draw_depends_on_its_place_alone():
    values = {
        draw_settings(SPACE, seed, number, "svd")["algo.gamma"] for seed in range(4) for number in range(5)
    }
    assert len(values) == 20
    less = {"agent": {"algo.gamma": SPACE["agent"]["algo.gamma"]}}
    assert draw_settings(less, 1, 2, "svd")["algo.gamma"] == draw_settings(SPACE, 1, 2, "nht")["algo.gamma"]
    # Written down, for it must be the same on every machine.
    assert draw_settings(SPACE, 0, 0, "svd")["algo.gamma"] == pytest.approx(0.973336192302298, abs=1e-12)


def test_the_papers_tables():
    wam = configure(Search, "search", ["search=wam"]).search
    assert (wam.configs, wam.seeds, wam.total_frames) == (128, 5, 1_000_000)
    many = [draw_settings(wam.space, 0, number, "nht") for number in range(500)]
    for name, low, high in [
        ("algo.actor_learning_rate", 1e-4, 1e-2),
        ("algo.critic_learning_rate", 1e-4, 1e-2),
        ("algo.random_action", 0, 0.4),
        ("algo.exploration_noise", 0, 0.4),
        ("algo.action_l2", 0, 1),
        ("map.action_scale", 1, 10),
        ("algo.batch_size", 32, 256),
        ("algo.polyak", 0.9, 0.99),
        ("map.learning_rate", 1e-6, 1e-1),
        ("map.batch_size", 32, 256),
        ("map.hidden_layers", 1, 4),
        ("map.hidden_units", 16, 1024),
        ("map.lipschitz", 1e-1, 1e2),
    ]:
        values = np.array([configuration[name] for configuration in many])
        assert low <= values.min() <= values.max() <= high
        assert stats.rankdata(values).std() > 0
    assert {configuration["map.activation"] for configuration in many} == {"relu", "sigmoid", "tanh"}
    cheetah = configure(Search, "search", ["search=half_cheetah"]).search
    assert (cheetah.recipe, cheetah.metric) == ("ppo", "return")
    rates = [draw_settings(cheetah.space, 0, number, "raw")["algo.frames_per_batch"] for number in range(100)]
    assert set(rates) == {1024, 2048, 4096}


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (
            {"normal": [0, 1]},
            r"search\.space\.nht\.x must be one of \['uniform', .*\]: \[\.\.\.\], got \{'normal'",
        ),
        ({"uniform": [1, 0]}, r"uniform takes \[low, high\] with low < high, got \[1, 0\]"),
        ({"exponential": [0, 1]}, r"exponential needs positive bounds, got \[0, 1\]"),
        ({"choice": []}, "a choice needs values, got none"),
        ({"uniform": [0, 1], "choice": [1]}, "must be one of"),
    ],
)
def test_distributions_that_do_not_exist(written, message):
    with pytest.raises(ValueError, match=message):
        Distribution.parse("nht.x", written)


def test_a_manifest_is_of_one_search(tmp_path):
    path = tmp_path / "manifest.json"
    settings = {"configs": 8, "seeds": 3, "space": SPACE, "seed": 0}
    write_search_manifest(path, settings)
    write_search_manifest(path, settings | {"configs": 128, "seeds": 5})  # more of the same
    assert json.loads(path.read_text())["settings"]["configs"] == 128
    with pytest.raises(ValueError, match=r"is of another search: configs was 128, is 8; seed was 0, is 1\."):
        write_search_manifest(path, settings | {"seeds": 5, "seed": 1})
    path.write_text(json.dumps({"version": "0.0.1/1", "settings": settings}))
    with pytest.raises(ValueError, match=r"was written by version 0\.0\.1/1, this is"):
        write_search_manifest(path, settings)
