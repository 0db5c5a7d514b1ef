"""The control step as one CUDA graph, and the guard that keeps it capturable on machines without a GPU."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from legged.graph.guard import ForbidHostReads, ForbidReads, HostReadError, calling

__all__ = ["Branch", "ForbidHostReads", "ForbidReads", "HostReadError", "StepGraph", "calling"]


class Branch:
    """Work beside the main line of the step: on a GPU a second stream, in the captured graph a parallel branch.

    The step's small launches are bound by latency, so independent ones are free side by side. Tensors that both lines
    touch must be allocated before (a stream may reuse what another still reads), and `join` must come before the
    next physics step (the solver's conditional node cannot be captured while a branch is open).
    """

    def __init__(self, device: torch.device) -> None:
        """Make a branch on `device`; on the CPU everything runs in order."""
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None

    @contextmanager
    def fork(self) -> Iterator[None]:
        """Let the block run at the same time as what follows it, up to `join`."""
        if self._stream is None:
            yield
            return
        self._stream.wait_stream(torch.cuda.current_stream(self._stream.device))
        with torch.cuda.stream(self._stream):
            yield

    def join(self) -> None:
        """Let what follows wait for the block."""
        if self._stream is not None:
            torch.cuda.current_stream(self._stream.device).wait_stream(self._stream)


@contextmanager
def garbage_kept() -> Iterator[None]:
    """Let nothing in reference cycles be freed within the block. A task of before may have left its CUDA graph in one, and to
    free a graph is a call that CUDA forbids during a capture: the capture in progress would be lost.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


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
        """Check or capture `function`; with `enabled` false it runs eagerly and unchecked. Of a function that does the same
        many times, `rehearse` does it once: enough to warm up, and to check.

        Raises:
            TermError: a term of the task can't be captured.
            HostReadError: another part of the step can't.
        """
        self._function, self._rehearse, self._warm_up_steps = function, rehearse or function, warm_up_steps
        self._graph: torch.cuda.CUDAGraph | None = None
        # What does the same many times shows in one time all that it does; of a step, several are compared.
        self._checks = ForbidHostReads.STEPS if rehearse is None else 1
        self._guard = ForbidHostReads(device, getattr(function, "__self__", None))
        if not enabled:
            return
        try:
            if device.type != "cuda":
                self._check()
                return
            self._graph = self._capture(device)
        except Exception as error:
            error.add_note("The step must fit one CUDA graph; --no-graph (graph=False) runs it eagerly instead.")
            raise

    def _check(self) -> None:
        """Run under the guard, which says what is wrong, where a failed capture only says that something is."""
        for step in range(self._checks):
            # One step uses up random numbers, as any rehearsal does; those it is compared with leave the host's alone.
            with torch.random.fork_rng(devices=[], enabled=step > 0), self._guard:
                self._rehearse()

    def _capture(self, device: torch.device) -> "torch.cuda.CUDAGraph":
        import warp as wp

        wp.init()  # a step that launches nothing of Warp's may be the first to ask for it
        stream = torch.cuda.Stream(device)
        stream.wait_stream(torch.cuda.current_stream(device))
        # Warp looks up a device at its first use, and a stream when it first sees it: within a capture that would break it.
        with wp.ScopedStream(wp.stream_from_torch(stream), sync_enter=False):
            wp.zeros(1, dtype=float, device=wp.device_from_torch(device))
        with torch.cuda.stream(stream):
            for _ in range(self._warm_up_steps):
                self._rehearse()
            self._check()
        torch.cuda.current_stream(device).wait_stream(stream)
        torch.cuda.synchronize(device)
        graph = torch.cuda.CUDAGraph()
        # Of several processes each has a thread that looks after its collectives, and may ask CUDA about them meanwhile.
        error_mode = "thread_local" if torch.distributed.is_initialized() else "global"
        failure: Exception | None = None
        try:
            # Torch owns the capture; Warp is told of it, so that the solver's loop becomes a conditional node.
            with garbage_kept(), torch.cuda.graph(graph, stream=stream, capture_error_mode=error_mode):
                warp_stream = wp.stream_from_torch(torch.cuda.current_stream(device))
                with wp.ScopedStream(warp_stream, sync_enter=False), wp.ScopedCapture(stream=warp_stream, external=True):
                    try:
                        with self._guard.recording():
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
