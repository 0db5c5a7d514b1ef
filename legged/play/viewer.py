"""MuJoCo's viewer, with commands from the keyboard."""

import time

import numpy as np
import torch
from tensordict import TensorDict

from legged.envs import BaseTask, is_robot_task, is_velocity_task
from legged.envs.motion_tracking import is_tracking_task
from legged.play.playground import Playground
from legged.policies.episodes import Policy
from legged.rendering.camera import drawn_model, follow_root, size_of
from legged.rendering.ghost import Ghost
from legged.rendering.scene import display_model

STEP = (0.1, 0.1, 0.2)
"""Change of vx, vy [m/s] and yaw rate [rad/s] by one key press."""
UP, DOWN, LEFT, RIGHT, SPACE, COMMA, PERIOD, BACKSPACE, NEXT = 265, 264, 263, 262, 32, 44, 46, 259, ord("N")
HELP = """viewer: up/down vx, left/right yaw rate, comma/period vy, space stands still, backspace starts anew;
close the window to record the video"""
HELP_WITHOUT_COMMANDS = "viewer: backspace starts anew; close the window to record the video"


class Keyboard:
    """Command of vx, vy [m/s] and yaw rate [rad/s]. Key presses change it within the ranges of the task."""

    MOVES = {UP: (0, 1), DOWN: (0, -1), COMMA: (1, 1), PERIOD: (1, -1), LEFT: (2, 1), RIGHT: (2, -1)}

    def __init__(self, low: list[float], high: list[float]) -> None:
        """Start with the command zero. `low` and `high` are the limits of vx, vy and yaw rate."""
        self.low, self.high = low, high
        self.command = [0.0, 0.0, 0.0]
        self.restart = False
        self.tile = 0
        """Number of times that the next tile was requested."""

    def press(self, key: int) -> None:
        """Process a key, given by its GLFW code. Keys without a function have no effect."""
        if key in self.MOVES:
            axis, sign = self.MOVES[key]
            moved = round(self.command[axis] + sign * STEP[axis], 3)
            self.command[axis] = min(max(moved, self.low[axis]), self.high[axis])
        elif key == SPACE:
            self.command = [0.0, 0.0, 0.0]
        elif key in (BACKSPACE, NEXT):
            self.tile += key == NEXT
            self.restart = True


@torch.inference_mode()
def view(task: BaseTask, act: Policy, playground: Playground | None = None) -> None:
    """Show the task's first environment, on the `playground` if one is given, in real time until the window is closed."""
    import mujoco.viewer  # imported here, because machines without a display may lack its libraries

    legged, steered = task if is_robot_task(task) else None, task if is_velocity_task(task) else None
    low, high = steered.command_sampler.full_ranges.t().tolist() if steered else ([0.0] * 3, [0.0] * 3)
    keyboard = Keyboard(low, high)
    model = display_model(legged.robot, 1, 640, 480, legged.terrain) if legged else drawn_model(task, 640, 480)
    ghost = Ghost(task, model) if is_tracking_task(task) else None
    data, simulated = mujoco.MjData(model), mujoco.MjData(task.physics.model)
    print(HELP if steered else HELP_WITHOUT_COMMANDS)
    if playground:
        print("n goes to the next tile")
    observations = begin_anew(task, playground, keyboard)
    panels = {"show_left_ui": False, "show_right_ui": False}
    with mujoco.viewer.launch_passive(model, data, key_callback=keyboard.press, **panels) as window:
        follow_root(window.cam, model)
        if legged:
            window.cam.trackbodyid = model.body(f"0/{legged.robot.file.base}").id
            away, window.cam.azimuth, window.cam.elevation = (2.4, 130, -18) if legged.terrain is None else (3.83, 62, -35)
            window.cam.distance = away * size_of(legged.robot).max()
            window.opt.geomgroup[3] = 0  # hide collision shapes
        while window.is_running():
            begin = time.perf_counter()
            if keyboard.restart:
                observations = begin_anew(task, playground, keyboard)
            if steered:
                observations = steered.hold_commands(task.physics.qpos.new_tensor(keyboard.command))
            observations, _, _, _ = task.step(act(observations))
            with window.lock():
                task.physics.copy_to(0, simulated)
                data.qpos[:], data.qvel[:] = simulated.qpos, simulated.qvel
                mujoco.mj_forward(model, data)
                if ghost is not None:
                    window.user_scn.ngeom = 0
                    ghost.draw(window.user_scn, window.opt, 0, np.zeros((1, 3)))
            window.sync()
            time.sleep(max(0.0, task.dt - (time.perf_counter() - begin)))


def begin_anew(task: BaseTask, playground: Playground | None, keyboard: Keyboard) -> TensorDict:
    """Reset the task and return the observations. On a playground, go to the tile chosen by key and print its name."""
    if playground and is_robot_task(task):
        playground.place(task, keyboard.tile)
    observations = task.reset()
    keyboard.restart = False
    if playground and is_robot_task(task) and task.terrain:
        print(playground.label(task.terrain, task.base_pos[0].tolist()))
    return observations
