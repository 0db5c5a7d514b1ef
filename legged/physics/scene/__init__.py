"""Contents of a world, as one MuJoCo model."""

from legged.physics.scene.model_scene import ModelScene
from legged.physics.scene.robot_scene import RobotScene
from legged.physics.scene.scene import Scene

__all__ = ["ModelScene", "RobotScene", "Scene"]
