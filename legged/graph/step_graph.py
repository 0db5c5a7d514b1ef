"""The control step as one CUDA graph. A guard checks on any machine whether the step can be captured."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from legged.graph.guard import ForbidHostReads, ForbidReads, HostReadError, calling

__all__ = ["Branch", "ForbidHostReads", "ForbidReads", "HostReadError", "StepGraph", "calling"]


class Branch:
    """Part of the step that runs in parallel to the rest: in a second stream on a GPU, in a branch of a captured CUDA graph.

    The step's small kernels are bound by latency, so kernels in a parallel branch cost nothing. Tensors that both streams use
    must be allocated before `fork`, because one stream may reuse memory that the other still reads. Call `join` before the
    next physics step, because the solver's conditional node cannot be captured while a branch is open.
    """

    def __init__(self, device: torch.device) -> None:
        """Make a branch on `device`; on the CPU everything runs in order."""
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None

    @contextmanager
    def fork(self) -> Iterator[None]:
        """Run the block in parallel to the code after it, up to `join`."""
        if self._stream is None:
            yield
            return
        self._stream.wait_stream(torch.cuda.current_stream(self._stream.device))
        with torch.cuda.stream(self._stream):
            yield

    def join(self) -> None:
        """Make the code after this call wait for the block of `fork`."""
        if self._stream is not None:
            torch.cuda.current_stream(self._stream.device).wait_stream(self._stream)


@contextmanager
def garbage_kept() -> Iterator[None]:
    """Switch off garbage collection in the block.

    A reference cycle may hold the CUDA graph of an earlier task. If garbage collection freed this graph during a capture, the
    capture would fail.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


class StepGraph:
    """Runner of a step function: eagerly on the CPU, by replays of a captured CUDA graph on a GPU.

    The function may only use tensors with fixed addresses. The constructor calls it a few times, to compile kernels and to
    check that it can be captured. The caller resets the task's state afterwards.
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
        """Check `function` on the CPU, or capture it on a GPU. With `enabled` false the function runs eagerly and unchecked.
        If the function repeats the same work many times, `rehearse` does this work once, for the warm-up and the check.

        Raises:
            TermError: a term of the task can't be captured.
            HostReadError: another part of the step can't be captured.
        """
        self._function, self._rehearse, self._warm_up_steps = function, rehearse or function, warm_up_steps
        self._graph: torch.cuda.CUDAGraph | None = None
        # With `rehearse` one run is checked. Without it, the guard compares later runs with the run before them.
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
        """Run the step under the guard. The guard's errors name their cause, unlike the error of a failed capture."""
        for step in range(self._checks):
            # The first run advances the host's random generator, as any rehearsal does. The other runs only serve the
            # comparison, so the generator is restored after them.
            with torch.random.fork_rng(devices=[], enabled=step > 0), self._guard:
                self._rehearse()

    def _capture(self, device: torch.device) -> "torch.cuda.CUDAGraph":
        import warp as wp

        wp.init()  # a step without Warp kernels has not initialised Warp yet
        stream = torch.cuda.Stream(device)
        stream.wait_stream(torch.cuda.current_stream(device))
        # Warp looks up a device and a stream when they are first used. During a capture these look-ups would fail.
        with wp.ScopedStream(wp.stream_from_torch(stream), sync_enter=False):
            wp.zeros(1, dtype=float, device=wp.device_from_torch(device))
        with torch.cuda.stream(stream):
            for _ in range(self._warm_up_steps):
                self._rehearse()
            self._check()
        torch.cuda.current_stream(device).wait_stream(stream)
        torch.cuda.synchronize(device)
        graph = torch.cuda.CUDAGraph()
        # With several processes, torch's thread for collective operations may call CUDA during the capture.
        error_mode = "thread_local" if torch.distributed.is_initialized() else "global"
        failure: Exception | None = None
        try:
            # Torch makes the capture. Warp has to know of it, so that the solver's loop becomes a conditional node.
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
            failure = failure or error  # ending a broken capture raises another error, which hides the cause
        if failure is not None:
            raise failure
        return graph

    @property
    def captured(self) -> bool:
        """True if a CUDA graph is replayed."""
        return self._graph is not None

    def __call__(self) -> None:
        if self._graph is not None:
            self._graph.replay()
        else:
            self._function()
