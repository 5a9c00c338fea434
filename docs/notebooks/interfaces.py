# %% [markdown]
# # Compare interfaces
#
# The same demonstrations, several maps: which of them can do the task at all? This is WAMWipe, a seven-joint
# arm that slides its tool over a table; starts are random, with the elbow swivelled. Maps here are trained
# for seconds; [How well maps fit](../results/maps.md) has them whole.

# %%
import torch
from matplotlib import pyplot as plt
from tensordict.nn import TensorDictModule

import nht
import nht.envs

_ = torch.manual_seed(0)
OPTIONS = {"start": "random", "swivel_range": 1.0}

# %% [markdown]
# ## The expert's demonstrations

# %%
env = nht.envs.make_env("wam_wipe", num_envs=32, seed=0, **OPTIONS)
expert = nht.envs.make_expert("wam_wipe")


def act(*observed):
    """The expert's joint velocities for the observations of all copies."""
    seen = {key: value.numpy() for key, value in zip(SEEN, observed, strict=True)}
    return torch.as_tensor(expert(seen), dtype=torch.float32)


SEEN = ["tool_position", "joint_angle", "goal"]
acting = TensorDictModule(act, in_keys=SEEN, out_keys=["action"])
recorded = env.rollout(80, acting, break_when_any_done=False)
demos = nht.Demos.from_tensors(
    context={key: recorded[key].flatten(0, 1) for key in ("tool_position", "joint_angle")},
    actuation=recorded["action"].flatten(0, 1),
    episode=torch.arange(32).repeat_interleave(80),
    env="wam_wipe",
)
demos

# %% [markdown]
# ## Maps with two actions

# %%
size = {"context_dim": 10, "actuation_dim": 7, "action_dim": 2}
maps = {
    "NHT": nht.NHT(**size, hidden=(64, 64)),
    "SCL": nht.SCL(**size, hidden=(64, 64)),
    "SVD": nht.SVD(actuation_dim=7, action_dim=2, context_dim=10),
    "CAE": nht.CAE(**size, hidden=(64, 64)),
}
keys = ["tool_position", "joint_angle"]
for name, map in maps.items():
    metrics = nht.train_map(demos, map, context_keys=keys, max_steps=600).metrics
    print(f"{name}: misses {metrics['validation_error']:.1e}, certificate {metrics['certificate']:.3g}")

# %% [markdown]
# A certificate is a proven bound on how fast the basis turns; nothing is known of autoencoders, so theirs is
# infinite.
#
# ## The expert through each map
#
# A small error is not yet a level motion. So let the expert act *through* the map: project its actuation, and
# execute what comes back. If that fails, no policy can do the task through this map. The tolerance is tight,
# 5 mm.

# %%
for name, map in maps.items():
    test = nht.envs.make_env("wam_wipe", num_envs=64, seed=1, height_tolerance=0.005, **OPTIONS)

    def through(*observed, map=map):
        """The nearest actuation to the expert's that the map can give."""
        context = torch.cat(observed[:2], -1).float()
        return map(map.project(act(*observed), context), context)

    with torch.no_grad():
        mapped = TensorDictModule(through, in_keys=SEEN, out_keys=["action"])
        driven = test.rollout(199, mapped, break_when_any_done=False)
    print(f"{name}: {driven['next', 'success'][:, -1].float().mean():.2f} of 64 episodes end at the goal")

# %% [markdown]
# ## What the axes do
#
# Columns of the basis along one demonstration, a line for each motor. SVD's would be level.

# %%
context = demos.context(keys)[:80].float()
figure, axes = plt.subplots(1, 2, sharey=True, figsize=(8, 3))
for axis, ax in enumerate(axes):
    ax.plot(maps["NHT"].basis(context)[:, :, axis].detach())
    ax.set_title(f"NHT, action axis {axis + 1}")
    ax.set_xlabel("step")
plt.show()

# %% [markdown]
# The recipe does all that, with tables and figures of several numbers of actions:
#
# ```sh
# python -m nht.recipes.compare_maps env=wam_wipe demos.path=runs/demos maps=[nht,svd,scl,cae] action_dims=[1,2,3]
# ```
