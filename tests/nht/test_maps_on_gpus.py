"""What maps compute stays where it is: nothing is fetched to the CPU, nothing depends on a tensor's values."""

import pytest
import torch
from tensordict import TensorDict

import nht
from nht.map_classes import OUR_CLASSES
from no_sync import Waits

CONTEXT, MOTORS, K, BATCH = 4, 7, 2, 5


def chain():
    """An arm of seven joints."""
    return nht.JacobianPinv([0.3] * 7, [0.5, -0.5] * 3 + [0.5], [0.0] * 7)


MAPS = {
    "NHT": lambda: nht.NHT(CONTEXT, MOTORS, K, hidden=(8,)),
    "NHT, limited": lambda: nht.NHT(CONTEXT, MOTORS, K, hidden=(8,), lipschitz=2.0, offset="contextual"),
    "NHT, heads": lambda: nht.NHT(CONTEXT, MOTORS, K, hidden=(8,), multi_head=True, offset="constant"),
    "SVD": lambda: nht.SVD(MOTORS, K, CONTEXT, offset="contextual"),
    "SCL": lambda: nht.SCL(CONTEXT, MOTORS, K, hidden=(8,)),
    "Identity": lambda: nht.Identity(MOTORS, CONTEXT),
    "CAE": lambda: nht.CAE(CONTEXT, MOTORS, K, hidden=(8,)),
    "LASER": lambda: nht.LASER(CONTEXT, MOTORS, K, hidden=(8,)),
    "JacobianPinv": chain,
    "Aligned": lambda: nht.Aligned(
        nht.NHT(CONTEXT, MOTORS, K, hidden=(8,)), torch.tensor([[0.0, 1.0], [-1.0, 0.0]])
    ),
    "Residual": lambda: nht.Residual(nht.NHT(CONTEXT, MOTORS, K, hidden=(8,)), 0.1),
}


def test_every_map_is_here():
    assert {type(make()) for make in MAPS.values()} == set(OUR_CLASSES.values())


@pytest.fixture(params=["scale", "clip"])
def saturation(request):
    return request.param


@pytest.fixture(params=MAPS)
def map(request, saturation):
    made = MAPS[request.param]()
    made.saturation = saturation
    return made.eval()


def inputs(map, device):
    sizes = {"action": map.action_dim, "context": map.context_dim, "actuation": map.actuation_dim}
    data = {name: torch.rand(BATCH, size, device=device) for name, size in sizes.items()}
    limit = torch.ones(map.actuation_dim, device=device)
    return data, -limit, limit


def all_ways(map, device):
    """Everything that a map is asked for, in training and in use."""
    data, low, high = inputs(map, device)
    batch = TensorDict(data | {"next": {"context": data["context"]}}, BATCH)
    return {
        "forward": map(data["action"], data["context"]),
        "project": map.project(data["actuation"], data["context"]),
        "decode": map.decode(data["action"], data["context"], low, high),
        "free": map.decode(data["action"], data["context"]),
        "encode": map.encode(data["actuation"], data["context"]),
        "loss": map.loss(batch) if map.learns else torch.zeros((), device=device),
    }


def test_a_map_computes_on_a_device_that_has_no_values(map):
    expected = {name: value.shape for name, value in all_ways(map, "cpu").items()}
    found = all_ways(map.to("meta"), "meta")
    assert {value.device.type for value in found.values()} == {"meta"}
    assert {name: value.shape for name, value in found.items()} == expected


def test_a_map_makes_nobody_wait(map):
    all_ways(map, "cpu")  # what is made once is made
    with Waits() as waits:
        all_ways(map, "cpu")
    assert waits.found == []
    with Waits() as waits:
        bool(torch.ones(3).sum() > 2)
        torch.ones(2).tolist(), torch.ones(2).numpy()
        torch.ones(3)[torch.ones(3) > 0]
    assert len(waits.found) >= 4  # and it would be noticed
