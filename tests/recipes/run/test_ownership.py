"""One owner at a time: whoever contends, however an owner ends."""

import multiprocessing
import os
import signal
import subprocess
import sys

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


def test_every_round_of_a_contest_has_one_winner(tmp_path):
    context, processes, rounds = multiprocessing.get_context("spawn"), 8, 100
    barrier, wins = context.Barrier(processes), context.Array("i", rounds, lock=False)
    arguments = (tmp_path, rounds, barrier, wins)
    contenders = [context.Process(target=contend, args=arguments) for _ in range(processes)]
    for contender in contenders:
        contender.start()
    for contender in contenders:
        contender.join()
    assert list(wins) == [1] * rounds
