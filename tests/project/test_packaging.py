"""The wheel: what is in it, and that it works where the checkout is not."""

import os
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
FOLDERS = PROJECT["tool"]["setuptools"]["package-dir"]
SOURCES = [  # of the packages, relative to the root
    file.relative_to(ROOT)
    for folder in FOLDERS.values()
    for file in sorted((ROOT / folder).rglob("*"))
    if len(Path(folder).parts) == 1  # the others lie in these
    and file.is_file()
    and "__pycache__" not in file.parts
]
RECIPES = [
    file.stem
    for file in SOURCES
    if file.parts[0] == "recipes" and '__name__ == "__main__"' in (ROOT / file).read_text()
]


def run(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run([str(word) for word in command], cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy: setuptools leaves its build/ in the source tree and would ship what lies there."""
    scratch = tmp_path_factory.mktemp("wheel")
    for file in [*SOURCES, Path("pyproject.toml"), Path("README.md"), Path("LICENSE")]:
        (scratch / "source" / file).parent.mkdir(parents=True, exist_ok=True)
        (scratch / "source" / file).write_bytes((ROOT / file).read_bytes())
    run(
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        scratch,
        "./source",
        cwd=scratch,
    )
    (built,) = scratch.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("installed")
    run(
        sys.executable,
        "-m",
        "pip",
        "install",
        "--no-deps",
        "--no-index",
        "--target",
        target,
        wheel,
        cwd=target,
    )
    return target


def python(installed: Path, code: str) -> str:
    """Runs code with the scratch install and our dependencies in reach, but not the checkout.

    -I drops the working directory and PYTHONPATH; -S skips the .pth file of the editable install.
    """
    path = [str(installed), sysconfig.get_path("purelib")]
    return run(sys.executable, "-I", "-S", "-c", f"import sys; sys.path += {path}\n{code}", cwd=installed)


def test_wheel_holds_every_file_under_one_top_level_module(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name.split("/")[0] for name in names} == {"nht", f"nht-{PROJECT['project']['version']}.dist-info"}
    by_folder = {folder: package.replace(".", "/") for package, folder in FOLDERS.items()}
    expected = {f"{by_folder[file.parts[0]]}/{Path(*file.parts[1:]).as_posix()}" for file in SOURCES}
    assert {name for name in names if name.startswith("nht/")} == expected


def test_wheel_holds_types_models_and_configs(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = [Path(name) for name in archive.namelist()]
    assert Path("nht/py.typed") in names
    assert any(name.match("nht/envs/assets/*.xml") for name in names)
    assert any(name.match("nht/configs/*.yaml") for name in names)
    assert any(name.match("nht/configs/*/*.yaml") for name in names)
    assert any(name.match("*.dist-info/licenses/LICENSE") for name in names)


def test_every_module_imports_outside_the_checkout(installed):
    code = """
import importlib, pkgutil, nht
print(getattr(nht, "__version__", None))
for found in pkgutil.walk_packages(nht.__path__, "nht."):
    print(importlib.import_module(found.name).__file__)
"""
    version, *files = python(installed, code).split()
    assert len(files) == sum(file.suffix == ".py" for file in SOURCES) - 1  # without nht itself
    assert [file for file in files if not Path(file).is_relative_to(installed)] == []
    assert version == PROJECT["project"]["version"]


def test_recipes_find_their_configuration_outside_the_checkout(installed):
    code = f"""
import runpy
sys.argv = ["recipe", "--help"]
for recipe in {RECIPES}:
    runpy.run_module("nht.recipes." + recipe, run_name="__main__")
    print("told about", recipe)
"""
    told = python(installed, code)
    assert [recipe for recipe in RECIPES if f"told about {recipe}" not in told] == []


def test_make_and_ci_scripts_are_executable():
    assert [file.name for file in (ROOT / ".ci").iterdir() if not os.access(file, os.X_OK)] == []
