"""The architecture, read from the syntax trees: which part may know which."""

import ast
import re
import sys
import tomllib
from graphlib import CycleError, TopologicalSorter
from importlib.metadata import packages_distributions
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
FOLDERS = PYPROJECT["tool"]["setuptools"]["package-dir"]

# Packages of ours that each package may import from.
OURS = {
    "nht": {"nht"},
    "nht.transforms": {"nht", "nht.transforms"},
    "nht.envs": {"nht.envs"},
    "nht.recipes": {"nht", "nht.transforms", "nht.envs", "nht.recipes", "nht.configs"},
    "nht.configs": set(),
}
# Others' packages, beside the standard library, of a package or of a module in it. Recipes may use any.
THEIRS = {
    "nht": {
        "gymnasium.spaces",
        "h5py",
        "minari",
        "numpy",
        "safetensors",
        "tensordict",
        "torch",
        "torchrl.data",
    },
    "nht.transforms": {"tensordict", "torch", "torchrl"},
    "nht.transforms.action_map_wrapper": {"gymnasium", "numpy", "tensordict", "torch"},
    "nht.transforms.gymnasium_mapping": {"gymnasium", "numpy", "tensordict", "torch"},
    "nht.transforms.arguments": {"tensordict", "torch"},
    "nht.envs": {
        "dm_control",
        "gymnasium",
        "gymnasium_robotics",
        "mujoco",
        "numpy",
        "tensordict",
        "torch",
        "torchrl",
    },
    "nht.configs": set(),
}
# Within nht, a module imports from lower layers only. Those not named here are members of the family of maps.
LAYERS = {
    "nht.geometry": 0,
    "nht.networks": 0,
    "nht.reading": -1,
    "nht.writing": 0,
    "nht.hdf5_file": 0,
    "nht.minari_internals": -1,
    "nht.minari_file": 1,
    "nht.minari_episodes": 1,
    "nht.arrays": 0,
    "nht.memmap_files": 0,
    "nht.memmap": 1,
    "nht.manifest": 1,
    "nht.episodes": 0,
    "nht.saturation": 0,
    "nht.allowance": 0,
    "nht.arguments": 0,
    "nht.torch_internals": 0,
    "nht.widths": 0,
    "nht.demos": 2,
    "nht.demos_folder": 3,
    "nht.action_map": 1,
    "nht.offset": 1,
    "nht.linear_map": 2,
    "nht.maps": 3,
    "nht.lipschitz": 5,
    "nht.actuation_lipschitz": 6,
    "nht.map_classes": 5,
    "nht.description": 6,
    "nht.storable": 5,
    "nht.storage": 7,
    "nht.training_data": 5,
    "nht.train": 8,
    "nht.networks_together": 2,
    "nht.limits_together": 6,
    "nht.adam_together": 1,
    "nht.steps_together": 9,
    "nht.train_together": 10,
    "nht.export": 8,
    "nht": 11,
}
FAMILY_LAYER = 4


def test_imports_point_one_way():
    wrong = import_violations(shipped_trees())
    assert not wrong, "\n".join(wrong)


def test_libraries_do_not_import_entry_points():
    trees = shipped_trees()
    entries = {
        name
        for name, tree in trees.items()
        if '__name__ == "__main__"' in ast.unparse(tree).replace("'", '"')
    }
    assert "nht.recipes.ddpg" in entries
    found = {
        (name, entry) for name, tree in trees.items() for entry in imports_of(tree, set(trees)) & entries
    }
    assert found == set()


def test_imports_form_no_circle():
    trees = shipped_trees()
    graph = {name: imports_of(tree, set(trees)) & set(trees) for name, tree in trees.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"circular imports: {error.args[1]}")


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("nht.geometry", "from nht import maps"),
        ("nht.maps", "def f():\n    import nht.lipschitz"),
        ("nht.laser", "from nht.train import train_map"),
        ("nht.laser", "from nht.scl import SCL"),
        ("nht.train", "from nht import NHT"),
        ("nht.train", "import torchrl.envs"),
        ("nht.demos", "import hydra"),
        ("nht.transforms.action_map", "from nht.envs import make_env"),
        ("nht.transforms.action_map", "import transforms.other"),
        ("nht.transforms.action_map_wrapper", "from torchrl.envs import Transform"),
        ("nht.envs.wam", "import nht"),
        ("nht.envs.wam", "from nht.transforms import ActionMapTransform"),
    ],
)
def test_a_wrong_import_is_noticed(module, source):
    modules = [
        "nht",
        "nht.geometry",
        "nht.maps",
        "nht.scl",
        "nht.lipschitz",
        "nht.train",
        "nht.transforms",
        "nht.envs",
    ]
    trees = {name: ast.parse("") for name in modules} | {module: ast.parse(source)}
    assert len(import_violations(trees)) == 1


def test_every_package_that_is_imported_is_declared():
    extras = PYPROJECT["project"]["optional-dependencies"]
    needed = [
        *PYPROJECT["project"]["dependencies"],
        *chain(*(extras[name] for name in extras if name != "dev")),
    ]
    declared = {normalised(re.match(r"[\w.-]+", requirement)[0]) for requirement in needed}
    tops = {name.split(".")[0] for tree in shipped_trees().values() for name in imports_of(tree, set())}
    providers = {
        top: packages_distributions().get(top, [top]) for top in tops - sys.stdlib_module_names - {"nht"}
    }
    assert {top for top, names in providers.items() if not declared & set(map(normalised, names))} == set()


def test_files_are_named_after_what_they_hold():
    names_nothing = re.compile(r"(^|_)(utils?|common|helpers?|misc)(\.py)?$")
    folders = [*FOLDERS.values(), "tests", "benchmarks"]
    files = [file.relative_to(ROOT) for folder in folders for file in (ROOT / folder).rglob("*.py")]
    assert [file for file in files if any(map(names_nothing.search, file.parts))] == []


def shipped_trees() -> dict[str, ast.Module]:
    """Syntax tree of every module that is shipped, by the name it is imported as."""
    trees = {}
    for package, folder in FOLDERS.items():
        if package not in OURS:
            continue  # lies in another one's folder
        for file in sorted((ROOT / folder).rglob("*.py")):
            names = [package, *file.relative_to(ROOT / folder).with_suffix("").parts]
            trees[".".join(names).removesuffix(".__init__")] = ast.parse(file.read_text())
    return trees


def normalised(distribution: str) -> str:
    return re.sub(r"[-_.]+", "-", distribution).lower()


def package_of(module: str) -> str:
    return max((package for package in OURS if is_within(module, package)), key=len)


def is_within(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def imports_of(tree: ast.AST, ours: set[str]) -> set[str]:
    """Modules imported anywhere in the tree: nht.maps by `from nht import maps`. Lint bans relative ones."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            longer = {f"{node.module}.{alias.name}" for alias in node.names}
            modules = longer if node.module == "torchrl" else longer & ours
            found |= modules | ({node.module} if longer - modules else set())
    return found


def import_violations(trees: dict[str, ast.Module]) -> list[str]:
    return [
        f"{module} imports {imported}"
        for module, tree in trees.items()
        for imported in sorted(imports_of(tree, set(trees)))
        if not may_import(module, imported)
    ]


def may_import(module: str, imported: str) -> bool:
    package = package_of(module)
    if is_within(imported, "nht"):
        if package == package_of(imported) == "nht":
            return LAYERS.get(imported, FAMILY_LAYER) < LAYERS.get(module, FAMILY_LAYER)
        return package_of(imported) in OURS[package]
    if package == "nht.recipes" or imported.split(".")[0] in sys.stdlib_module_names:
        return True
    return any(is_within(imported, allowed) for allowed in THEIRS.get(module, THEIRS[package]))
