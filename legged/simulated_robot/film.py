"""Film of a simulated robot under the deployed program."""

from pathlib import Path

import numpy as np

from legged.play.films import write_mp4
from legged.rendering.camera import Camera, Follower, caption, size_of
from legged.rendering.scene import display_model
from legged.robots.robot import Robot
from legged.terrain import Terrain

POSES, FILM = "poses.npy", "film.mp4"
"""Files in the folder of a run."""
SIZE = (640, 360)
"""Width and height [pixels]."""
AWAY = 3.45
"""Distance of the camera, in lengths of the robot."""


def make_film(robot: Robot, terrain: Terrain | None, folder: Path) -> None:
    """Write a film of the poses in `folder` with the states of its log.npz; fewer than two poses make no film.

    Raises:
        RunError: this machine cannot render, or the film cannot be written.
    """
    poses = np.load(folder / POSES)
    log = np.load(folder / "log.npz")
    if len(poses) < 2 or "times" not in log:
        (folder / FILM).unlink(missing_ok=True)  # left by another run
        print(f"{folder}: the run was too short for a film, so there is none")
        return
    camera = Camera(display_model(robot, 1, *SIZE, terrain), *SIZE)
    follower = Follower(camera.view, AWAY * size_of(robot).max(), None if terrain is None else terrain.height_map)
    frames = []
    for time, *qpos in poses:
        camera.data.qpos[:] = qpos
        base = np.array(qpos[:3])
        follower.update(base)
        camera.update()
        place = min(int(np.searchsorted(log["times"], time)), len(log["times"]) - 1)
        state = log["states"][log["state"][place]]
        frames.append(caption(camera.render(), [f"{robot.name}: {state}", f"{time:.1f} s, {base[0]:+.1f} m forward"]))
    camera.close()
    write_mp4(frames, folder / FILM, (len(poses) - 1) / max(poses[-1, 0] - poses[0, 0], 1e-3))
