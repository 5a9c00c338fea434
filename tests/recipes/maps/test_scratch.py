"""What is recorded for one map alone goes again, that of killed runs too."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from nht.recipes.maps.interface import SCRATCH, trained_map
from nht.recipes.sections import DemosConfig, EnvConfig, MapConfig
from nht.writing import OWNED, scratch


def test_what_a_killed_run_recorded_for_its_map_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with scratch(tmp_path / SCRATCH) as living:
        owner = OWNED.match(living.name)
        assert owner is not None
        # The process that had our number before us: one that began when the machine did.
        dead = living.with_name(f".{SCRATCH}.{owner['host']}-{owner['pid']}-1-00000000")
        (dead / "demos").mkdir(parents=True)
        living.mkdir()
        trained_map(MapConfig(kind="svd"), EnvConfig(), DemosConfig(transitions=200), seed=0)
        assert list(tmp_path.iterdir()) == [living]
