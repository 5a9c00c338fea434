"""The processes of a run: one, or those that torchrun started, which learn the same weights together."""

from __future__ import annotations

import os
from collections.abc import Iterable

import torch
from torch import Tensor, distributed, nn
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

from nht.recipes.run.parent import end_with

PATIENCE = 60.0
"""Seconds that a rank has for a last checkpoint after torchrun has died."""


def usable_device(device: torch.device | str) -> torch.device:
    """The device of that name.

    Raises:
        ValueError: if there is no such device, or it is a GPU and PyTorch cannot use it.
    """
    try:
        found = torch.device(device)
    except RuntimeError as error:
        raise ValueError(f"device={device} is none that PyTorch knows: cpu, cuda or cuda:1.") from error
    if found.type == "cuda" and (found.index or 0) >= torch.cuda.device_count():
        raise ValueError(
            f"device={device} needs a GPU that PyTorch can use, and there is none: device=cpu."
            if not torch.cuda.is_available()
            else f"device={device} is not there: PyTorch sees {torch.cuda.device_count()} GPUs, counted from 0."
        )
    return found


class Ranks:
    """This process and its group: they average, add up and broadcast. For a single process all of that does nothing.

    All ranks must call every method, in the same order. When torchrun, which started them, is killed, they get SIGTERM,
    so that they are gone when a requeued job starts.

    Args:
        device: of the tensors; gloo connects CPUs, nccl GPUs.
        seed: of torch in all processes, so that they make the same networks.
        threads: number that torch may use in each process.
        tf32: whether a GPU may multiply float32 matrices in TF32.

    Attributes:
        rank: number of this process, 0 to ``size - 1``, on whatever machine it runs.
        size: number of processes.
        device: ``device``, on GPUs the one that belongs to this process.
    """

    def __init__(
        self,
        device: torch.device | str = "cpu",
        *,
        seed: int | None = None,
        threads: int | None = None,
        tf32: bool = False,
    ) -> None:
        if threads is not None:
            torch.set_num_threads(threads)
        if seed is not None:
            torch.manual_seed(seed)
        torch.backends.cuda.matmul.allow_tf32 = tf32
        self.device = usable_device(device)
        self.size = int(os.environ.get("WORLD_SIZE", "1"))
        self.rank = int(os.environ.get("RANK", "0")) if self.size > 1 else 0
        if self.size == 1:
            return
        end_with(os.getppid(), PATIENCE)
        if self.device.type == "cuda":
            self.device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
            torch.cuda.set_device(self.device)
        # torchrun keeps its store over a restart, and with it the addresses of processes that are gone.
        store, rank, size = next(rendezvous("env://"))
        attempt = PrefixStore(f"attempt-{self.restarts}", store)
        backend = "nccl" if self.device.type == "cuda" else "gloo"
        distributed.init_process_group(backend, store=attempt, rank=rank, world_size=size)

    @property
    def first(self) -> bool:
        """Whether this is the process that writes files, where only one may."""
        return self.rank == 0

    @property
    def folder(self) -> str:
        """Name of this process's own folder below one of the run; for a single process, that folder itself."""
        return f"rank-{self.rank}" if self.size > 1 else ""

    def part_ways(self, seed: int) -> None:
        """Let every process draw its own numbers from here on; the first, or a single one, goes on as it is."""
        if self.rank:
            torch.manual_seed(seed)

    @property
    def restarts(self) -> int:
        """How often torchrun has started the processes anew, after one of them had died."""
        return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))

    def share(self, name: str, number: int) -> int:
        """This process's equal share of a number.

        Raises:
            ValueError: if it cannot be divided.
        """
        if self.size == 1:
            return number
        if number % self.size:
            raise ValueError(
                f"{name}={number} must be a multiple of the {self.size} processes that share it."
            )
        return number // self.size

    def sum(self, values: Tensor) -> Tensor:
        """The sum of all processes' tensors of this shape."""
        if self.size == 1:
            return values
        total = values.detach().to(self.device, copy=True)
        distributed.all_reduce(total)
        return total.to(values.device)

    def any(self, flag: bool) -> bool:
        """Whether ``flag`` is true in any process."""
        return bool(self.sum(torch.tensor(float(flag))) > 0)

    def gather(self, value: list[int]) -> list[list[int]]:
        """The lists of all processes, by rank."""
        if self.size == 1:
            return [value]
        gathered: list[list[int]] = [[] for _ in range(self.size)]
        distributed.all_gather_object(gathered, value)
        return gathered

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace the gradients by their mean over all processes, in one flat all-reduce."""
        if self.size == 1:
            return
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        mean = self.sum(torch.cat([gradient.flatten() for gradient in gradients])).div_(self.size)
        for gradient, part in zip(gradients, mean.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(part.view_as(gradient))

    def broadcast(self, module: nn.Module) -> None:
        """Give all processes the parameters and buffers of the first one's module."""
        if self.size == 1:
            return
        for value in module.state_dict().values():
            distributed.broadcast(value, src=0)

    def wait(self) -> None:
        """Wait until all processes have called this."""
        if self.size > 1:
            distributed.barrier()

    def part(self) -> None:
        """Leave the group."""
        if self.size > 1 and distributed.is_initialized():
            distributed.destroy_process_group()
