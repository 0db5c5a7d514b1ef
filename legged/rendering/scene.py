"""What is drawn: robots on a floor or a terrain, under a sky."""

import warnings
from collections.abc import Sequence

import mujoco

from legged.errors import RunError
from legged.process import headless
from legged.rendering.paint import add_horizon, add_painted_terrain
from legged.rendering.window import draw_without_window
from legged.robots.importing.adapted import robot_spec_of
from legged.robots.robot import Robot
from legged.terrain import Terrain


def add_sky(scene: mujoco.MjSpec) -> None:
    """Add a pale blue sky, white at the horizon."""
    scene.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.76, 0.90],
        rgb2=[0.94, 0.96, 0.98],
        width=256,
        height=1536,
    )


def display_model(robot: Robot, count: int, width: int, height: int, terrain: Terrain | None = None) -> mujoco.MjModel:
    """Compile `count` copies of the robot over one checkered floor, or a terrain, under a sky; it is drawn, not simulated."""
    scene = mujoco.MjSpec()
    scene.visual.global_.offwidth, scene.visual.global_.offheight = width, height
    scene.visual.quality.shadowsize = scene.visual.quality.offsamples = 0  # ten times faster without a GPU
    scene.visual.map.zfar = 60
    scene.stat.extent, scene.stat.center = 4.0, [0, 0, 0.4]
    add_sky(scene)
    if terrain is None:
        _add_floor(scene)
        _light(scene, [-0.3, 0.35, -1], ambient=0.45, headlight=0.5, sun=0.5)
    else:
        add_painted_terrain(scene, terrain, checkered=True)
        add_horizon(scene, terrain)
        # Little light from the camera and much from the left behind it: treads, risers and flanks differ.
        _light(scene, [0.3, -0.35, -0.9], ambient=0.42, headlight=0.12, sun=0.62)
    add_robots(scene, robot, count)
    return scene.compile()


def add_robots(scene: mujoco.MjSpec, robot: Robot, count: int) -> None:
    """Add copies of the robot, whose names begin with 0/, 1/, ..."""
    for i in range(count):
        frame = scene.worldbody.add_frame()
        scene.attach(robot_spec_of(robot.model_path, drawn=True), prefix=f"{i}/", frame=frame)


def make_renderer(model: mujoco.MjModel, width: int, height: int, instead: str = "") -> mujoco.Renderer:
    """Return what draws a model.

    Raises:
        RunError: nothing can be drawn on this machine; `instead` is what the user might do then.
    """
    if headless.NO_PICTURES:
        raise RunError(f"cannot render here: {headless.NO_PICTURES}{instead}")
    draw_without_window()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # glfw warns, and then fails
            return mujoco.Renderer(model, height, width, max_geom=model.ngeom + 1000)
    except Exception as error:  # each GL library fails in its own way
        raise RunError(
            f"cannot render here ({error}); without a display MUJOCO_GL=egl or MUJOCO_GL=osmesa and their libraries are"
            f" needed{instead}"
        ) from error


def _add_floor(scene: mujoco.MjSpec) -> None:
    """Add a checkered plane."""
    scene.add_texture(
        name="checker",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.80, 0.82, 0.84],
        rgb2=[0.70, 0.73, 0.76],
        width=512,
        height=512,
    )
    ground = scene.add_material(name="ground", texrepeat=[1, 1], texuniform=True)
    ground.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "checker"
    scene.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], material="ground")


def _light(scene: mujoco.MjSpec, direction: Sequence[float], ambient: float, headlight: float, sun: float) -> None:
    """Add a sun that shines in a direction, and a light at the camera."""
    scene.visual.headlight.ambient, scene.visual.headlight.diffuse = [ambient] * 3, [headlight] * 3
    scene.worldbody.add_light(pos=[0, 0, 20], dir=direction, type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, diffuse=[sun] * 3)
