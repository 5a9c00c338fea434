"""Small sessions to steer: interfaces that take no time to train, and how to open them."""

import torch

import nht
from nht.recipes.config import Steer
from nht.recipes.launch import configure
from nht.recipes.live.opening import open_session

KEYS = ("tool_position", "joint_angle")


def random_map(kind=nht.NHT, seed=0, **arguments):
    """A map of WAMWipe as training leaves it, but that it has learned nothing."""
    generator = torch.Generator().manual_seed(seed)
    if kind is nht.SVD:
        map = nht.SVD(7, 2, context_dim=10)
        map.fit({"actuation": torch.randn(50, 7, generator=generator), "context": torch.zeros(50, 10)})
    else:
        map = kind(10, 7, 2, (8,), seed=seed, **arguments)
    map.context_keys = KEYS
    map.set_action_scale(0.7)
    return map.eval()


def map_file(folder, name="nht", **arguments):
    """The file of such a map."""
    path = folder / f"{name}.safetensors"
    nht.save_map(random_map(**arguments), path)
    return path


def config(*words):
    return configure(Steer, "steer", list(words))


def session(*words):
    return open_session(config(*words)).session


def moves(session, action, steps):
    """Ask for an action, and let some steps pass."""
    session.commands.ask(action)
    for _ in range(steps):
        session.step()
