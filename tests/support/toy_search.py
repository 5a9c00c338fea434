"""Rows as a search writes them, made up: scores that are known."""

import numpy as np
import pandas

from nht.recipes.study.space import VERSION

STRENGTH = {"raw": 0.1, "nht": 0.9, "laser": 0.5, "svd": 0.7, "scl": 0.8, "jacobian": 0.2}


def rows(configurations=8, seeds=3, evaluations=10, best_seeds=5, metric="success"):
    rng = np.random.default_rng(0)
    quality = rng.uniform(size=configurations)
    made = []
    for interface, strength in STRENGTH.items():
        runs = [("search", c, s) for c in range(configurations) for s in range(seeds)]
        runs += [("best", int(quality.argmax()), 100 + s) for s in range(best_seeds)]
        for stage, configuration, seed in runs:
            level = np.clip(strength * (0.4 + 0.6 * quality[configuration]) + rng.normal(0, 0.02), 0, 1)
            failed = interface == "scl" and configuration == 2 and seed == 1
            for step in range(1, 2 if failed else evaluations + 1):
                score = level * (1 - np.exp(-5 * step / evaluations))
                made.append(
                    {
                        "version": VERSION,
                        "metric": metric,
                        "stage": stage,
                        "env": "wam_wipe",
                        "interface": interface,
                        "configuration": configuration,
                        "seed": seed,
                        "status": "diverged" if failed else "done",
                        "reason": "FloatingPointError: loss_value is nan" if failed else "",
                        "frames": 20_000 * step,
                        "eval_success": score if metric == "success" else 0.0,
                        "eval_failure": 0.0,
                        "eval_return": 200 * score - 200 if metric == "success" else 6000 * score,
                        "seconds": 10.0 * step,
                        "algo.gamma": 0.9 + 0.09 * quality[configuration],
                        "algo.batch_size": 32 + configuration,
                        "map.learning_rate": 1e-3 * (1 + configuration) if interface == "nht" else np.nan,
                        "map.activation": "relu" if interface == "nht" and configuration % 2 else None,
                    }
                )
    return pandas.DataFrame(made)
