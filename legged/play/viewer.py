"""MuJoCo's viewer with keyboard commands."""

import time
from collections.abc import Callable
from typing import Any

import mujoco
import torch
from tensordict import TensorDict
from torch import Tensor

from legged.envs import BaseTask, LeggedRobot
from legged.play.playground import Playground
from legged.rendering import display_model, drawn_model, follow_root, size_of

STEP = (0.1, 0.1, 0.2)
"""Change of vx, vy [m/s] and yaw rate [rad/s] by one key press."""
UP, DOWN, LEFT, RIGHT, SPACE, COMMA, PERIOD, BACKSPACE, NEXT = 265, 264, 263, 262, 32, 44, 46, 259, ord("N")
HELP = """viewer: up/down vx, left/right yaw rate, comma/period vy, space stands still, backspace starts anew;
close the window to record the video"""
HELP_WITHOUT_COMMANDS = "viewer: backspace starts anew; close the window to record the video"
HELP_ON_TERRAIN = "n goes to the next tile"


PANELS = {"show_left_ui": False, "show_right_ui": False}


class Keyboard:
    """Key presses -> a command (vx, vy, yaw rate) within the ranges of the task."""

    MOVES = {UP: (0, 1), DOWN: (0, -1), COMMA: (1, 1), PERIOD: (1, -1), LEFT: (2, 1), RIGHT: (2, -1)}

    def __init__(self, low: list[float], high: list[float]) -> None:
        """Start with the command zero; `low` and `high` are the limits of each axis."""
        self.low, self.high = low, high
        self.command = [0.0, 0.0, 0.0]
        self.restart = False
        self.tile = 0
        """Number of requests for the next tile."""

    def press(self, key: int) -> None:
        """Process a key by its GLFW code; other keys have no effect."""
        if key in self.MOVES:
            axis, sign = self.MOVES[key]
            moved = round(self.command[axis] + sign * STEP[axis], 3)
            self.command[axis] = min(max(moved, self.low[axis]), self.high[axis])
        elif key == SPACE:
            self.command = [0.0, 0.0, 0.0]
        elif key == BACKSPACE:
            self.restart = True
        elif key == NEXT:
            self.tile += 1
            self.restart = True


@torch.inference_mode()
def view(task: LeggedRobot, act: Callable[[TensorDict], Tensor], playground: Playground | None = None) -> None:
    """Show the task's first robot in real time until the window is closed; on terrain, on a tile of the playground."""
    low, high = task.command_sampler.full_ranges.t().tolist()
    keyboard = Keyboard(low, high)
    model = display_model(task.robot, 1, 640, 480, task.terrain)
    data = mujoco.MjData(model)
    length = size_of(task.robot).longest
    simulated = mujoco.MjData(task.physics.model)
    print(HELP)
    if playground:
        print(HELP_ON_TERRAIN)
    begin_anew(task, playground, keyboard)
    with _window(model, data, keyboard.press) as window:
        window.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        window.cam.trackbodyid = model.body(f"0/{task.robot.file.base}").id
        window.cam.distance, window.cam.azimuth, window.cam.elevation = (
            (2.4 * length, 130.0, -18.0) if task.terrain is None else (3.83 * length, 62.0, -35.0)
        )
        window.opt.geomgroup[3] = 0  # collision shapes
        while window.is_running():
            begin = time.perf_counter()
            if keyboard.restart:
                begin_anew(task, playground, keyboard)
            command = torch.tensor(keyboard.command, device=task.device)  # type: ignore[arg-type]
            task.step(act(task.hold_commands(command)))
            with window.lock():
                task.physics.copy_to(0, simulated)
                data.qpos[:], data.qvel[:] = simulated.qpos, simulated.qvel
                mujoco.mj_forward(model, data)
            window.sync()
            time.sleep(max(0.0, task.dt - (time.perf_counter() - begin)))


@torch.inference_mode()
def watch(task: BaseTask, act: Callable[[TensorDict], Tensor]) -> None:
    """Show the first environment of a task without commands in real time until the window is closed."""
    model = drawn_model(task, 640, 480)
    data = mujoco.MjData(model)
    restart: list[int] = []
    print(HELP_WITHOUT_COMMANDS)
    observations = task.reset()

    def press(key: int) -> None:
        if key == BACKSPACE:
            restart.append(key)

    with _window(model, data, press) as window:
        follow_root(window.cam, model)
        while window.is_running():
            begin = time.perf_counter()
            if restart:
                restart.clear()
                observations = task.reset()
            observations, _, _, _ = task.step(act(observations))
            with window.lock():
                task.physics.copy_to(0, data)
                mujoco.mj_forward(model, data)
            window.sync()
            time.sleep(max(0.0, task.dt - (time.perf_counter() - begin)))


def _window(model: mujoco.MjModel, data: mujoco.MjData, press: Callable[[int], None]) -> Any:
    """Open MuJoCo's viewer, whose library for windows a machine without a display may lack."""
    import mujoco.viewer

    return mujoco.viewer.launch_passive(model, data, key_callback=press, **PANELS)


def begin_anew(task: LeggedRobot, playground: Playground | None, keyboard: Keyboard) -> None:
    """Reset the robots, on terrain on the tile that the keyboard selects, and print its name."""
    if playground and task.terrain:
        playground.place(task, keyboard.tile)
    task.reset()
    keyboard.restart = False
    if playground and task.terrain:
        print(playground.label(task.terrain, task.base_pos[0].tolist()))
