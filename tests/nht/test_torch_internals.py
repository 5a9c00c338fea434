"""The private parts of PyTorch still do what this package relies on."""

from pathlib import Path

import torch
from torch import Tensor, nn

from nht.torch_internals import write_machine_code


class Double(nn.Module):
    def forward(self, value: Tensor) -> Tensor:
        return 2 * value


def test_write_machine_code_gives_back_its_metadata(tmp_path: Path) -> None:
    path = tmp_path / "double.pt2"
    write_machine_code(torch.export.export(Double(), (torch.ones(3),)), path, {"map": "a description"})
    package = torch._inductor.aoti_load_package(str(path))
    assert package.get_metadata()["map"] == "a description"
    assert package(torch.ones(3)).tolist() == [2, 2, 2]
