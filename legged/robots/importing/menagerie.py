"""Robots of MuJoCo Menagerie, from its Python package, which downloads each model on first use and keeps it."""

from pathlib import Path

from legged.errors import ConfigError, RunError, suggest

PREFIX = "menagerie:"


def menagerie_model(name: str) -> tuple[Path, str]:
    """Return the MJCF file and the licence of the robot `name`. The file contains no scene.

    Raises:
        ConfigError: the package is missing, or has no such robot.
        RunError: the robot can't be downloaded.
    """
    try:
        import mujoco_menagerie
    except ImportError as error:
        raise ConfigError(f"{PREFIX}{name}: needs a package; run `pip install mujoco-menagerie`") from error
    names = mujoco_menagerie.names()
    if name not in names:
        raise ConfigError(f"{PREFIX}{name}: Menagerie has no such robot{suggest(name[:100], names, 'robots')}")
    robot = mujoco_menagerie.get(name)
    try:
        path = robot.xml(robot.default_model)
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise RunError(f"{PREFIX}{name}: {' '.join(str(error).split())}") from error
    if not path.is_file():
        raise RunError(f"{PREFIX}{name}: {path} is missing; check the downloads with `python -m mujoco_menagerie verify`")
    return path, robot.license
