"""Models that come with the package gymnasium (MIT licence)."""

from importlib.util import find_spec
from pathlib import Path

from legged.errors import ConfigError


def gymnasium_model(name: str) -> Path:
    """Return the path of the MJCF file `name` among Gymnasium's MuJoCo environments. Gymnasium itself is not imported.

    Raises:
        ConfigError: gymnasium is not installed, or does not have this file.
    """
    found = find_spec("gymnasium")
    folder = Path(found.origin).parent / "envs" / "mujoco" / "assets" if found and found.origin else Path()
    if not (folder / name).is_file():
        raise ConfigError(f"the package gymnasium is missing or lacks the model {name}; run `pip install -U gymnasium`")
    return folder / name
