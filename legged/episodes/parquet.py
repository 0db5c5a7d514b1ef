"""Recorded episodes as one flat table, for tools that read Parquet."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from legged.episodes.quantities import AXES
from legged.episodes.stored import Episodes, clock_of
from legged.episodes.stored_check import PER_EPISODE
from legged.errors import ConfigError
from legged.process.paths import relative, replacing

TABLE = "episodes.parquet"


def check_parquet(flag: str) -> None:
    """Check that Parquet can be written; `flag` asks for it.

    Raises:
        ConfigError: the package for it is not installed.
    """
    if find_spec("pyarrow") is None:
        raise ConfigError(f"{flag}: needs pyarrow, which is not installed: pip install 'legged[parquet]'")


def flat_columns(episodes: Episodes) -> dict[str, np.ndarray]:
    """Return (T,) columns by name: episode, time [s], and those of all arrays, `torque.LF_HAA` or `feet_force.LF_FOOT.x`."""
    found = dict(clock_of(episodes))
    for name, array in episodes.arrays.items():
        if name in PER_EPISODE:
            continue
        labels = [f"{name}.{column}" for column in episodes.columns(name)] or [name]
        if array.ndim == 3:
            labels = [f"{label}.{axis}" for label in labels for axis in AXES]
        flat = array.reshape(len(array), -1)
        found |= {label: flat[:, i] for i, label in enumerate(labels)}
    return found


def write_parquet(episodes: Episodes, folder: Path) -> None:
    """Write TABLE into `folder`, with one row for each control step.

    Raises:
        RunError: the file can't be written.
    """
    import pyarrow
    from pyarrow import parquet

    with replacing(folder / TABLE) as part:
        parquet.write_table(pyarrow.table(flat_columns(episodes)), part)
    print(f"written: {relative(folder / TABLE)}")
