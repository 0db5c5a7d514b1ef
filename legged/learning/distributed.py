"""What the processes of a training on several GPUs do together: begin, add up, agree, end."""

import os

import torch
import torch.distributed as dist
from torch import Tensor

from legged.errors import ConfigError
from legged.process.ranks import Ranks


class RankLost(Exception):
    """Another process of this training has ended."""


def check_reachable(ranks: Ranks) -> None:
    """Check that this process is told where it meets the others, if there are any.

    Raises:
        ConfigError: it is not; another program's WORLD_SIZE may be left in the environment.
    """
    missing = [name for name in ("MASTER_ADDR", "MASTER_PORT") if not os.environ.get(name)]
    if ranks.several and missing:
        raise ConfigError(
            f"WORLD_SIZE: the environment says that {ranks.count} processes train together, but not where they meet"
            f" ({', '.join(missing)}); torchrun sets both, and one process needs neither"
        )


def join(ranks: Ranks, device: torch.device) -> None:
    """Meet the other processes, once; with NCCL on GPUs, gloo without."""
    if dist.is_initialized():
        return
    check_reachable(ranks)
    if device.type == "cuda":
        torch.cuda.set_device(device)
        dist.init_process_group("nccl", rank=ranks.rank, world_size=ranks.count, device_id=device)
    else:
        dist.init_process_group("gloo", rank=ranks.rank, world_size=ranks.count)


def leave() -> None:
    """Wait until all are done, so that none is ended while another still saves."""
    if dist.is_initialized():
        dist.barrier()
        dist.destroy_process_group()


def sum_over_ranks_(tensor: Tensor) -> Tensor:
    """Add up `tensor` over all processes, in place; by itself it is its sum."""
    if dist.is_initialized():
        dist.all_reduce(tensor)
    return tensor


def any_rank(asked: bool, device: torch.device) -> bool:
    """Whether any process asks for something. All must call it; it waits for all of them."""
    if not dist.is_initialized():
        return asked
    return bool(sum_over_ranks_(torch.tensor(float(asked), device=device)).item())


class SharedGradients:
    """The gradients of all parameters side by side in one buffer, which is averaged over processes in one go, and at the
    end of it the numbers on which a step depends, such as the divergence from which the learning rate follows: so all
    processes take the same step, or none.
    """

    MOST_NUMBERS = 2

    def __init__(self, parameters: list[torch.nn.Parameter], count: int) -> None:
        """Make the parameters' gradients views of the buffer; there are `count` processes."""
        self._count = count
        sizes = [p.numel() for p in parameters]
        self._buffer = torch.zeros(sum(sizes) + self.MOST_NUMBERS, device=parameters[0].device)
        *pieces, self._numbers = self._buffer.split([*sizes, self.MOST_NUMBERS])
        for parameter, piece in zip(parameters, pieces, strict=True):
            parameter.grad = piece.view_as(parameter)

    def zero_(self) -> None:
        """Begin a mini-batch; what follows adds to the gradients in place."""
        self._buffer.zero_()

    def average_(self, *numbers: Tensor) -> None:
        """Make the mean over all processes of this one's gradients and `numbers` () each."""
        for place, number in zip(self._numbers, numbers, strict=False):
            place.copy_(number)
        sum_over_ranks_(self._buffer)
        self._buffer /= self._count
        for place, number in zip(self._numbers, numbers, strict=False):
            number.copy_(place)
