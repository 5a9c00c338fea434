"""One owner at a time: whoever contends, however an owner ends."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time

import pandas
import pytest

import killed_runs
from contest import contend
from nht.recipes.run.ownership import claimed, owner_of

HOLD = """
import sys, time
from pathlib import Path
from nht.recipes.run.ownership import claimed
with claimed(Path(sys.argv[1])) as ours:
    print(ours, flush=True)
    time.sleep(60)
"""


def test_a_claim_is_one_process_s(tmp_path):
    file = tmp_path / "claims" / "run"
    with claimed(file) as ours, claimed(file) as again:
        assert ours
        assert not again
        assert owner_of(file) == f"process {os.getpid()} on {os.uname().nodename}"
    assert not file.exists()
    with claimed(file) as ours:
        assert ours


def test_a_claim_falls_with_its_owner_and_not_before(tmp_path):
    file = tmp_path / "run"
    with subprocess.Popen([sys.executable, "-c", HOLD, file], stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout.readline() == "True\n"
        owner.send_signal(signal.SIGSTOP)
        os.utime(file, (0, 0))  # no clock is asked
        with claimed(file) as ours:
            assert not ours
            assert owner_of(file) == f"process {owner.pid} on {os.uname().nodename}"
        owner.kill()
    assert file.exists()
    with claimed(file) as ours:
        assert ours


def test_garbage_is_nobody_s_claim(tmp_path):
    file = tmp_path / "run"
    file.write_text("{garbage")
    assert owner_of(file) == "another process"
    with claimed(file) as ours:
        assert ours


@pytest.mark.parametrize(("processes", "rounds"), [(8, 100), pytest.param(16, 1000, marks=pytest.mark.slow)])
def test_every_round_of_a_contest_has_one_winner(processes, rounds, tmp_path):
    context = multiprocessing.get_context("spawn")
    barrier, wins = context.Barrier(processes), context.Array("i", rounds, lock=False)
    arguments = (tmp_path, rounds, barrier, wins)
    contenders = [context.Process(target=contend, args=arguments) for _ in range(processes)]
    for contender in contenders:
        contender.start()
    for contender in contenders:
        contender.join()
    assert list(wins) == [1] * rounds


@pytest.mark.slow
def test_a_run_that_another_process_writes_is_left_alone(tmp_path):
    told, folder = ["algo.total_frames=2000", "evaluation.every=500"], tmp_path / "run"
    first = killed_runs.start("ddpg", folder, told)
    while not (folder / "config.yaml").exists():
        assert first.is_alive()
        time.sleep(0.01)
    for resume in ("auto", "true", "false"):
        second = killed_runs.start("ddpg", folder, [*told, f"run.resume={resume}"])
        second.join()
        assert second.exitcode == 1
        assert first.is_alive()
    first.join()
    assert first.exitcode == 0, killed_runs.words(folder)
    refusal = (
        f"OwnedError: {folder} is being written by process {first.pid} on {os.uname().nodename}: wait, or"
    )
    assert killed_runs.words(folder).count(refusal) == 3
    killed_runs.finish("ddpg", tmp_path / "alone", told)
    tables = [pandas.read_csv(tmp_path / name / "metrics.csv") for name in ("run", "alone")]
    pandas.testing.assert_frame_equal(*(table.drop(columns="seconds") for table in tables))


@pytest.mark.slow
def test_of_two_fresh_starts_at_once_one_gets_in(tmp_path):
    told = ["algo.total_frames=600", "evaluation.every=300", "run.resume=false"]
    for number in range(8):
        folder, barrier = tmp_path / f"run{number}", killed_runs.CONTEXT.Barrier(2)
        both = [killed_runs.start("ddpg", folder, told, barrier) for _ in range(2)]
        for process in both:
            process.join()
        assert sorted(process.exitcode for process in both) == [0, 1], killed_runs.words(folder)
        assert pandas.read_csv(folder / "metrics.csv")["frames"].tolist() == [300, 600]
