"""Communication between the processes of a training on several GPUs."""

import os
import sys
import threading
from collections.abc import Iterable

import torch
import torch.distributed as dist
from torch import Tensor

from legged.errors import ConfigError, RunError
from legged.process.ranks import Ranks

PATIENCE_S = 10.0
"""Time after which a process says that it waits for the others [s]."""


class RankLost(Exception):
    """Another process of this training has ended."""


def check_reachable(ranks: Ranks) -> None:
    """Check that environment variables give the address at which processes meet, if there are several processes.

    Raises:
        ConfigError: the address is missing, although WORLD_SIZE says that there are several processes.
    """
    missing = [name for name in ("MASTER_ADDR", "MASTER_PORT") if not os.environ.get(name)]
    if ranks.several and missing:
        raise ConfigError(
            f"WORLD_SIZE: the variable says that {ranks.count} processes train together, but there is no value for"
            f" {' and '.join(missing)}; start with torchrun, or unset WORLD_SIZE to train with one process"
        )


def join(ranks: Ranks, device: torch.device) -> None:
    """Join the process group, with NCCL on GPUs and gloo on the CPU. Do nothing if the process has already joined. A process
    that waits for others says so.

    Raises:
        ConfigError: as for `check_reachable`.
        RunError: the other processes do not come.
    """
    if dist.is_initialized():
        return
    check_reachable(ranks)
    where = f"rank {ranks.rank} at {os.environ['MASTER_ADDR']}:{os.environ['MASTER_PORT']}"
    text = f"{where}: waiting for the others of {ranks.count} processes"
    waiting = threading.Timer(PATIENCE_S, print, [text], {"file": sys.stderr, "flush": True})
    waiting.daemon = True
    waiting.start()
    try:
        if device.type == "cuda":
            torch.cuda.set_device(device)
            dist.init_process_group(  # gloo carries what the processes agree on, and does not wait for the GPU
                "cpu:gloo,cuda:nccl", rank=ranks.rank, world_size=ranks.count, device_id=device
            )
        else:
            dist.init_process_group("gloo", rank=ranks.rank, world_size=ranks.count)
    except dist.DistError as error:
        reason = str(error).splitlines()[0]
        raise RunError(f"{where}: the {ranks.count} processes did not meet; start all of them ({reason})") from error
    finally:
        waiting.cancel()


def leave() -> None:
    """Wait for all processes, so that no process ends while another still saves. Then leave the process group."""
    if dist.is_initialized():
        dist.barrier()
        dist.destroy_process_group()


def sum_over_ranks_(tensor: Tensor) -> Tensor:
    """Sum `tensor` over all processes in place and return it. A single process returns it unchanged."""
    if dist.is_initialized():
        dist.all_reduce(tensor)
    return tensor


def copy_from_first_(tensors: Iterable[Tensor]) -> None:
    """Overwrite tensors, contiguous or not, with those of the first process."""
    for tensor in tensors:
        whole = tensor.contiguous()  # a process group takes no other
        dist.broadcast(whole, src=0)
        tensor.copy_(whole)


def any_rank(*asked: bool) -> list[bool]:
    """Return for each of `asked` whether it is true in any process. All processes must call this function, because each waits
    for the others.
    """
    return (sum_over_ranks_(torch.tensor(asked, dtype=torch.float32)) > 0.0).tolist()


class SharedGradients:
    """Buffer that holds the gradients of all parameters, so that one operation averages them over all processes.

    The end of the buffer holds further numbers on which a gradient step depends, such as the divergence that sets the
    learning rate. They are averaged too, so all processes take the same step, or all skip it.
    """

    MOST_NUMBERS = 2

    def __init__(self, parameters: list[torch.nn.Parameter], count: int) -> None:
        """Allocate the buffer. Each parameter's gradient becomes a view of it. `count` is the number of processes."""
        self._count = count
        sizes = [p.numel() for p in parameters]
        self._buffer = torch.zeros(sum(sizes) + self.MOST_NUMBERS, device=parameters[0].device)
        *pieces, self._numbers = self._buffer.split([*sizes, self.MOST_NUMBERS])
        for parameter, piece in zip(parameters, pieces, strict=True):
            parameter.grad = piece.view_as(parameter)

    def zero_(self) -> None:
        """Set all gradients to 0. The next backward pass adds to them in place."""
        self._buffer.zero_()

    def average_(self, *numbers: Tensor) -> None:
        """Replace the gradients and the `numbers` () by their means over all processes."""
        for place, number in zip(self._numbers, numbers, strict=False):
            place.copy_(number)
        sum_over_ranks_(self._buffer)
        self._buffer /= self._count
        for place, number in zip(self._numbers, numbers, strict=False):
            number.copy_(place)
