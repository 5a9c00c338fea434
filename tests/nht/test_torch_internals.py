"""The private parts of PyTorch still do what this package relies on."""

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from nht.torch_internals import adam_step, write_machine_code


class Double(nn.Module):
    def forward(self, value: Tensor) -> Tensor:
        return 2 * value


@pytest.mark.slow  # compiles
def test_write_machine_code_gives_back_its_metadata(tmp_path: Path) -> None:
    path = tmp_path / "double.pt2"
    write_machine_code(torch.export.export(Double(), (torch.ones(3),)), path, {"map": "a description"})
    package = torch._inductor.aoti_load_package(str(path))
    assert package.get_metadata()["map"] == "a description"
    assert package(torch.ones(3)).tolist() == [2, 2, 2]


def test_adam_step_is_that_of_the_optimiser() -> None:
    generator = torch.Generator().manual_seed(0)
    drawn = [torch.randn(shape, generator=generator) for shape in ((5, 3), (7,), ())]
    own, expected = [value.clone() for value in drawn], [nn.Parameter(value.clone()) for value in drawn]
    means, squares = ([torch.zeros_like(value) for value in own] for _ in range(2))
    optimiser = torch.optim.Adam(expected, fused=True)
    for step in range(1, 6):
        gradients = [torch.randn(value.shape, generator=generator) for value in own]
        for parameter, gradient in zip(expected, gradients, strict=True):
            parameter.grad = gradient.clone()
        optimiser.param_groups[0]["lr"] = 0.1 / step
        optimiser.step()
        adam_step(own, gradients, means, squares, torch.tensor(float(step)), 0.1 / step)
        assert all(torch.equal(one, other) for one, other in zip(own, expected, strict=True))
