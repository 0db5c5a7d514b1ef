"""A world from an MJCF file that includes its own floor."""

import warnings
from pathlib import Path

import mujoco
import numpy as np

from legged.config.world import SimConfig
from legged.errors import ConfigError
from legged.physics.scene.scene import GroundShapes, Scene, set_options


class ModelScene(Scene):
    """A model as its file describes it, including contacts. Only the solver options come from the configuration."""

    def __init__(self, path: Path | str) -> None:
        """Use the MJCF file at `path`, which is read when the model is built."""
        self.path = Path(path)
        self.name = str(path)

    def model(self, sim: SimConfig, ground: GroundShapes = "exact", contact_sensors: bool = False) -> mujoco.MjModel:
        """Return the file's model. It has its own ground and no tracked shapes, so `ground` and `contact_sensors` have no
        effect.

        Raises:
            ConfigError: MuJoCo cannot read the file, or its model has state that the engines do not keep for each world.
        """
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", ".* is deprecated")  # MuJoCo still reads deprecated elements
                spec = mujoco.MjSpec.from_file(str(self.path))
                set_options(spec.option, sim)
                model = spec.compile()
        except ValueError as error:
            raise ConfigError(f"{self.name}: MuJoCo cannot read it: {error}") from error
        sleeps = model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP
        kinds = {
            "delays": model.nhistory,
            "plugins": model.nplugin,
            "mocap bodies": model.nmocap,
            "sleeping bodies": sleeps,
        }
        for kind, count in kinds.items():
            if count:
                raise ConfigError(f"{self.name}: the model has {kind}; the engines do not keep their state per world")
        return model

    def shapes(self, model: mujoco.MjModel) -> np.ndarray:
        return np.arange(model.ngeom)
