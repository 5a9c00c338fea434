"""Progress bars: lively on a terminal, quiet in a log file; what libraries log does not reach the user."""

import io
import logging
import re
import sys
import warnings
from pathlib import Path

import pytest

import fresh_process
from nht.recipes import launch
from nht.recipes.progress_bar import LOG, TERMINAL, progress_bar, show_beside
from nht.recipes.quiet import LEVEL, quiet_libraries

RECIPES = Path(launch.__file__).parent


class Terminal(io.StringIO):
    def isatty(self):
        return True


def drawn(monkeypatch, stream):
    monkeypatch.setattr(sys, "stderr", stream)
    with progress_bar(1_000, "steps", "step") as bar:
        for _ in range(1_000):
            show_beside(bar, error=0.5)
            bar.update()
    return bar, stream.getvalue()


def test_a_log_file_gets_the_start_and_the_end(monkeypatch):
    bar, text = drawn(monkeypatch, io.StringIO())
    assert bar.mininterval == bar.maxinterval == LOG
    assert text.count("steps:") == 2
    assert "1000 of 1000" in text
    assert "error=0.5" in text


def test_a_log_file_gets_lines_without_what_moves_a_cursor(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with progress_bar(10, "outer", "step") as outer:
        outer.update(3)
        with progress_bar(4, "inner", "step") as inner:
            inner.update(4)
        outer.update(7)
    text = sys.stderr.getvalue()
    assert not re.search("[\r\x1b]", text)
    assert [line.split(",")[0] for line in text.splitlines()] == [
        "outer:   0 %",
        "inner:   0 %",
        "inner: 100 %",
        "outer: 100 %",
    ]
    assert "10 of 10 [" in text


def test_a_log_file_gets_a_line_a_minute(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with progress_bar(10_000, "steps", "step") as bar:
        for _ in range(600):
            now[0] += 1.0
            bar.update()
    assert 9 <= len(sys.stderr.getvalue().splitlines()) <= 12  # of ten minutes


def test_the_messages_of_torchrl_do_not_reach_whoever_calls_a_recipe(tmp_path):
    """Not even without the command line, which sets filters."""
    code = f"""
import sys, warnings
from pathlib import Path
sys.path.insert(0, {str(Path(fresh_process.__file__).parent)!r})
warnings.simplefilter("always")
import nht, tiny_runs
from nht.recipes import collect_demos, train_map
from nht.recipes.config import CollectDemos, TrainMap
from nht.recipes.launch import configure
folder = Path({str(tmp_path)!r})
tiny_runs.train("ddpg", folder / "run", "algo.total_frames=200", "evaluation.every=200")
collect_demos.main(configure(CollectDemos, "collect_demos", [f"out={{folder / 'demos'}}", "demos.transitions=500"]))
told = [f"demos.path={{folder / 'demos'}}", f"out={{folder / 'map.safetensors'}}", "map.max_steps=5", "run.wandb=false"]
train_map.main(configure(TrainMap, "train_map", told))
"""
    done = fresh_process.run(code)
    assert done.returncode == 0, done.stderr
    said = done.stdout + done.stderr
    assert "saved in" in said
    assert "Initialized" not in said
    assert "target network" not in said


def test_a_terminal_sees_every_word_at_once(monkeypatch):
    bar, text = drawn(monkeypatch, Terminal())
    assert bar.mininterval == TERMINAL
    assert text.count("steps:") > 900


def test_a_bar_that_is_not_drawn_takes_words_too(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with progress_bar(10, "steps", "step", disable=True) as bar:
        show_beside(bar, error=0.5)
        bar.update()
    assert sys.stderr.getvalue() == ""


def test_all_bars_of_the_recipes_are_these():
    callers = {file.name for file in RECIPES.rglob("*.py") if "tqdm(" in file.read_text()}
    assert callers == {"progress_bar.py"}


@pytest.fixture
def torchrl_log(monkeypatch):
    logger = logging.getLogger("torchrl")
    before = logger.level
    monkeypatch.setenv(LEVEL, "INFO")
    yield logger
    logger.setLevel(before)


def test_the_log_of_torchrl_is_quiet_unless_the_user_set_its_level(torchrl_log, monkeypatch):
    torchrl_log.setLevel(logging.INFO)
    with warnings.catch_warnings():
        quiet_libraries()
        assert torchrl_log.level == logging.INFO
        monkeypatch.delenv(LEVEL)
        quiet_libraries()
    assert torchrl_log.level == logging.WARNING


def test_one_warning_is_left_out_and_others_are_not(torchrl_log):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        quiet_libraries()
        warnings.warn("No target network updater has been associated with this loss module.", stacklevel=1)
        warnings.warn("Something else.", stacklevel=1)
    assert [str(warning.message) for warning in seen] == ["Something else."]


def test_importing_changes_no_log_and_no_start_method():
    """TorchRL itself sets the start method when it is imported: ours is what it left."""
    code = """
import logging, os, sys
import torch.multiprocessing as multiprocessing
import torchrl
told = os.environ.get("RL_LOGGING_LEVEL")
multiprocessing.set_start_method("fork", force=True)
level = logging.getLogger("torchrl").level
import nht, nht.envs, nht.transforms
import nht.recipes.ddpg, nht.recipes.search, nht.recipes.compare_maps
assert os.environ.get("RL_LOGGING_LEVEL") == told
assert logging.getLogger("torchrl").level == level, (level, logging.getLogger("torchrl").level)
print(multiprocessing.get_start_method())
"""
    done = fresh_process.run(code)
    assert done.stdout.split() == ["fork"], done.stderr
