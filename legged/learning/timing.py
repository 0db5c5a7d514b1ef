"""Duration of a training: timing.json in its run folder."""

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from legged.config.checks import shown
from legged.errors import ConfigError
from legged.process.paths import relative, write_text

TIMING_FILE = "timing.json"


@dataclass(frozen=True)
class Timing:
    """Times of one training process, and the amount of its work."""

    task: str
    finished: bool
    """True if the training reached its last iteration or its target (`train.runner.stop_at`)."""
    robots: int
    """Number of robots in all processes."""
    iterations: int
    """Iterations made by this process, without the earlier iterations of a resumed training."""
    resumed: bool
    steps: int
    """Control steps of all robots."""
    start_up_s: float
    """Time until everything was built, including imports and the compilation of kernels [s]."""
    loop_s: float
    """Time in iterations [s]. It includes logging, except in rsl-rl's own loop."""
    wall_s: float
    """Time since the start of the process [s]. It includes `start_up_s`, `loop_s`, checkpoints, evaluations and the
    capture of CUDA graphs.
    """
    device: str
    kernels_compiled: int
    """Number of Warp modules that were compiled, because Warp's cache lacked them."""
    beside: int = 0
    """Largest number of other trainings seen at one time on the same device. With several GPUs, only the first process's GPU
    counts."""
    error: str = ""
    """Error that ended the training, in one line; empty if no error ended it."""
    evaluation_s: float = 0.0
    """Time in evaluations during training [s]."""

    @property
    def steps_per_s(self) -> float:
        """Steps of all robots per second of the training loop."""
        return self.steps / max(self.loop_s, 1e-9)

    @property
    def company(self) -> str:
        """Text ", beside n other trainings"; empty if the device was not shared."""
        return f", beside {self.beside} other training{'s' * (self.beside > 1)}" if self.beside else ""


def write_timing(folder: Path, timing: Timing) -> None:
    """Write the times of a training into its run folder.

    Raises:
        RunError: the file can't be written.
    """
    said = asdict(timing) | {"steps_per_s": timing.steps_per_s}
    write_text(folder / TIMING_FILE, json.dumps(said, indent=1, allow_nan=False) + "\n")


def read_timing(folder: Path) -> Timing | None:
    """Read the times of a training from its run folder. Return None without timing.json, as in runs of old versions.

    Raises:
        ConfigError: the file is damaged.
    """
    path = folder / TIMING_FILE
    if not path.is_file():
        return None
    try:
        said: Any = json.loads(path.read_text(encoding="utf-8"))
        given = {field.name: said.get(field.name, field.default) for field in fields(Timing)}
        for field in fields(Timing):
            kind: Any = field.type
            if not isinstance(given[field.name], (int, float) if kind is float else kind):
                raise TypeError(f"{field.name}: expected {kind.__name__}, got {shown(said.get(field.name))}")
        return Timing(**given)
    except (OSError, ValueError, AttributeError, TypeError, RecursionError) as error:
        raise ConfigError(f"{relative(path)}: does not hold the times of a training ({error})") from error
