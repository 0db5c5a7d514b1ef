"""Parallel compilation of a model's Warp kernels before their first launch, if the cache lacks them.

By itself, Warp compiles a module when one of its kernels is first launched, so modules are compiled one after the other. Here
a dry run records launches instead of making them, which yields the modules that a model needs. Forked processes then compile
the missing modules into Warp's cache. Threads would not help: within one process NVRTC compiles one program at a time. A lock
lets one process compile while others, such as further ranks of a multi-GPU training, wait for its results.

All this only saves time. If a module is still missing when one of its kernels is launched, Warp compiles it then.
"""

import gc
import math
import os
import struct
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import warp as wp
from filelock import lock_descriptor, unlock_descriptor

POLL_S = 0.1
PLAIN_LINES_EVERY_S = 5.0
STALLED_S = 300.0
"""The forked processes are ended if none of them finishes a module for this time [s]."""
MOST_PROCESSES = 16
TILED_COSTS = 20
"""Number of ordinary kernels that take as long to compile as a tiled kernel, which may need CUDA's linear algebra."""
CUDA_BLOCK_DIM, CPU_BLOCK_DIM = 256, 1
"""Numbers of threads per block that Warp uses by default. Warp compiles a module separately for each block size."""


def cache_folder() -> Path:
    """Return the folder in which this version of Warp keeps compiled kernels."""
    return Path(wp.config.kernel_cache_dir)


@dataclass(frozen=True)
class Build:
    """A Warp module for one block size: the unit of compilation."""

    module: Any
    block_dim: int

    def cached(self, device: Any) -> bool:
        """Return True if Warp's cache holds the module for the device's architecture."""
        folder = cache_folder() / self.module.get_module_identifier(self.block_dim)
        pattern = "*.o" if device.is_cpu else f"*.sm{device.get_cuda_compile_arch()}*"
        return any(folder.glob(pattern))

    def compile(self, device: Any) -> None:
        """Compile the module into the cache. `wp.load_module` would also load it, which a forked process must not do."""
        self.module._compile(device, options=self.module.resolve_options(wp.config, block_dim=self.block_dim))


def compile_ahead(device: Any, functions: Iterable[Callable[[], object]]) -> int:
    """Compile those modules that `functions` launch on a Warp device and that are not in the cache. Return their number.

    The functions are called without launching kernels, so the arrays that they read hold meaningless numbers.
    """
    missing = [build for build in launched(device, functions) if not build.cached(device)]
    if not missing or sys.platform != "linux":  # forking is safe on Linux only
        return 0
    total = len(missing)
    with Line(total) as line, _Lock(cache_folder()) as lock:
        while missing:
            if lock.acquire():
                _compile_all(missing, device, partial(line.show, total - len(missing)))
                break
            time.sleep(POLL_S)
            missing = [build for build in missing if not build.cached(device)]
            line.show(total - len(missing))
        compiled = total - sum(not build.cached(device) for build in missing)
        line.end(compiled)
    return compiled


def launched(device: Any, functions: Iterable[Callable[[], object]]) -> list[Build]:
    """Return the modules that `functions` launch on a device. The slowest to compile come first."""
    found: dict[Build, int] = {}

    def note(kernel: Any, dim: Any = 0, *_: Any, block_dim: int | None = None, tiled: bool = False, **__: Any) -> None:
        if kernel.is_generic or math.prod(dim if isinstance(dim, list | tuple) else (dim,)) == 0:
            return  # a generic kernel is compiled for the types of its arguments, which are not known here
        size = CPU_BLOCK_DIM if device.is_cpu else block_dim or CUDA_BLOCK_DIM
        found[Build(kernel.module, size)] = TILED_COSTS * tiled + len(kernel.module.kernels)

    def once(condition: Any, while_body: Callable[..., None], stream: Any = None, **arguments: Any) -> None:
        while_body(**arguments)

    def both(condition: Any, on_true: Any = None, on_false: Any = None, stream: Any = None, **arguments: Any) -> None:
        for branch in filter(None, (on_true, on_false)):
            branch(**arguments)

    with (
        wp.ScopedDevice(device),
        _instead(launch=note, launch_tiled=partial(note, tiled=True), capture_while=once, capture_if=both),
    ):
        for function in functions:
            function()
    return sorted(found, key=lambda build: -found[build])


@contextmanager
def _instead(**functions: Callable[..., None]) -> Iterator[None]:
    """Replace functions of Warp within the block."""
    before = {name: getattr(wp, name) for name in functions}
    for name, function in functions.items():
        setattr(wp, name, function)
    try:
        yield
    finally:
        for name, function in before.items():
            setattr(wp, name, function)


def _compile_all(builds: list[Build], device: Any, show: Callable[[int], None]) -> None:
    """Compile in forked processes, which take modules from a pipe. Show progress. Return when all processes have ended."""
    work, give = os.pipe()
    os.write(give, b"".join(struct.pack("=H", i) for i in range(len(builds))))
    os.close(give)
    with tempfile.TemporaryDirectory(prefix="legged_") as scratch:
        count = min(len(os.sched_getaffinity(0)), len(builds), MOST_PROCESSES)
        running = {_fork(work, builds, device, scratch) for _ in range(count)}
        os.close(work)
        done, since = 0, time.monotonic()
        try:
            while running:
                time.sleep(POLL_S)
                running -= {child for child in running if os.waitpid(child, os.WNOHANG)[0]}
                finished = sum(build.cached(device) for build in builds)
                if finished > done:
                    done, since = finished, time.monotonic()
                elif time.monotonic() - since > STALLED_S:
                    break
                show(done)
        finally:
            for child in running:
                os.kill(child, 9)
                os.waitpid(child, 0)


def _fork(work: int, builds: list[Build], device: Any, scratch: str) -> int:
    """Fork a process that compiles the modules whose indices it reads from `work`, and return its id."""
    parent = os.getpid()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python warns about threads; the child uses neither threads nor their locks
        child = os.fork()
    if child:
        return child
    try:
        # The child must not collect the parent's garbage. Objects with threads of their own, such as onnxruntime's sessions,
        # would wait for ever for threads that a fork does not copy.
        gc.disable()
        tempfile.tempdir = scratch
        while (item := os.read(work, 2)) and os.getppid() == parent:
            builds[struct.unpack("=H", item)[0]].compile(device)
    finally:
        os._exit(0)  # skip the parent's clean-up. Warp itself compiles the module again later, and reports any error.


class _Lock:
    """File lock. Only the process that holds it compiles into the cache."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = open(folder / "legged.lock", "w")  # noqa: SIM115 (closed by __exit__)

    def __enter__(self) -> "_Lock":
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            unlock_descriptor(self._file.fileno())  # `close` alone would not release the lock while a child has the file open
        self._file.close()

    def acquire(self) -> bool:
        """Take the lock if it is free, without waiting. Return True if this process has it."""
        try:
            return lock_descriptor(self._file.fileno(), blocking=False)
        except OSError:  # the file system has no locks, and compiling twice does no harm
            return True


class Line:
    """Progress on one line of a terminal. Without a terminal, a new line is printed every few seconds."""

    def __init__(self, total: int) -> None:
        self._total, self._start, self._shown = total, time.monotonic(), -math.inf
        self._terminal = sys.stdout.isatty()

    def __enter__(self) -> "Line":
        self.show(0)
        return self

    def __exit__(self, *_: object) -> None:
        if self._terminal:
            print(flush=True)

    def show(self, before: int, more: int = 0) -> None:
        """Show the progress after `before + more` compiled modules."""
        now = time.monotonic()
        if self._terminal or now - self._shown >= PLAIN_LINES_EVERY_S:
            self._shown = now
            self._print(f"compiling {min(before + more + 1, self._total)} of {self._total} kernel modules ...")

    def end(self, done: int) -> None:
        """Show that `done` modules were compiled. Warp compiles the others at their launch, and reports their errors."""
        rest = "" if done == self._total else f"; the other {self._total - done} are compiled when they are launched"
        self._print(f"compiled {done} kernel modules in {time.monotonic() - self._start:.1f} s{rest}")

    def _print(self, text: str) -> None:
        if self._terminal:
            print(f"\r\x1b[2K{text}", end="", flush=True)
        else:
            print(text, flush=True)
