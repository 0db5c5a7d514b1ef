"""How long a training took: timing.json in its run folder."""

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
    """Times of the process that trained, and what they are times of."""

    task: str
    finished: bool
    """Whether it came to its last iteration, or reached its target."""
    robots: int
    """Of all processes."""
    iterations: int
    """That were made by this process; a resumed training has more behind it."""
    resumed: bool
    steps: int
    """Of all robots."""
    start_up_s: float
    """Until everything was built: imports, and kernels where they were compiled [s]."""
    loop_s: float
    """In iterations, one after the other, with what is logged of them; of rsl-rl's own loop without [s]."""
    wall_s: float
    """From the start of the process to here: beside the two above, graphs captured, checkpoints and evaluations [s]."""
    device: str
    kernels_compiled: int
    """Modules of Warp's kernels that its cache lacked."""
    beside: int = 0
    """The most other trainings that were seen on the same device at one time; of several GPUs, on the first one's."""
    error: str = ""
    """What ended it, in one line, where that was neither its last iteration nor a signal."""
    evaluation_s: float = 0.0
    """In evaluations during training [s]."""

    @property
    def steps_per_s(self) -> float:
        """Steps of all robots in a second of training loop."""
        return self.steps / max(self.loop_s, 1e-9)

    @property
    def company(self) -> str:
        """With how many others the device was shared, to be written behind a comma; nothing where with none."""
        return f", beside {self.beside} other training{'s' * (self.beside > 1)}" if self.beside else ""


def write_timing(folder: Path, timing: Timing) -> None:
    """Write the times of a training into its run folder.

    Raises:
        RunError: it can't be written.
    """
    said = asdict(timing) | {"steps_per_s": timing.steps_per_s}
    write_text(folder / TIMING_FILE, json.dumps(said, indent=1, allow_nan=False) + "\n")


def read_timing(folder: Path) -> Timing | None:
    """Read the times of the training of a run folder; None where it says nothing of them, as older ones do.

    Raises:
        ConfigError: the file is none that was written here.
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
        raise ConfigError(f"{relative(path)}: does not say how long a training took ({error})") from error
