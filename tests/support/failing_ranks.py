"""What tests/recipes/run/test_ranks.py lets torchrun start: ranks of which some fail, in a recipe that does nothing."""

import os
import sys

from nht.recipes.config import DDPG
from nht.recipes.launch import launch
from nht.recipes.run.ranks import Ranks


def main(config):
    ranks = Ranks()
    if str(ranks.rank) in os.environ["FAILING"].split():
        raise ValueError(f"rank {ranks.rank} has no luck.")
    ranks.wait()


if __name__ == "__main__":
    sys.argv[1:] = []
    launch(main, DDPG, "ddpg")
