"""Pythons and versions: what pyproject.toml, constraints.txt and the scripts say fits together."""

import os
import re
import subprocess
import sys
import tomllib
from importlib.metadata import requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PYTHONS = ["3.11", "3.12", "3.13"]


def where(version):
    return {"python_version": version, "python_full_version": f"{version}.0"}


def asked_for(lines, version):
    """The requirements that hold in a Python, by name."""
    found = [Requirement(line) for line in lines]
    held = [each for each in found if each.marker is None or each.marker.evaluate(where(version))]
    return {canonicalize_name(each.name): each for each in held}


def pins(version):
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return asked_for([line for line in lines if line and not line.startswith("#")], version)


def test_the_pythons_that_we_test_are_those_that_we_name():
    named = [line.removeprefix("Programming Language :: Python :: ") for line in PROJECT["classifiers"]]
    assert [line for line in named if re.fullmatch(r"3\.\d+", line)] == PYTHONS
    allowed = SpecifierSet(PROJECT["requires-python"])
    assert allowed.contains(PYTHONS[0])
    assert not allowed.contains("3.10")
    assert f"for version in {' '.join(PYTHONS)};" in (ROOT / "Makefile").read_text()


@pytest.mark.parametrize("version", PYTHONS)
def test_what_is_tested_is_what_is_allowed(version):
    for lines in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()):
        wanted = asked_for([line for line in lines if not line.startswith("nht[")], version)
        for name, requirement in wanted.items():
            (pin,) = pins(version)[name].specifier
            assert pin.operator == "=="
            assert requirement.specifier.contains(pin.version), f"{requirement} in Python {version}"


def test_the_oldest_and_the_newest_torch_that_we_speak_of_are_tested():
    tested = {str(pins(version)["torch"].specifier)[2:] for version in PYTHONS}
    (oldest,) = asked_for(PROJECT["dependencies"], "3.11")["torch"].specifier
    assert f"{oldest.version}.0" in tested
    assert len(tested) == 3


def test_mujoco_is_capped_only_where_dm_control_needs_it():
    assert asked_for(PROJECT["dependencies"], "3.11")["mujoco"].specifier.contains("4.0.0")
    assert not asked_for(PROJECT["optional-dependencies"]["dm_control"], "3.11")["mujoco"].specifier.contains(
        "4.0.0"
    )


def test_without_labmaze_the_extra_has_the_rest_of_what_dm_control_needs():
    pytest.importorskip("dm_control", reason="compared with what dm_control asks for")
    theirs = asked_for([line for line in requires("dm_control") if "extra" not in line], "3.13")
    ours = PROJECT["optional-dependencies"]["dm_control"] + PROJECT["dependencies"]
    assert set(theirs) - {"labmaze", "setuptools"} <= set(asked_for(ours, "3.13"))
    assert "dm-control" in asked_for(ours, "3.12")
    assert not {"dm-control", "labmaze"} & set(asked_for(ours, "3.13"))


def fake(folder, name, ends):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(f"#!/bin/sh\nexit {ends}\n")
    (folder / name).chmod(0o755)
    return str(folder / name)


def found(tmp_path, *names):
    """What .ci/python prints where there are no Pythons but those of the test."""
    fake(tmp_path / "path", "python3.11", 1)  # a shim of a version that is not chosen
    fake(tmp_path / "path", "python3", 0)
    fake(tmp_path / "pyenv" / "versions" / "3.11.9" / "bin", "python3.11", 0)
    place = {"PATH": f"{tmp_path / 'path'}:{os.defpath}", "PYENV_ROOT": str(tmp_path / "pyenv")}
    done = subprocess.run([ROOT / ".ci" / "python", *names], env=place, capture_output=True, text=True)
    assert done.returncode == (not done.stdout)
    return done.stdout.strip()


def test_a_python_is_found_by_its_name_behind_pyenvs_shims_and_by_its_path(tmp_path):
    hidden = str(tmp_path / "pyenv" / "versions" / "3.11.9" / "bin" / "python3.11")
    assert found(tmp_path, "python3") == "python3"
    assert found(tmp_path, "python3.11", "python3") == hidden
    assert found(tmp_path, hidden) == hidden
    assert found(tmp_path, "python4.1", "python3") == "python3"
    assert found(tmp_path, "python4.1") == ""
    assert found(tmp_path, "/nowhere/python3.11") == ""


def test_setup_says_what_it_wants_where_there_is_no_python(tmp_path):
    command = ["make", "setup", f"VENV={tmp_path / 'venv'}", "PYTHON=python4.1"]
    alone = {key: value for key, value in os.environ.items() if key not in ("MAKEFLAGS", "MAKELEVEL")}
    done = subprocess.run(command, cwd=ROOT, env=alone, capture_output=True, text=True)
    assert done.returncode == 2
    assert "No Python 3.11 or newer with venv and ensurepip found among: python4.1." in done.stderr
    assert "make setup PYTHON=/path/to/python3.12" in done.stderr


# What Python 3.14 does: it formats a help text as soon as an argument is added.
EAGER = """
import argparse, runpy, sys
add = argparse._ActionsContainer.add_argument
def add_and_format(self, *names, **options):
    action = add(self, *names, **options)
    if action.help and hasattr(self, "_get_formatter"):
        self._get_formatter()._expand_help(action)
    return action
argparse._ActionsContainer.add_argument = add_and_format
"""
HYDRAS = "from hydra._internal.utils import get_args_parser; get_args_parser()"
OURS = """
sys.argv = ["ddpg", "--help"]
runpy._run_module_as_main("nht.recipes.ddpg")
"""


def test_the_recipes_do_without_hydras_parser_which_python_3_14_refuses():
    done = subprocess.run([sys.executable, "-c", EAGER + OURS], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "gamma" in done.stdout
    refused = subprocess.run([sys.executable, "-c", EAGER + HYDRAS], capture_output=True, text=True)
    assert "LazyCompletionHelp" in refused.stderr, "Hydra can be used there now: say so in the README"
