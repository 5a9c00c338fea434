"""HalfCheetah through maps of other teachers and more dimensions: what an interface is worth beyond the paper's form.

PPO through SVD and NHT, as ``half_cheetah_interfaces.py`` has set them, in its folder. Demonstrated is one episode of a
policy that PPO learned (return 6,966), as there, or of one that SAC learned (9,052), which moves otherwise.

1. *Trials*: both teachers, k = 2, 3 and 4, two scales, for NHT two limits; twelve settings for each interface, two
   seeds each, 307,200 steps.
2. What was kept, chosen as there, learns for 1,003,520 steps with five fresh seeds.

Writes trials, curves, a table and a figure to ``results/half_cheetah_teachers``.

    python benchmarks/learning/half_cheetah_teachers.py FOLDER [INTERFACE ...]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import half_cheetah_interfaces as interfaces
import pandas
from half_cheetah_interfaces import FRESH, INTERFACES, WHOLE, chosen, told, try_out

from populations import trained_runs

RESULTS = interfaces.RESULTS.parent / "half_cheetah_teachers"
PLANE = {"episodes": ("one", "sac"), "k": (2, 3, 4), "scale": (3.5, 5.0)}
LEVELS = {"svd": PLANE, "nht": PLANE | {"lipschitz": (0.03, 0.3)}}


def main() -> None:
    """Try and train what is missing, and show what was learned."""
    folder = Path(sys.argv[1]).resolve()
    known = pandas.read_csv(interfaces.RESULTS / "trials.csv")
    trials, curves = [], []
    for interface in sys.argv[2:] or LEVELS:
        best: dict[str, Any] = {}
        for round, levels in enumerate(INTERFACES[interface], start=1):
            best |= chosen(known[(known["interface"] == interface) & (known["round"] == round)], levels)
        tried = try_out(interface, LEVELS[interface], best, 3, folder)
        trials.append(tried)
        best |= chosen(tried, LEVELS[interface])
        print(interface, best, flush=True)
        run = folder / "teachers" / "-".join([interface, *map(str, best.values())])
        found = trained_runs(run, [*WHOLE, *told(interface, best, folder)], FRESH, "ppo")
        curves.append(found.assign(interface=interface))
        interfaces.save(trials, curves, RESULTS)


if __name__ == "__main__":
    main()
