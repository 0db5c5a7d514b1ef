"""Tiles of terrain as a camera sees them, each with a robot that gives the scale."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from legged.rendering import add_sky, make_renderer
from legged.rendering.paint import DEPTH, add_painted_terrain
from legged.robots.robot import Robot
from legged.terrain import Terrain

SUN = np.array([0.39, -0.54, -0.75])
"""Direction of its light: from the left, so that risers which face the camera are lit, if less than treads."""
FIELD_OF_VIEW = 30.0
"""Of the camera, from bottom to top [degrees]."""


@dataclass(frozen=True)
class Place:
    """A tile on which a robot stands, and what is written beside it."""

    row: int
    col: int
    label: str


def render(terrain: Terrain, places: Sequence[Place], robot: Robot, width: int = 1600) -> np.ndarray:
    """(height, width, 3) uint8: the terrain seen along x from above, a robot in its default pose at each place.

    The height of the picture is what the terrain fills.

    Raises:
        RunError: nothing can be rendered here.
    """
    outline = _outline(terrain)
    seen = np.ptp(Camera.on(outline, width, width).pixels(outline), axis=0)
    height = int(width * np.clip(seen[1] / seen[0], 0.3, 0.8))
    camera = Camera.on(outline, width, height)
    model = _model(terrain, places, robot, width, height)
    data = mujoco.MjData(model)
    _pose(model, data, terrain, places, robot)
    renderer = make_renderer(model, width, height)
    options = mujoco.MjvOption()
    options.geomgroup[3] = 0  # collision shapes
    try:
        renderer.update_scene(data, camera.view(), options)
        picture = renderer.render()
    finally:
        renderer.close()
    return _write_on(picture, places, camera.pixels(np.array([_label_at(terrain, place) for place in places])))


class Camera:
    """A free camera that looks along x and down, a little from the side."""

    def __init__(self, width: int, height: int, azimuth: float = 14.0, elevation: float = -35.0) -> None:
        self.width, self.height, self.azimuth, self.elevation = width, height, azimuth, elevation
        a, e = np.radians([azimuth, elevation])
        self.forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        self.right = np.array([np.sin(a), -np.cos(a), 0.0])
        self.up = np.cross(self.right, self.forward)
        self.lookat, self.distance = np.zeros(3), 10.0

    @classmethod
    def on(cls, points: np.ndarray, width: int, height: int, fill: float = 0.96) -> "Camera":
        """As near as `points` (N, 3), world frame [m], allow that are all to be seen."""
        camera = cls(width, height)
        for _ in range(30):  # converges: each turn halves what is wrong, or better
            at = camera.pixels(points)
            low, high = at.min(axis=0), at.max(axis=0)
            metres = camera.distance / camera.focal
            off = 0.5 * (low + high) - [0.5 * width, 0.5 * height]
            camera.lookat = camera.lookat + metres * (off[0] * camera.right - off[1] * camera.up)
            camera.distance *= float(((high - low) / [fill * width, fill * height]).max()) ** 0.7
        return camera

    @property
    def focal(self) -> float:
        """Pixels a metre at 1 m from the camera."""
        return 0.5 * self.height / float(np.tan(0.5 * np.radians(FIELD_OF_VIEW)))

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """(N, 2) where world points (N, 3) are in the picture, from its upper left corner."""
        from_camera = points - (self.lookat - self.distance * self.forward)
        depth = np.maximum(from_camera @ self.forward, 0.1)
        centre = np.array([0.5 * self.width, 0.5 * self.height])
        return centre + self.focal * np.stack([from_camera @ self.right, -(from_camera @ self.up)], axis=1) / depth[:, None]

    def view(self) -> mujoco.MjvCamera:
        """For MuJoCo."""
        view = mujoco.MjvCamera()
        view.lookat[:], view.distance, view.azimuth, view.elevation = self.lookat, self.distance, self.azimuth, self.elevation
        return view


def _model(terrain: Terrain, places: Sequence[Place], robot: Robot, width: int, height: int) -> mujoco.MjModel:
    """The scene, with the robots in the order of `places`; for drawing, not for simulating."""
    scene = mujoco.MjSpec()
    add_sky(scene)
    half_x, half_y = (0.5 * side for side in terrain.height_map.size)
    look = scene.visual
    look.global_.offwidth, look.global_.offheight, look.global_.fovy = width, height, FIELD_OF_VIEW
    look.quality.shadowsize, look.quality.offsamples = 8192, 8
    look.headlight.ambient, look.headlight.diffuse, look.headlight.specular = [0.42] * 3, [0.12] * 3, [0.0] * 3
    extent = float(np.hypot(half_x, half_y))
    scene.stat.extent, scene.stat.center = extent, [0, 0, 0]
    look.map.znear, look.map.zfar, look.map.shadowclip = 0.2, 6.0, 1.2
    scene.worldbody.add_light(
        pos=-2.0 * extent * SUN,  # shadows are cast only within znear and zfar from here
        dir=SUN,
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.62] * 3,
        specular=[0.0] * 3,
        castshadow=True,
    )
    add_painted_terrain(scene, terrain)
    for i in range(len(places)):
        frame = scene.worldbody.add_frame()
        scene.attach(mujoco.MjSpec.from_file(str(robot.model_path)), prefix=f"{i}/", frame=frame)
    return scene.compile()


def _pose(model: mujoco.MjModel, data: mujoco.MjData, terrain: Terrain, places: Sequence[Place], robot: Robot) -> None:
    """Put each robot on the middle of its tile, its lowest foot on the ground, facing the camera."""
    states = data.qpos.reshape(len(places), 7 + robot.num_dof)
    states[:, 7:] = robot.default_dof_pos
    for i, place in enumerate(places):
        states[i, :3] = terrain.origins[place.row, place.col]
        states[i, 3:7] = [np.cos(np.radians(110.0)), 0.0, 0.0, np.sin(np.radians(110.0))]
    mujoco.mj_kinematics(model, data)
    for i in range(len(places)):
        feet = [model.geom(f"{i}/{name}").id for name in robot.feet_names]
        low = data.geom_xpos[feet, 2] - model.geom_rbound[feet]
        states[i, 2] += terrain.origins[places[i].row, places[i].col, 2] - low.min()
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)


def _outline(terrain: Terrain) -> np.ndarray:
    """(8, 3) corners of the tiles and of what stands on them [m]."""
    x, y = (0.5 * side for side in terrain.height_map.size)
    bottom = float(terrain.height_map.corners.min()) - DEPTH
    return np.array([[sx * x, sy * y, z] for sx in (-1, 1) for sy in (-1, 1) for z in (bottom, 0.5)])


def _label_at(terrain: Terrain, place: Place) -> np.ndarray:
    """(3,) On the border behind the farthest tiles, on the near edge of the others [m]."""
    x, y, _ = terrain.origins[place.row, place.col]
    last = len(terrain.origins) - 1
    if place.row == last > 0:
        return np.array([x + 0.5 * (terrain.tile_size[0] + terrain.border), y, 0.0])
    aside = 0.5 * terrain.border if place.row == 0 else 0.0
    return np.array([x - 0.5 * terrain.tile_size[0] - aside, y, 0.0])


def _write_on(picture: np.ndarray, places: Sequence[Place], at: np.ndarray) -> np.ndarray:
    """The labels of the places, centred at pixels `at` (N, 2)."""
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    font = ImageFont.load_default(size=picture.shape[0] / 42)
    for place, (x, y) in zip(places, at, strict=True):
        box = draw.textbbox((x, y), place.label, font=font, anchor="mm")
        draw.rounded_rectangle((box[0] - 8, box[1] - 5, box[2] + 8, box[3] + 5), radius=6, fill=(255, 255, 255, 215))
        draw.text((x, y), place.label, fill=(40, 40, 40), font=font, anchor="mm")
    return np.asarray(image)
