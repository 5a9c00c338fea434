# %% [markdown]
# # Compose with TorchRL
#
# A map, a transform, and TorchRL's own parts: collector, replay buffer, loss. The task is Gymnasium's
# Reacher, of which nothing here knows anything; its two torques become one action. Budgets are tiny, so that
# this page is built in seconds: what it shows is how things fit together, not how well they learn.

# %%
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, DoubleToFloat, GymEnv, StepCounter, TransformedEnv
from torchrl.modules import MLP, TanhModule
from torchrl.objectives import DDPGLoss, SoftUpdate

import nht
from nht.transforms import ActionMapTransform

_ = torch.manual_seed(0)

# %% [markdown]
# ## Demonstrations, and a map
#
# Here they come from a rollout of random torques along one direction that turns with the first joint; yours
# come from an expert, a person, or another policy.

# %%
raw = GymEnv("Reacher-v5")
raw.set_seed(0)


def torques(observation):
    """Along a direction that depends on the first joint's angle, whose cosine and sine are observed."""
    direction = torch.stack([observation[..., 0], observation[..., 2]], -1)
    return (direction * (2 * torch.rand(1) - 1)).clamp(-1, 1).float()


demonstrator = TensorDictModule(torques, in_keys=["observation"], out_keys=["action"])
rollouts = [raw.rollout(50, demonstrator) for _ in range(8)]
demos = nht.Demos.from_tensordict(torch.cat(rollouts), env="reacher")
demos

# %%
map = nht.NHT(context_dim=10, actuation_dim=2, action_dim=1, hidden=(32,))
trained = nht.train_map(demos, map, context_keys=["observation"], max_steps=500)
{name: round(value, 4) for name, value in trained.metrics.items() if "error" in name or name == "certificate"}

# %% [markdown]
# ## The environment that a policy sees
#
# The map knows its context keys by now. The action spec has one dimension; the torques that were executed
# stand in the data as `("next", "actuation")`.

# %%
env = TransformedEnv(
    GymEnv("Reacher-v5"),
    Compose(ActionMapTransform(map), DoubleToFloat(in_keys=["observation"]), StepCounter(max_steps=50)),
)
env.action_spec

# %%
step = env.rollout(3)
print(
    "action",
    tuple(step["action"].shape),
    "context",
    tuple(step["context"].shape),
    "actuation",
    tuple(step["next", "actuation"].shape),
)

# %% [markdown]
# ## A learner of your own
#
# TorchRL's DDPG, with nothing of ours in it.

# %%
actor = TensorDictModule(
    nn.Sequential(MLP(in_features=10, out_features=1, num_cells=[32])),
    in_keys=["observation"],
    out_keys=["param"],
)
policy = TensorDictSequential(actor, TanhModule(in_keys=["param"], out_keys=["action"]))


class Value(nn.Module):
    """Q(observation, action)."""

    def __init__(self):
        super().__init__()
        self.network = MLP(in_features=11, out_features=1, num_cells=[32])

    def forward(self, observation, action):
        """The value, (*batch, 1)."""
        return self.network(torch.cat([observation, action], -1))


critic = TensorDictModule(Value(), in_keys=["observation", "action"], out_keys=["state_action_value"])
loss = DDPGLoss(policy, critic)
loss.make_value_estimator(gamma=0.95)
target = SoftUpdate(loss, tau=0.01)
optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(2000), batch_size=64)

# %%
history = []
for data in Collector(env, policy, frames_per_batch=100, total_frames=600):
    buffer.extend(data)
    for _ in range(10):
        losses = loss(buffer.sample())
        optimiser.zero_grad()
        (losses["loss_actor"] + losses["loss_value"]).backward()
        optimiser.step()
        target.step()
    history.append((data["next", "reward"].mean().item(), losses["loss_value"].item()))

for reward, value in history:
    print(f"mean reward {reward:.3f}, critic's loss {value:.3f}")

# %% [markdown]
# ## What stays with the map
#
# A saved map is one file that knows all of this. Whoever loads it needs no more than its path:

# %%
nht.save_map(map, "map.safetensors")
ActionMapTransform("map.safetensors")

# %% [markdown]
# [The transform's rules](../how/transform.md) say where it may stand among other transforms, and [your own
# algorithm](../guides/algorithm.md) how to make this loop a recipe with checkpoints, workers and reports.
