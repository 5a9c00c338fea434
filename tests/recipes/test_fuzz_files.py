"""Changed files of every kind are refused clearly, or mean the same; none runs anything, none writes.

The whole table: ``python tests/recipes/test_fuzz_files.py``.
"""

import os
import sys
import tempfile
from pathlib import Path

import pytest

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from fuzzed_files import KINDS, fuzz

TRIES = 10_000


@pytest.fixture
def folder(tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "files"))
    (tmp_path / "files").mkdir()
    return tmp_path / "files"


@pytest.mark.parametrize("kind", KINDS)
def test_a_few_changes(kind, folder):
    counts, others = fuzz(kind, folder, tries=43, seed=0)
    assert not others, others
    assert counts.total() == 43
    assert counts["clear"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_changes(kind, folder):
    _, others = fuzz(kind, folder, tries=-(-TRIES // len(KINDS)), seed=1)
    assert not others, others


def main(tries: int) -> None:
    """Print what became of the changes, by kind of file."""
    print("| kind of file | tried | clear | equal meaning | another that is possible | other |")
    print("|---|---|---|---|---|---|")
    for kind in KINDS:
        with tempfile.TemporaryDirectory() as folder:
            os.environ["MINARI_DATASETS_PATH"] = folder
            counts, others = fuzz(kind, Path(folder), tries, seed=1)
        numbers = (counts.total(), *(counts[name] for name in ("clear", "equal", "taken", "other")))
        print(f"| {kind} | {' | '.join(map(str, numbers))} |", flush=True)
        for text in others[:5]:
            print(f"  {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else -(-TRIES // len(KINDS)))
