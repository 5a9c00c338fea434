# %% [markdown]
# # Read a search
#
# A search leaves `rows.csv`: a row for each evaluation of each run, with all that was drawn. This page reads
# one that is committed, the paper's search on WAMWipe in small: 8 configurations, 3 seeds, 6 interfaces.

# %%
import os
from pathlib import Path

import numpy as np
import pandas
from matplotlib import pyplot as plt
from scipy.stats import trim_mean

rows = pandas.read_csv(
    Path(os.environ.get("NHT_ROOT", "../..")) / "benchmarks/results/search_wam_wipe/rows.csv"
)
rows[["interface", "configuration", "seed", "stage", "frames", "eval_success", "map.action_scale"]].head(3)

# %% [markdown]
# ## Runs, not rows
#
# The score of a run is its last evaluation.

# %%
runs = (
    rows[rows["stage"] == "search"]
    .sort_values("frames")
    .groupby(["interface", "configuration", "seed"])
    .last()
    .reset_index()
)
runs.groupby("interface")["eval_success"].agg(["count", "mean", "min", "max"]).round(2)

# %% [markdown]
# ## A robust mean, with an interval
#
# The interquartile mean leaves out the best and the worst quarter of the runs. Its interval comes from
# drawing **configurations** again, with all their seeds: runs of one configuration are no independent
# samples.

# %%
rng = np.random.default_rng(0)


def interval(table):
    """IQM and its 95 % bootstrap interval over configurations, of scores (configurations, seeds)."""
    drawn = rng.integers(len(table), size=(2000, len(table)))
    means = trim_mean(table[drawn].reshape(len(drawn), -1), 0.25, axis=1)
    return trim_mean(table.ravel(), 0.25), *np.quantile(means, [0.025, 0.975])


order = ["nht", "svd", "scl", "laser", "raw", "jacobian"]
scores = {
    name: runs[runs["interface"] == name]
    .pivot(index="configuration", columns="seed", values="eval_success")
    .to_numpy()
    for name in order
}
for name, table in scores.items():
    mean, low, high = interval(table)
    print(f"{name:>9}: {mean:.2f} ({low:.2f} .. {high:.2f})")

# %% [markdown]
# ## Who is robust?
#
# A curve for each interface: which share of the configurations reaches a score. It falls late for an
# interface that does well whatever is drawn.

# %%
for name, table in scores.items():
    mean = np.sort(table.mean(1))
    plt.step(
        np.append(mean, 1.0), np.append(1 - np.arange(len(mean)) / len(mean), 0), where="pre", label=name
    )
plt.xlabel("success")
plt.ylabel("share of configurations at least as good")
plt.legend()
plt.show()

# %% [markdown]
# ## What mattered?
#
# The rank correlation of each drawn number with the score, for NHT: the action scale decides here.

# %%
nht_runs = runs[runs["interface"] == "nht"].groupby("configuration").first()
mean = runs[runs["interface"] == "nht"].groupby("configuration")["eval_success"].mean()
drawn = [
    name
    for name in nht_runs
    if name.startswith(("algo.", "map.")) and nht_runs[name].nunique() > 2 and nht_runs[name].dtype != object
]
nht_runs[drawn].select_dtypes("number").corrwith(mean, method="spearman").sort_values().round(2)

# %% [markdown]
# ## The best configuration, on fresh seeds
#
# The best of many draws looks better than it is, so it runs again on seeds that did not choose it.

# %%
best = rows[rows["stage"] == "best"].pivot_table(index="frames", columns="interface", values="eval_success")
best[order].plot(xlabel="environment steps", ylabel="success, mean of 5 fresh seeds")
plt.show()

# %% [markdown]
# `python -m nht.recipes.report FOLDER` draws all that, and more, for a folder of your own. What this search
# says about the paper's claims is in [The paper's search, reduced](../results/search.md).
