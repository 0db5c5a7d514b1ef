"""The control step as one CUDA graph, and the guard that keeps it capturable on machines without a GPU."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from legged.errors import TermError


@contextmanager
def calling(term: str) -> Iterator[None]:
    """Name `term` in the error if the block fails, also while a graph is being captured."""
    try:
        yield
    except TermError:
        raise
    except Exception as error:
        text = str(error).splitlines()
        raise TermError(f"{term}: {text[0] if text else type(error).__name__}") from error


class HostReadError(RuntimeError):
    """Code of the step wants a tensor's value on the host."""


class ForbidHostReads(TorchDispatchMode):
    """Refuses what would make a GPU wait for the host, or what no graph can hold: `.item()`, `if tensor`, `nonzero`,
    indexing by a mask.
    """

    READS = {
        torch.ops.aten._local_scalar_dense.default: "reads a value on the host (.item(), float(tensor), if tensor)",
        torch.ops.aten.nonzero.default: "has a result of unknown size (nonzero, where with one argument)",
        torch.ops.aten.masked_select.default: "has a result of unknown size (masked_select)",
        torch.ops.aten._unique2.default: "has a result of unknown size (unique)",
        torch.ops.aten.bincount.default: "has a result of unknown size (bincount)",
        torch.ops.aten.repeat_interleave.Tensor: "has a result of unknown size (repeat_interleave by a tensor)",
        torch.ops.aten.equal.default: "reads a value on the host (torch.equal)",
    }

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        with self:  # in inference mode composite operators (item, one-argument where) arrive whole: take them apart
            result = func.decompose(*args, **(kwargs or {}))
        if result is not NotImplemented:
            return result
        reason = self.READS.get(func)
        indexing = func in (torch.ops.aten.index.Tensor, torch.ops.aten.index_put_.default, torch.ops.aten.index_put.default)
        if indexing and any(i is not None and i.dtype in (torch.bool, torch.uint8) for i in args[1]):
            reason = "indexes by a mask, whose size is unknown; use torch.where or masked_fill"
        if reason:
            raise HostReadError(f"{reason}, which a CUDA graph cannot hold")
        return func(*args, **(kwargs or {}))


class Branch:
    """Work beside the main line of the step: on a GPU a second stream, in the captured graph a parallel branch.

    The step's small launches are bound by latency, so independent ones are free side by side. Tensors that both lines
    touch must be allocated before (a stream may reuse what another still reads), and `join` must come before the
    next physics step (the solver's conditional node cannot be captured while a branch is open).
    """

    def __init__(self, device: torch.device) -> None:
        """On the CPU everything runs in order."""
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None

    @contextmanager
    def fork(self) -> Iterator[None]:
        """The block may run at the same time as what follows it, up to `join`."""
        if self._stream is None:
            yield
            return
        self._stream.wait_stream(torch.cuda.current_stream(self._stream.device))
        with torch.cuda.stream(self._stream):
            yield

    def join(self) -> None:
        """What follows waits for the block."""
        if self._stream is not None:
            torch.cuda.current_stream(self._stream.device).wait_stream(self._stream)


class StepGraph:
    """Runs a step function: eagerly on the CPU, by replaying one captured CUDA graph on a GPU.

    The function must only touch tensors of fixed address. The constructor calls it a few times (this compiles kernels
    and checks that it can be captured), so the caller resets its state afterwards.
    """

    WARM_UP_STEPS = 3

    def __init__(
        self,
        function: Callable[[], None],
        device: torch.device,
        enabled: bool,
        warm_up_steps: int = WARM_UP_STEPS,
        rehearse: Callable[[], None] | None = None,
    ) -> None:
        """With `enabled` false the function runs eagerly and unchecked. Of a function that does the same many times,
        `rehearse` does it once: enough to warm up, and to check.

        Raises:
            TermError: a term of the task can't be captured.
            HostReadError: another part of the step can't.
        """
        self._function, self._rehearse, self._warm_up_steps = function, rehearse or function, warm_up_steps
        self._graph: torch.cuda.CUDAGraph | None = None
        if not enabled:
            return
        try:
            if device.type != "cuda":
                with ForbidHostReads():
                    self._rehearse()
                return
            self._graph = self._capture(device)
        except Exception as error:
            error.add_note("The step must fit one CUDA graph; --no-graph (graph=False) runs it eagerly instead.")
            raise

    def _capture(self, device: torch.device) -> "torch.cuda.CUDAGraph":
        import warp as wp

        stream = torch.cuda.Stream(device)
        stream.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(stream):
            for _ in range(self._warm_up_steps):
                self._rehearse()
            with ForbidHostReads():  # says what is wrong, where a failed capture only says that something is
                self._rehearse()
        torch.cuda.current_stream(device).wait_stream(stream)
        torch.cuda.synchronize(device)
        graph = torch.cuda.CUDAGraph()
        # Of several processes each has a thread that looks after its collectives, and may ask CUDA about them meanwhile.
        error_mode = "thread_local" if torch.distributed.is_initialized() else "global"
        failure: Exception | None = None
        try:
            # Torch owns the capture; Warp is told of it, so that the solver's loop becomes a conditional node.
            with torch.cuda.graph(graph, stream=stream, capture_error_mode=error_mode):
                warp_stream = wp.stream_from_torch(torch.cuda.current_stream(device))
                with wp.ScopedStream(warp_stream, sync_enter=False), wp.ScopedCapture(stream=warp_stream, external=True):
                    try:
                        self._function()
                    except Exception as error:
                        failure = error
                        raise
        except Exception as error:
            failure = failure or error  # ending a broken capture fails too, with an error that says nothing of the cause
        if failure is not None:
            raise failure
        return graph

    @property
    def captured(self) -> bool:
        """Whether a CUDA graph is replayed."""
        return self._graph is not None

    def __call__(self) -> None:
        if self._graph is not None:
            self._graph.replay()
        else:
            self._function()
