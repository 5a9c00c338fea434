"""Benchmarks are run by hand, now and then: that they still find what they import is seen here."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
IMPORT_ALL = """
import sys
from importlib.util import module_from_spec, spec_from_file_location

for path in sys.argv[1:]:
    sys.path.insert(0, path.rpartition("/")[0])  # as of a script: benchmarks import their neighbours
    spec = spec_from_file_location(path.replace("/", "_").removesuffix(".py"), path)
    sys.modules[spec.name] = module = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except ImportError as error:
        print(path, error)
"""


def test_every_benchmark_finds_what_it_imports():
    files = sorted((ROOT / "benchmarks").glob("*/*.py"))
    assert files
    ran = subprocess.run([sys.executable, "-c", IMPORT_ALL, *map(str, files)], capture_output=True, text=True)
    assert (ran.stdout, ran.returncode) == ("", 0), ran.stderr
