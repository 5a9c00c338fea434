"""Maps side by side: what the table holds, what the figures show."""

import json
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pandas
import pytest
import torch
from matplotlib.figure import Figure
from torch import Tensor

import nht
import wandb_file
from nht.recipes import collect_demos, compare_maps
from nht.recipes.config import CollectDemos, CompareMaps
from nht.recipes.launch import configure
from nht.recipes.maps import figures as map_figures
from nht.recipes.maps.kinds import arm_of

KINDS = ["nht", "laser", "cae", "svd", "scl", "jacobian", "none"]


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("demos") / "wam_wipe"
    overrides = ["demos.transitions=2000", f"out={path}", "seed=5", "env.options.start=random"]
    collect_demos.main(configure(CollectDemos, "collect_demos", overrides))
    return path


@pytest.fixture(scope="module")
def common(demos: Path) -> list[str]:
    return [f"demos.path={demos}", "map.max_steps=250", "map.hidden=[16]", "action_dims=[1,2]"]


@pytest.fixture(scope="module")
def compared(common: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("compared") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare_maps, "LATENCY_SECONDS", 0.01)
        compare_maps.main(
            configure(
                CompareMaps, "compare_maps", ["run.wandb=false", *common, f"out={out}", f"maps={KINDS}"]
            )
        )
    return out


def test_the_table_has_every_map(compared: Path) -> None:
    table = pandas.read_csv(compared / "table.csv").set_index(["map", "k"])
    assert len(table) == 5 * 2 + 2
    assert table.loc[("svd", 2), "validation_error"] < table.loc[("svd", 1), "validation_error"]
    assert table.loc[("none", 7), ["validation_error", "parameters"]].tolist() == [0, 0]
    assert (table["largest_ratio"] <= table["certificate"]).all()
    # Not of NHT at k = 1: in 250 steps it finds nothing better than where it starts, SVD's plane.
    assert (table.loc[["laser", "cae", "scl"], "largest_ratio"] > 0).all()
    assert table.loc[("nht", 2), "largest_ratio"] > 0
    assert (table[["latency_1_us", "latency_4096_us", "training_seconds"]] > 0).all(axis=None)
    markdown = (compared / "table.md").read_text()
    assert markdown.startswith("| map | k | held-out error | certificate | largest seen ratio | parameters |")
    assert "| laser | 2 |" in markdown


def test_the_folder_has_figures_and_maps(compared: Path, demos: Path) -> None:
    assert {iio.imread(compared / f"{name}.png").ndim for name in ("error", "basis", "tool")} == {3}
    maps = {file.stem: nht.load_map(file) for file in (compared / "maps").iterdir()}
    assert len(maps) == 5 * 2 + 2
    assert (maps["nht-k1"].action_dim, maps["jacobian-k6"].action_dim) == (1, 6)
    fingerprint = nht.load_demos(demos).fingerprint
    assert {map.data_fingerprint for map in maps.values()} == {fingerprint}


def test_a_decoders_ratio_is_that_of_its_actuations() -> None:
    """On a map that is linear in secret, the fastest of its columns; an offset of the actuation counts, too."""

    class Hidden(nht.ActionMap):
        def forward(self, action: Tensor, context: Tensor) -> Tensor:
            return torch.stack(
                [3 * action[..., 0] * context[..., 0], action[..., 1] + 5 * context[..., 1]], -1
            )

        def project(self, actuation: Tensor, context: Tensor) -> Tensor:
            raise NotImplementedError

    map = Hidden(2, 2, 2)
    map.action_scale.fill_(2.0)
    along = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    assert compare_maps.largest_ratio(map, along) == pytest.approx(3)
    assert compare_maps.largest_ratio(map, along.flip(-1)) == pytest.approx(5 / 2)
    assert np.isnan(compare_maps.largest_ratio(map, torch.zeros(3, 2)))


@pytest.mark.parametrize("kind", ["nht", "cae"])
def test_a_local_basis_is_how_actuation_answers_to_action(compared: Path, demos: Path, kind: str) -> None:
    data, map = nht.load_demos(demos), nht.load_map(compared / "maps" / f"{kind}-k2.safetensors").double()
    assert map.context_keys is not None
    context, actuation = data.context(map.context_keys)[:5].double(), data.actuation[:5].double()
    found = map_figures.local_basis(map, context, actuation)
    action, step = map.project(actuation, context), 1e-5 * torch.eye(2).double()
    expected = [(map(action + change, context) - map(action - change, context)) / 2e-5 for change in step]
    torch.testing.assert_close(found, torch.stack(expected, -1), atol=1e-7, rtol=1e-6)
    if kind == "nht":
        moved = map_figures.axis_motion(map.float(), context.float())
        torch.testing.assert_close(moved, map.action_scale * found.float())


def test_grid_points_are_spread_out_and_only_where_the_tool_was() -> None:
    points = torch.rand(3000, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.36, 0.8])
    rows = map_figures.near_grid(points)
    assert len(rows) == 4 * 9
    assert torch.pdist(points[rows]).min() > 0.8 / 9 / 2
    edges = points[(points[:, 0] < 0.06) | (points[:, 1] < 0.06)]
    assert len(map_figures.near_grid(edges)) == 4 + 9 - 1
    assert map_figures.near_grid(torch.zeros(4, 2)).tolist() == [0]


def test_the_figures_draw_what_the_maps_do(
    compared: Path, demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(map_figures, "save_figure", lambda figure, path: drawn.append(figure))
    data = nht.load_demos(demos)
    maps = {file.stem: nht.load_map(file) for file in sorted((compared / "maps").iterdir())}
    wanted = {name: maps[name] for name in ("svd-k2", "jacobian-k6")}
    map_figures.basis_figure({"svd": maps["svd-k2"]}, data, 1, tmp_path / "unused")
    lines = drawn[0].axes[1].lines[:7]  # the second column; the last line is the zero
    frame = maps["svd-k2"].frame
    assert [line.get_ydata()[0] for line in lines] == pytest.approx(frame[:, 1].tolist())
    assert len(lines[0].get_ydata()) == int((data.episode == 1).sum())

    map_figures.tool_figure(wanted, data, arm_of("wam_wipe"), 2, tmp_path / "unused")
    titles = [panel.get_title() for panel in drawn[1].axes[:2]]
    assert titles == ["svd-k2", "jacobian-k6 (2 of 6 axes)"]
    along_x, along_y = (drawn[1].axes[panel].collections[1] for panel in (1, 3))
    assert (np.abs(along_x.V) < 0.1 * along_x.U).all()  # a Jacobian's first axis is x, its second y
    assert (np.abs(along_y.U) < 0.1 * along_y.V).all()


def test_the_comparison_stands_on_the_dashboard(
    common: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compare_maps, "LATENCY_SECONDS", 0.01)
    out = tmp_path / "out"
    compare_maps.main(
        configure(CompareMaps, "compare_maps", [*common, f"out={out}", "maps=[svd,none]", "action_dims=[2]"])
    )
    found = wandb_file.read_run(out)
    logged = {name for row in found.rows for name in row}
    assert {"maps", "figures/error", "figures/basis", "figures/tool"} <= logged
    table = json.loads(next((out / "wandb").rglob("*.table.json")).read_text())
    assert [row[:2] for row in table["data"]] == [["svd", 2], ["none", 7]]
    handed = {
        name: set(files.aliases) for name, files in found.artifacts.items() if not files.use_after_commit
    }
    assert [aliases for name, aliases in handed.items() if name.startswith("map-k2-")] == [{"latest", "best"}]
    assert [name.split("-")[0] for name, files in found.artifacts.items() if files.use_after_commit] == [
        "demos"
    ]


# Bad input.


def test_nothing_is_overwritten_or_guessed(compared: Path, common: list[str]) -> None:
    with pytest.raises(FileExistsError, match="never overwritten"):
        compare_maps.main(
            configure(CompareMaps, "compare_maps", ["run.wandb=false", *common, f"out={compared}"])
        )
    for override, message in (
        ("maps=[nht,pca]", r"unknown map kind 'pca': choose from \['cae', "),
        ("maps=[]", r"nothing to compare: got maps=\[\]"),
        ("demos.path=null", r"demos.path must name the demonstrations"),
    ):
        with pytest.raises(ValueError, match=message):
            compare_maps.main(
                configure(CompareMaps, "compare_maps", ["run.wandb=false", *common, "out=unused", override])
            )


def test_figures_of_what_is_not_there(demos: Path, tmp_path: Path) -> None:
    data, untrained = nht.load_demos(demos), {"nht": nht.NHT(10, 7, 2, hidden=(8,))}
    with pytest.raises(ValueError, match=r"there is no episode 1000: the last is \d+"):
        map_figures.basis_figure(untrained, data, 1000, tmp_path / "basis.png")
    with pytest.raises(ValueError, match="this NHT is not trained: it has no context keys"):
        map_figures.basis_figure(untrained, data, 0, tmp_path / "basis.png")
