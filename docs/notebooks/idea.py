# %% [markdown]
# # A plane that turns with the posture
#
# The whole idea, on an arm small enough to draw: three joints in a plane, and a tool that is to slide along a
# line. It needs one degree of freedom; the arm has three motors. Which joint velocities move the tool along
# the line **depends on the posture**.

# %%
import numpy as np
from matplotlib import pyplot as plt

LINKS = np.array([0.5, 0.4, 0.3])


def joints(q):
    """Where base, elbows and tool are, (4, 2), at joint angles q [rad]."""
    heading = np.cumsum(q)
    steps = LINKS[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1)
    return np.vstack([np.zeros(2), np.cumsum(steps, 0)])


def jacobian(q):
    """How the tool moves, (2, 3), for each joint velocity."""
    points = joints(q)
    arms = points[-1] - points[:-1]
    return np.stack([-arms[:, 1], arms[:, 0]])


# %% [markdown]
# An expert slides the tool from left to right at a constant height, by the pseudo-inverse of its Jacobian. We
# write down what a map will see (**context**: the joint angles) and what the motors got (**actuation**: joint
# velocities).

# %%
rng = np.random.default_rng(0)
contexts, actuations, episodes = [], [], []
for episode in range(40):
    q = np.array([2.2, -1.3, -0.9]) + rng.uniform(-0.15, 0.15, 3)
    for _ in range(30):
        velocity = np.linalg.pinv(jacobian(q)) @ np.array([0.5, 0.0])  # the tool: 0.5 m/s along x
        contexts.append(q.copy())
        actuations.append(rng.choice([-1, 1]) * velocity)  # to the left or to the right
        episodes.append(episode)
        q += 0.04 * velocity

contexts, actuations = np.array(contexts), np.array(actuations)
for step in (0, 10, 20, 29):
    plt.plot(*joints(contexts[step]).T, "o-", label=f"step {step}")
plt.gca().set_aspect("equal")
plt.legend()
plt.title("One demonstration")
plt.show()

# %% [markdown]
# ## One plane for all postures
#
# Singular vectors give the direction that explains most of the motion. With $k = 1$ it is a line in the space
# of joint velocities, the same for all postures, and it misses a part:

# %%
_, _, directions = np.linalg.svd(actuations)
line = directions[0]
missed = actuations - (actuations @ line)[:, None] * line
share = (missed**2).sum() / (actuations**2).sum()
print(f"SVD misses {share:.1%} of the motion")

# %% [markdown]
# ## A line that turns
#
# A unit vector $v$ makes a reflection $H(v) = I - 2 v v^\top$. The first column of $H(v)$ is a unit vector,
# too, and every direction can be reached by some $v$. So a network that gives $v$ for a context gives a basis
# $Q(c)$, and however its weights are, the basis is orthonormal and turns no faster than the network does.


# %%
def basis(v):
    """The first column of H(v)."""
    v = v / np.linalg.norm(v)
    return np.eye(len(v))[:, 0] - 2 * v[0] * v


one, near = basis(np.array([1.0, 0.5, 0.2])), basis(np.array([1.0, 0.5, 0.25]))
print(np.linalg.norm(one), np.linalg.norm(one - near))

# %% [markdown]
# `nht.NHT` is that with $k$ reflections and a network; `train_map` minimises what the plane misses.

# %%
import nht

demos = nht.Demos.from_tensors(context={"joint_angle": contexts}, actuation=actuations, episode=episodes)
map = nht.NHT(context_dim=3, actuation_dim=3, action_dim=1, hidden=(64,))
metrics = nht.train_map(demos, map, context_keys=["joint_angle"], max_steps=1000).metrics
print(f"NHT misses {metrics['validation_error']:.2e} of the motion of episodes that it has not seen")

# %% [markdown]
# What the one action axis does along a demonstration: each joint's share changes, which no constant direction
# can do.

# %%
import torch

along = torch.tensor(contexts[:30], dtype=torch.float32)
columns = map.basis(along)[..., 0].detach()
columns = columns * torch.sign(columns[:1, :1])
for joint in range(3):
    (drawn,) = plt.plot(columns[:, joint], label=f"joint {joint + 1}")
    plt.axhline(line[joint] * np.sign(line[0]), color=drawn.get_color(), linestyle=":", linewidth=1)
plt.legend()
plt.xlabel("step of the demonstration")
plt.title("The basis: NHT (lines) and SVD (dotted)")
plt.show()

# %% [markdown]
# ## Driving
#
# Now somebody gives one number, and the arm keeps to its line. With SVD the tool leaves the height that it
# should keep.


# %%
def drive(velocity_of, steps=30):
    """The tool's path, (steps, 2), for the action that moves it to the right."""
    q, path = contexts[0].copy(), []
    for _ in range(steps):
        path.append(joints(q)[-1])
        velocity = velocity_of(q)
        velocity = velocity * np.sign((jacobian(q) @ velocity)[0])
        q = q + 0.04 * velocity * 0.5 / np.linalg.norm(jacobian(q) @ velocity)
    return np.array(path)


def learned(q):
    """NHT's joint velocities for the action 1."""
    return map(torch.ones(1), torch.tensor(q, dtype=torch.float32)).detach().numpy()


for name, path in (("NHT", drive(learned)), ("SVD", drive(lambda q: line))):
    height = path[:, 1]
    plt.plot(*path.T, label=f"{name}: leaves the line by {1000 * np.abs(height - height[0]).max():.0f} mm")
plt.legend()
plt.gca().set_aspect("equal")
plt.title("The tool's path")
plt.show()

# %% [markdown]
# That is all: a map that knows the posture turns one number into the motion that a task needs. [Compose with
# TorchRL](compose.md) puts it between a policy and an environment; [the mathematics](../how/mathematics.md)
# says what is proved.
