"""Names of searches on W&B: they cannot collide, and all processes of one search agree on them."""

import re
from concurrent.futures import ThreadPoolExecutor

from nht.recipes.agents.table import find_algorithm
from nht.recipes.launch import configure
from nht.recipes.study.dashboard_names import names_of, search_name
from nht.recipes.study.jobs import Job


def job(**changes):
    entries = {"stage": "search", "env": "wam_wipe", "interface": "svd", "configuration": 3, "seed": 1}
    entries |= {"recipe": "ddpg", "metric": "success", "parameters": {}, "overrides": ()}
    return Job(**entries | changes)


def told(job, folder):
    schema = find_algorithm("ddpg").schema
    return configure(schema, "ddpg", [*names_of(job, folder), "run.folder=x"]).run


def test_two_searches_in_folders_of_one_name_have_other_names(tmp_path):
    names = [search_name(tmp_path / place / "search") for place in ("here", "there")]
    assert names[0] != names[1]
    assert all(re.fullmatch("search-[0-9a-f]{8}", name) for name in names)
    assert search_name(tmp_path / "here" / "search") == names[0]


def test_processes_that_begin_together_agree(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        names = set(pool.map(search_name, [tmp_path / "search"] * 32))
    assert len(names) == 1


def test_runs_of_one_configuration_are_a_group_and_each_has_its_name(tmp_path):
    folder = tmp_path / "it's a search, {odd}"
    runs = [told(job(**changes), folder) for changes in ({}, {"seed": 2}, {"interface": "raw"})]
    assert len({run.wandb_group for run in runs}) == 1
    assert len({run.wandb_name for run in runs}) == 3
    name = search_name(folder)
    assert runs[0].wandb_group == f"{name}-search-003"
    assert runs[0].wandb_name == f"{name}-search-svd-003-seed1"
    assert runs[0].wandb_tags == [name, "search"]
    assert told(job(configuration=4), folder).wandb_group != runs[0].wandb_group
    assert told(job(stage="best"), folder).wandb_group != runs[0].wandb_group
