"""What processes that want the same thing do, for tests/recipes/run/test_ownership.py."""

from nht.recipes.run.ownership import claimed


def contend(folder, rounds, barrier, wins):
    for number in range(rounds):
        barrier.wait()
        with claimed(folder / str(number % 3)) as ours:
            if ours:
                wins[number] += 1
            barrier.wait()
