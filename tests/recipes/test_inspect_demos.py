"""inspect_demos: the numbers of its summary, what it can read, and its figure."""

import sys

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from tensordict import TensorDict

import nht
from nht.recipes import inspect_demos
from nht.recipes.config import InspectDemos
from nht.recipes.data import summary
from nht.recipes.data.figure import draw_figure
from nht.recipes.data.files import Episodes
from nht.recipes.launch import configure

LENGTHS = [4, 8, 6]


def demonstrations(directions: int = 2) -> TensorDict:
    """Three episodes in a plane of four motors, the second without success; a reward of 1 a step."""
    generator = torch.Generator().manual_seed(0)
    total = sum(LENGTHS)
    number = torch.arange(3).repeat_interleave(torch.tensor(LENGTHS))
    last = torch.cat([torch.arange(length) == length - 1 for length in LENGTHS])[:, None]
    plane = torch.randn(directions, 4, generator=generator)
    return TensorDict(
        {
            "observation": torch.randn(total, 5, generator=generator),
            "actuation": torch.randn(total, directions, generator=generator) @ plane,
            "episode": number,
            "reward": torch.ones(total, 1),
            "done": last,
            "terminated": last,
            "truncated": torch.zeros_like(last),
            "success": last & (number != 1)[:, None],
        },
        batch_size=total,
    )


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "demos"
    nht.save_demos(demonstrations(), path, env="toy", seed=0, expert="Toy", settings={"left_out_episodes": 5})
    return path


def inspect(capsys, *overrides: str) -> dict[str, str]:
    """What is printed, by the word that a line begins with."""
    capsys.readouterr()
    inspect_demos.main(configure(InspectDemos, "inspect_demos", overrides))
    lines = (line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines() if line.strip())
    return {words[0]: words[-1] for words in lines}


def test_the_summary_says_what_is_in_the_demonstrations(saved, capsys):
    printed = inspect(capsys, f"demos={saved}", "directions=3")
    assert (printed["env"], printed["expert"], printed["transitions"]) == ("toy", "Toy", "18")
    assert printed["episodes"] == "3, and 5 left out"
    assert printed["lengths"] == printed["returns"] == "6 on average, 4 .. 8"
    assert printed["success"].startswith("1 ")  # of the table, below the summary
    assert "k=2: 1.0000  k=3: 1.0000" in printed["energy"]
    data = demonstrations()
    low, mean, high = (float(function(data["actuation"])) for function in (torch.min, torch.mean, torch.max))
    assert printed["actuation"].split() == ["4", "float32", f"{low:.4g}", f"{mean:.4g}", f"{high:.4g}", "0"]


def test_success_is_that_of_the_last_steps(saved):
    text = summary.demos_summary(inspect_demos.read_source(str(saved)), directions=4)
    assert "success  0.667 of the episodes, at their last step" in text
    assert "not finite  none" in text


def test_energy_is_that_of_the_singular_vectors():
    actuation = demonstrations(directions=3)["actuation"]
    shares = summary.energy(actuation)
    singular = torch.linalg.svdvals(actuation.double()) ** 2
    np.testing.assert_allclose(shares, singular.cumsum(0) / singular.sum(), rtol=1e-12)
    map = nht.SVD(4, 2)
    demos = nht.Demos.from_tensors(
        context=torch.zeros(18, 1), actuation=actuation, episode=torch.arange(18) // 6
    )
    map.fit(TensorDict({"actuation": demos.actuation, "context": torch.zeros(18, 0)}, batch_size=18))
    missed = nht.projection_error(map, torch.zeros(18, 0), actuation)
    assert 1 - shares[1] == pytest.approx(missed, rel=1e-4)
    with_nan = torch.cat([actuation, torch.full((1, 4), torch.nan)])
    np.testing.assert_array_equal(summary.energy(with_nan), shares)


@pytest.mark.parametrize("motors", [1, 30])
def test_the_figure_is_drawn_for_any_number_of_motors_and_episodes(motors, tmp_path):
    for episodes in (1, 40):
        total = 5 * episodes
        data = TensorDict(
            {
                "actuation": torch.arange(total * motors).reshape(total, motors).sin(),
                "episode": torch.arange(total) // 5,
            },
            batch_size=total,
        )
        data["actuation"][:, 0] = 0.0  # a motor that stands still
        figure = draw_figure(Episodes(data, 0), directions=10)
        figure.savefig(tmp_path / "figure.png", dpi=30)
        assert iio.imread(tmp_path / "figure.png").std() > 10


def test_the_figure_lies_beside_the_demonstrations_or_where_it_is_told_to(saved, tmp_path, capsys):
    printed = inspect(capsys, f"demos={saved}/")
    assert printed["figure"] == f"in {tmp_path / 'demos-inspection.png'}"
    picture = iio.imread(tmp_path / "demos-inspection.png")
    assert picture.shape[1] > picture.shape[0] > 800
    inspect(capsys, f"demos={saved}", f"out={tmp_path / 'figures' / 'one.png'}")
    assert iio.imread(tmp_path / "figures" / "one.png").shape == picture.shape
    assert {entry.name for entry in saved.iterdir()} == {"data", "manifest.json"}


def test_files_of_others_can_be_inspected_nan_and_all(tmp_path, monkeypatch, capsys):
    h5py = pytest.importorskip("h5py")
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    data = demonstrations()
    rollout = data.select("observation").set("action", data["actuation"])
    rollout["next"] = data.exclude("actuation", "episode")
    rollout.memmap(tmp_path / "tensordict")
    broken = data["actuation"].clone()
    broken[3, 1] = float("nan")
    with h5py.File(tmp_path / "toy.h5", "w") as file:
        file["observations"], file["actions"] = data["observation"].numpy(), broken.numpy()
        file["terminals"] = data["done"].squeeze(-1).numpy()
    ahead = torch.where(data["done"], torch.zeros(1), data["observation"].roll(-1, 0))
    nht.to_minari(nht.Demos.from_episodes(data.set("next", {"observation": ahead})), "toy/plane-v0")
    for path in ("tensordict", "toy.h5", "toy/plane-v0", "home/toy/plane-v0/data/main_data.hdf5"):
        printed = inspect(capsys, f"demos={path}")
        assert printed["transitions"] == "18"
        assert printed["lengths"] == "6 on average, 4 .. 8"
        assert printed["not"] == ("finite  1 values" if path == "toy.h5" else "finite  none")
        assert printed["actuation"].split()[-1] == ("1" if path == "toy.h5" else "0")
        assert (tmp_path / f"{path}-inspection.png").is_file()


def test_what_cannot_be_inspected(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "home"))
    pytest.importorskip("minari")
    for overrides, error, message in (
        ([], ValueError, r"nothing to inspect: name the demonstrations, inspect_demos PATH"),
        (["demos=x", "directions=0"], ValueError, r"directions must be at least 1, got 0"),
        (["demos=nowhere"], FileNotFoundError, r"nowhere is neither the folder of a Minari .*there are \[\]"),
    ):
        with pytest.raises(error, match=message):
            inspect_demos.main(configure(InspectDemos, "inspect_demos", overrides))


def test_without_minari_a_wrong_path_is_still_told_apart(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(
        FileNotFoundError, match=r"holds no demonstrations, no TensorDict and no Minari dataset"
    ):
        inspect_demos.read_source(str(tmp_path))
