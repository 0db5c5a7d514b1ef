"""Guard that finds, on any machine, the code that a CUDA graph can't hold: host reads, host data, and changing Python
state.
"""

import inspect
import re
import sys
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from traceback import walk_tb
from typing import Any

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.overrides import TorchFunctionMode, _get_current_function_mode_stack
from torch.utils._device import DeviceContext, _device_constructors
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from legged.errors import HostReadError, TermError
from legged.graph.constants import Constants, holds_tensors, key_of
from legged.graph.python_state import attributes, random_states, shown

__all__ = ["ForbidHostReads", "ForbidReads", "HostReadError", "calling"]

aten = torch.ops.aten
ON_THE_DEVICE = "pass device=self.device"
NEXT_TO = ("torch", "numpy", "warp", "contextlib")
"""Modules that `caller` skips, because they only pass calls on."""


_active: "ForbidHostReads | None" = None


@contextmanager
def calling(term: str) -> Iterator[None]:
    """Run the block as the term `term`. An error in the block names the term, also during a capture. While the guard is
    active, check that the term leaves the Python state unchanged.
    """
    try:
        with _active.inside(term) if _active is not None else nullcontext():
            yield
    except TermError:
        raise
    except Exception as error:
        text = str(error).splitlines()
        raise TermError(f"{term}: {text[0] if text else type(error).__name__}{_hint(error)}") from error


HINTS: dict[str, str] = {}
"""Pattern of an expression that fails in a term -> what to write instead. Modules of tasks add entries."""


def _hint(error: Exception) -> str:
    """Return the end of the message of an error in a function that has an expression of HINTS, else nothing."""
    for frame, _ in walk_tb(error.__traceback__ if isinstance(error, AttributeError | IndexError | NameError) else None):
        with suppress(OSError):  # Python does not know the source
            source = inspect.getsource(frame)
            if found := [hint for pattern, hint in HINTS.items() if re.search(pattern, source)]:
                return f"; {'; '.join(found)}"
    return ""


class ForbidHostReads:
    """Guard that refuses, in its block, operations that a graph can't hold or that synchronise a GPU with the host:
    `.item()`, `if tensor`, `nonzero`, indexing by a mask, copies to and from the host, tensors made without a device, and
    random numbers of the host.

    If the same step runs several times, the guard also compares each run from the third on with the run before it. The
    attributes of `owner` other than tensors must not change. The numbers passed to torch must be the same. The step must not
    read a tensor that the previous step allocated, because a graph goes on reading the memory of its capture. But it may keep
    a tensor as an attribute and read it later in the same step, or outside the step. The first two runs may set up
    attributes.

    The physics engines of this package are exempt. Engines on the host work on numpy arrays, but are never captured.
    """

    STEPS = 3
    """Number of runs after which every check has been made."""

    def __init__(self, device: torch.device | None = None, owner: Any = None) -> None:
        """Guard a step of the task `owner` on `device`, by default the CPU."""
        self.device = device or torch.device("cpu")
        self.owner = owner
        self.constants = Constants()
        self._operators, self._calls = _Operators(self), _Calls(self)
        self._steps = 0
        self._place = ""
        self._made: set[int] = set()
        self._record: list[Seen] = []
        self._record_before: list[Seen] = []
        self._state: dict[str, Any] = {}

    @property
    def compares(self) -> bool:
        """True if this step is compared with the previous one."""
        return self._steps >= self.STEPS

    def __enter__(self) -> "ForbidHostReads":
        global _active
        self._steps += 1
        self.constants.complete = self.compares
        self._made = set()
        self._record_before, self._record = self._record, []
        self._state = self._python_state()
        self._operators.__enter__()
        self._calls.__enter__()
        _active = self
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        global _active
        _active = None
        self._calls.__exit__(kind, error, trace)
        self._operators.__exit__(kind, error, trace)
        if kind is None:
            self._judge_state(self._state)
            if self.compares and len(self._record) != len(self._record_before):
                raise HostReadError("the step makes fewer calls than the previous one; a CUDA graph repeats every call")

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Refuse new constants in the block. The block captures a graph, and all constants exist already."""
        self.constants.complete = True
        with self._calls:
            yield

    @contextmanager
    def inside(self, term: str) -> Iterator[None]:
        """Run the block as the term `term` of the task."""
        before, self._place = self._python_state(), term
        try:
            yield
            self._judge_state(before)
        finally:
            self._place = ""

    def refuse(self, reason: str) -> None:
        """Raise an error, unless a physics engine of this package makes the call.

        Raises:
            HostReadError: the text begins with `reason`.
        """
        if not self.constants.making and not caller().startswith("legged.physics"):
            raise HostReadError(f"{reason}. A CUDA graph cannot hold this call")

    def _python_state(self) -> dict[str, Any]:
        return {"random": random_states(), "attributes": attributes(self.owner) if self.compares else {}}

    def _judge_state(self, before: dict[str, Any]) -> None:
        now = self._python_state()
        for name, state in before["random"].items():
            if now["random"][name] != state:
                raise HostReadError(
                    f"draws from {name}: a CUDA graph would repeat that number for ever; draw on the device with"
                    " torch.rand(..., device=self.device)"
                )
        for name, state in before["attributes"].items():
            found = now["attributes"].get(name)
            if found != state:
                raise HostReadError(
                    f"self.{name} changed from {shown(state)} to {shown(found)}: a CUDA graph repeats the recorded value;"
                    " keep it in a tensor, and write the tensor in place"
                )

    # ---- calls by _Operators ---------------------------------------------------------------------------------------------

    def run(self, func: Any, args: Any, kwargs: Any) -> Any:
        """Run one operator, and compare it with the operator in the same place of the previous step."""
        inputs = [value for value in tree_leaves((args, kwargs)) if value is not None]
        over = overwritten(func, args, kwargs)
        read = [value for value in inputs if all(value is not other for other in over)]
        from_host = func is aten.lift_fresh.default
        if not self.constants.making and not caller().startswith("legged.physics"):
            numbers = [repr(value) for value in inputs if not isinstance(value, Tensor | torch.UntypedStorage)]
            if from_host and inputs[0].dim() == 0:
                numbers.append(repr(inputs[0].item()))
            kept = {m: v for v in (() if from_host else read) if (m := memory_of(v)) is not None and m not in self._made}
            name = str(func).removeprefix("aten.").rpartition(".")[0]
            seen = Seen(f"{name}({', '.join(numbers)})", {m: StorageWeakRef(v.untyped_storage()) for m, v in kept.items()})
            if self.compares:
                self._judge(seen, kept)
            self._record.append(seen)
        result = func(*args, **kwargs)
        given = set() if from_host else {memory_of(value) for value in inputs}
        self._made |= {m for value in tree_leaves(result) if (m := memory_of(value)) is not None} - given
        self._made |= {m for value in over if (m := memory_of(value)) is not None and fills(value)}
        return result

    def _judge(self, seen: "Seen", kept: dict[int, Tensor]) -> None:
        """Compare an operator with the one in the same place of the previous step."""
        place = len(self._record)
        before = self._record_before[place] if place < len(self._record_before) else Seen("nothing", {})
        if seen.call != before.call:
            raise HostReadError(
                f"calls {shown(seen.call)} where the previous step called {shown(before.call)}: a CUDA graph repeats the"
                " recorded call; keep numbers that change in a tensor"
            )
        for memory in seen.memory.keys() - before.memory.keys():
            name = next((f"self.{name}" for name, own in self._tensors() if memory_of(own) == memory), "")
            raise HostReadError(
                f"reads {name or 'a tensor'}, but the previous step read another tensor there: a CUDA graph goes on reading"
                f" the recorded one; allocate the tensor once and write it in place with {name or 'tensor'}.copy_(...)"
            )

    def _tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Yield the owner's tensors: attributes, and entries of its lists and dictionaries."""
        for name, value in getattr(self.owner, "__dict__", {}).items():
            parts = (
                value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple | deque) else (value,)
            )
            yield from ((name, part) for part in parts if isinstance(part, Tensor))


class ForbidReads(TorchDispatchMode):
    """Dispatch mode that refuses, in its block, operators that read certain tensors or parts of them."""

    def __init__(self, tensors: Mapping[str, Tensor], reason: str) -> None:
        """Refuse reads of `tensors` (name -> tensor). The error gives the name and, after it, the `reason`."""
        super().__init__()
        self._names = {memory_of(tensor): name for name, tensor in tensors.items()}
        self._reason = reason

    def judge(self, value: Any) -> None:
        """Check that a value holds none of the forbidden tensors.

        Raises:
            HostReadError: the value holds one of them.
        """
        for part in tree_leaves(value):
            memory = memory_of(part)
            if memory is not None and memory in self._names:
                raise HostReadError(f"reads self.{self._names[memory]}, {self._reason}")

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.judge((args, kwargs))
        return func(*args, **(kwargs or {}))


@dataclass(frozen=True)
class Seen:
    """Record of one operator that a step ran."""

    call: str
    """Name of the operator and its arguments other than tensors."""
    memory: dict[int, StorageWeakRef]
    """Memory of the argument tensors that the step itself did not make: identifier -> weak reference. While such a reference
    exists, no later tensor gets the same identifier."""


def memory_of(value: Any) -> int | None:
    """Return an identifier of a tensor's memory, or None for other values. Two memories in use never share an identifier."""
    return value.untyped_storage()._cdata if isinstance(value, Tensor) and value.layout is torch.strided else None


OVERWRITING = ("copy_", "fill_", "zero_", "uniform_", "normal_", "random_", "bernoulli_", "exponential_")
"""Methods that overwrite a tensor without reading it."""


def overwritten(func: Any, args: Any, kwargs: Any) -> list[Tensor]:
    """Return the tensors that an operator overwrites without reading them."""
    found = [kwargs[a.name] for a in func._schema.arguments if a.is_out and a.name in kwargs]
    return tree_leaves(found) + ([args[0]] if func._schema.name.removeprefix("aten::") in OVERWRITING else [])


def fills(tensor: Tensor) -> bool:
    """Return True if a tensor covers all of its memory."""
    return tensor.numel() * tensor.element_size() == tensor.untyped_storage().nbytes()


def caller() -> str:
    """Return the name of the module that calls torch."""
    frame = sys._getframe(1)
    while frame is not None:
        name = frame.f_globals.get("__name__", "")
        if name != __name__ and name.partition(".")[0] not in NEXT_TO:
            return name
        frame = frame.f_back  # type: ignore[assignment]
    return ""


def default_device() -> torch.device | None:
    """Return the device set by `torch.set_default_device` or `with torch.device(...)`, or None."""
    asked = [mode.device for mode in _get_current_function_mode_stack() if isinstance(mode, DeviceContext)]
    return asked[-1] if asked else None


UNCHECKED = "checks on the host whether an operation succeeded (inv, solve); use torch.linalg.inv_ex or solve_ex"

DECOMPOSED = "checks on the host whether svd, eigh or eig converged (also inside pinv, cond and matrix_rank)"


class _Operators(TorchDispatchMode):
    """Dispatch mode that sees every operator, including those that torch calls internally."""

    REASONS = {
        aten._local_scalar_dense.default: "reads a value on the host (.item(), float(tensor), if tensor)",
        aten.equal.default: "reads a value on the host (torch.equal)",
        aten._linalg_check_errors.default: UNCHECKED,
        aten.inverse.default: UNCHECKED,
        aten.cholesky.default: UNCHECKED,
        aten._linalg_svd.default: DECOMPOSED,
        aten._linalg_eigh.default: DECOMPOSED,
        aten.linalg_eig.default: DECOMPOSED,
        aten.linalg_pinv.atol_rtol_tensor: DECOMPOSED,
        aten.linalg_matrix_exp.default: "reads the norm of matrices on the host (matrix_exp)",
        aten._to_sparse.default: "has a result of unknown size (to_sparse)",
        aten.normal.Tensor_Tensor: "reads standard deviations on the host (normal); use mean + std * torch.randn_like(mean)",
        aten.normal.float_Tensor: "reads standard deviations on the host (normal); use mean + std * torch.randn_like(std)",
        aten.multinomial.default: "reads weights on the host (multinomial)",
        aten.nonzero.default: "has a result of unknown size (nonzero, or torch.where with one argument)",
    }

    def __init__(self, guard: ForbidHostReads) -> None:
        super().__init__()
        self._guard = guard

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        with self:  # in inference mode torch does not split composite operators, such as item
            result = func.decompose(*args, **kwargs)
        if result is not NotImplemented:
            return result
        reason = self._reason(func, args, kwargs)
        if reason:
            self._guard.refuse(reason)
        return self._guard.run(func, args, kwargs)

    def _reason(self, func: Any, args: Any, kwargs: Any) -> str:
        """Return why the operator is refused; empty if it is allowed."""
        if func in (aten.index.Tensor, aten.index_put_.default, aten.index_put.default):
            if any(i is not None and i.dtype in (torch.bool, torch.uint8) for i in args[1]):
                return "indexes by a mask, so the result's size is unknown; use torch.where or masked_fill"
            return ""
        if func is aten.lift_fresh.default and args[0].dim() > 0:
            return "makes a tensor of the host's numbers; use torch.tensor(..., device=self.device)"
        if func in self.REASONS:
            return self.REASONS[func]
        name = str(func).split(".")[1]
        if torch.Tag.data_dependent_output in func.tags:
            return f"reads a value on the host ({name})"
        if torch.Tag.dynamic_output_shape in func.tags and kwargs.get("output_size") is None:
            return f"has a result of unknown size ({name})"
        return ""


def _is_mask(index: Any) -> bool:
    return isinstance(index, Tensor) and index.dtype is torch.bool


class _Calls(TorchFunctionMode):
    """Function mode that sees Python's calls of torch, and replaces numbers of the host by cached constants. For
    `x[mask] = number` it calls `masked_fill_`, which a graph can hold.
    """

    REASONS = {
        Tensor.cpu: "copies to the host (.cpu())",
        Tensor.numpy: "copies to the host (.numpy())",
        Tensor.tolist: "copies to the host (.tolist())",
        Tensor.__array__: "copies to the host (a numpy function of a tensor)",
        Tensor.__dlpack__: "copies to the host (a tensor handed to another library)",
        Tensor.__repr__: "prints a tensor, which copies it to the host",
    }
    OF_DATA = (torch.tensor, torch.as_tensor, torch.asarray)

    def __init__(self, guard: ForbidHostReads) -> None:
        super().__init__()
        self._guard = guard

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, guard = kwargs or {}, self._guard
        if func is Tensor.__getitem__:
            args = guard.constants.pick(*args)
        if func is Tensor.__setitem__ and _is_mask(args[1]) and not (isinstance(args[2], Tensor) and args[2].dim()):
            rows = args[1].view(*args[1].shape, *[1] * (args[0].dim() - args[1].dim()))
            args[0].masked_fill_(rows, args[2])
            return None
        if func in (Tensor.__getitem__, Tensor.__setitem__):
            return func(args[0], guard.constants.index(args[0], args[1]), *args[2:])
        if func in self.REASONS:
            guard.refuse(self.REASONS[func])
        elif func is Tensor.to and self._is_host(*args[1:], *kwargs.values()):
            guard.refuse('copies to the host (.to("cpu"))')
        elif func is Tensor.type and args[1:] and not isinstance(args[1], torch.dtype):
            guard.refuse("copies to the host (.type with a CPU type); use .to(dtype), as in .to(torch.int64)")
        elif func is Tensor.new_tensor:
            return self._constant(func, args[1], args, kwargs, (args[0].dtype, args[0].device))
        elif func in _device_constructors() or func is torch.normal:
            return self._factory(func, args, kwargs)
        elif func is torch.nn.functional.one_hot and len(args) > 1 and args[1] > 0:  # one_hot on a CPU reads the values
            return (args[0].unsqueeze(-1) == torch.arange(args[1], device=args[0].device)).long()
        return func(*args, **kwargs)

    def _is_host(self, *values: Any) -> bool:
        """Return True if one of the values means the CPU. On a machine without a GPU the task's own device is the CPU too, so
        only the string "cpu" counts there.
        """
        kinds = str if self._guard.device.type == "cpu" else str | torch.device
        return any(isinstance(value, kinds) and torch.device(value).type == "cpu" for value in values)

    def _factory(self, func: Any, args: Any, kwargs: Any) -> Any:
        """Call `func`, which makes a tensor from nothing or from host data. Refuse a call that a graph can't hold."""
        given = [*args, *kwargs.values()]
        of_tensor = bool(given) and isinstance(given[0], Tensor) and (func in self.OF_DATA or func is torch.normal)
        device = kwargs.get("device") or default_device()
        if of_tensor or kwargs.get("out") is not None or sys._getframe(2).f_globals.get("__name__", "").startswith("torch."):
            return func(*args, **kwargs)
        if device is None:
            self._guard.refuse(f"torch.{func.__name__} without a device makes a tensor on the CPU: {ON_THE_DEVICE}")
        elif self._is_host(device) and not caller().startswith("legged."):  # legged's own learner may use the CPU
            self._guard.refuse(f"torch.{func.__name__} makes a tensor on the CPU: {ON_THE_DEVICE}")
        elif func in self.OF_DATA:
            return self._constant(func, given[0], args, kwargs, (device,))
        return func(*args, **kwargs)

    def _constant(self, func: Any, data: Any, args: Any, kwargs: Any, kind: Any) -> Any:
        """Return a copy of the constant that the call would make."""
        if holds_tensors(data) and not isinstance(data, Tensor):
            self._guard.refuse(f"{func.__name__} of a list of tensors reads their values on the host; use torch.stack")
        key = key_of(data)
        if key is None:
            return func(*args, **kwargs)
        settings = tuple((name, str(value)) for name, value in kwargs.items() if value is not data)
        return self._guard.constants.get((func.__name__, key, settings, kind), lambda: func(*args, **kwargs)).clone()
