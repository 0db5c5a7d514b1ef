"""Kernels for the parts of a task that have a fixed formula. Each kernel replaces 6 to 20 torch operations by one launch.

With the C engine, the same formulas run in torch. A test checks that kernels and torch give identical bits.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import torch
import warp as wp
from torch import Tensor

from legged.mdp.kernels.actuator import drive_joints
from legged.mdp.kernels.bodies import read_bodies
from legged.mdp.kernels.network import run_lstm, run_mlp
from legged.mdp.kernels.random import advance_map, disturb, find_moments, take_fresh

PI = wp.constant(wp.float32(torch.pi))


@wp.kernel
def hold_joints(
    target: wp.array2d[float],
    dof_pos: wp.array2d[float],
    dof_vel: wp.array2d[float],
    stiffness: wp.array2d[float],
    damping: wp.array2d[float],
    limit: wp.array2d[float],
    torques: wp.array2d[float],
):
    """Compute the torques of PD control, clipped at `limit` (`Control.compute`). One thread per robot and joint. Torques of
    NaN stay NaN.
    """
    robot, joint = wp.tid()
    spring = stiffness[robot, joint] * (target[robot, joint] - dof_pos[robot, joint])
    torque = spring - damping[robot, joint] * dof_vel[robot, joint]
    most = limit[robot, joint]
    if torque > most:
        torque = most
    if torque < -most:
        torque = -most
    torques[robot, joint] = torque


@wp.kernel
def advance_feet(
    forces: wp.array2d[wp.vec3],
    threshold: float,
    dt: float,
    in_contact: wp.array2d[wp.bool],
    first_contact: wp.array2d[wp.bool],
    touched: wp.array2d[wp.bool],
    air_time: wp.array2d[float],
    last_air_time: wp.array2d[float],
    contact_time: wp.array2d[float],
):
    """Update the feet's contacts and times (`FeetContacts.update`). One thread per robot and foot."""
    robot, foot = wp.tid()
    touching = forces[robot, foot][2] > threshold
    contact = touching or touched[robot, foot]
    air = air_time[robot, foot]
    first = contact and air > 0.0
    air += dt
    if first:
        last_air_time[robot, foot] = air
    if contact:
        air = 0.0
    in_contact[robot, foot] = contact
    first_contact[robot, foot] = first
    touched[robot, foot] = touching
    air_time[robot, foot] = air
    contact_time[robot, foot] = wp.where(contact, contact_time[robot, foot] + dt, 0.0)


@wp.kernel
def renew_commands(
    reset: wp.array[wp.bool],
    held: wp.array[wp.bool],
    steered: wp.array[wp.bool],
    sample: wp.array2d[float],
    sample_standing: wp.array[wp.bool],
    quat: wp.array2d[float],
    dt: float,
    last_moment: float,
    resampling_time: float,
    heading_gain: float,
    ranges: wp.array2d[float],
    moving: float,
    commands: wp.array2d[float],
    standing: wp.array[wp.bool],
    time_left: wp.array[float],
    is_moving: wp.array[wp.bool],
    renewed: wp.array[wp.bool],
):
    """Resample commands, and steer towards headings unless `heading_gain` is 0 (`Commands.update`). One thread per robot."""
    robot = wp.tid()
    left = time_left[robot] - dt
    due = (reset[robot] or left <= last_moment) and not held[robot]
    renewed[robot] = due
    if due:
        for i in range(4):
            commands[robot, i] = sample[robot, i]
        standing[robot] = sample_standing[robot]
        left = resampling_time
    time_left[robot] = left
    if heading_gain > 0.0 and steered[robot] and not standing[robot]:
        w, x, y, z = quat[robot, 0], quat[robot, 1], quat[robot, 2], quat[robot, 3]
        yaw = wp.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        turned = commands[robot, 3] - yaw + PI
        error = turned - 2.0 * PI * wp.floor(turned / (2.0 * PI)) - PI
        commands[robot, 2] = wp.clamp(heading_gain * error, ranges[2, 0], ranges[2, 1])
    velocity = wp.vec3(commands[robot, 0], commands[robot, 1], commands[robot, 2])
    is_moving[robot] = wp.length(velocity) > moving


@wp.kernel
def follow_commands(
    commands: wp.array2d[float],
    lin_vel: wp.array2d[float],
    ang_vel: wp.array2d[float],
    valid: wp.array[wp.bool],
    half_limit: wp.array[float],
    share: wp.array[float],
    reached: wp.array3d[float],
):
    """Write the velocity in the direction of each command, and the command's size. Write zeros if the command is at most half
    of its current limit, or if the robot is not `valid` (`CommandCurriculum.update`). One thread per robot and axis.
    """
    robot, axis = wp.tid()
    command = commands[robot, axis]
    size = wp.abs(command)
    if size > half_limit[axis] * share[axis] and valid[robot]:
        velocity = lin_vel[robot, axis]
        if axis == 2:
            velocity = ang_vel[robot, axis]
        reached[0, robot, axis] = velocity * wp.sign(command)
        reached[1, robot, axis] = size
    else:
        reached[0, robot, axis] = 0.0
        reached[1, robot, axis] = 0.0


@wp.kernel
def widen_commands(
    totals: wp.array2d[float],
    window_steps: float,
    threshold: float,
    step: float,
    sums: wp.array2d[float],
    steps: wp.array[float],
    share: wp.array[float],
):
    """Widen the ranges of commands (`CommandCurriculum.update`). One thread for all three axes, since they share a counter of
    steps.
    """
    count = steps[0] + 1.0
    due = count >= window_steps
    for axis in range(3):
        reached = sums[0, axis] + totals[0, axis]
        asked = sums[1, axis] + totals[1, axis]
        if due:
            if reached > threshold * asked:
                share[axis] = wp.min(share[axis] + step, 1.0)
            reached = wp.float32(0.0)
            asked = wp.float32(0.0)
        sums[0, axis] = reached
        sums[1, axis] = asked
    if due:
        count = wp.float32(0.0)
    steps[0] = count


@wp.kernel
def scan_heights(
    base_pos: wp.array2d[float],
    base_quat: wp.array2d[float],
    points_x: wp.array[float],
    points_y: wp.array[float],
    cells: wp.array[float],
    origin: wp.array[float],
    cell: float,
    rows: int,
    columns: int,
    heights: wp.array2d[float],
    ground: wp.array[float],
):
    """Read the ground's heights at points around each robot (`HeightScan.update`). One thread per robot and point. The last
    point is the base's position.
    """
    robot, point = wp.tid()
    w, x, y, z = base_quat[robot, 0], base_quat[robot, 1], base_quat[robot, 2], base_quat[robot, 3]
    yaw = wp.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    if wp.isnan(yaw):
        yaw = wp.float32(0.0)
    row, column = (base_pos[robot, 0] - origin[0]) / cell, (base_pos[robot, 1] - origin[1]) / cell
    if wp.isnan(row):
        row = wp.float32(0.0)
    if wp.isnan(column):
        column = wp.float32(0.0)
    c, s = wp.cos(yaw), wp.sin(yaw)
    row += c * points_x[point] - s * points_y[point]
    column += s * points_x[point] + c * points_y[point]
    i = int(wp.clamp(row, 0.0, float(rows - 1)))
    j = int(wp.clamp(column, 0.0, float(columns - 1)))
    height = cells[i * columns + j]
    if point < heights.shape[1]:
        heights[robot, point] = height
    else:
        ground[robot] = height


@wp.kernel
def move_levels(
    ended: wp.array[wp.bool],
    valid: wp.array[wp.bool],
    commands: wp.array2d[float],
    base_lin_vel: wp.array2d[float],
    steps_left: wp.array[wp.int64],
    dt: float,
    far: float,
    promoted: float,
    demoted: float,
    rows: int,
    columns: int,
    random: wp.array[wp.int64],
    column: wp.array[wp.int64],
    tiles: wp.array2d[float],
    way: wp.array2d[float],
    levels: wp.array[wp.int64],
    origins: wp.array2d[float],
    judged: wp.array2d[float],
):
    """Add a control step to the robots' progress, and move robots between terrain levels (`TerrainCurriculum.update`). The
    caller sums `judged` over robots. One thread per robot.
    """
    robot = wp.tid()
    x, y = commands[robot, 0], commands[robot, 1]
    speed = wp.sqrt(x * x + y * y)
    along = (x * base_lin_vel[robot, 0] + y * base_lin_vel[robot, 1]) / wp.max(speed, 1.0e-6)
    progress = way[0, robot] + wp.where(valid[robot], dt * along, 0.0)
    so_far = way[1, robot] + wp.where(valid[robot], dt * speed, 0.0)
    asked = so_far + dt * float(steps_left[robot]) * speed
    way[0, robot] = wp.where(ended[robot], 0.0, progress)
    way[1, robot] = wp.where(ended[robot], 0.0, so_far)
    mask = ended[robot] and valid[robot]
    up = mask and asked > 0.0 and progress > wp.min(promoted * asked, far)
    down = mask and progress < demoted * asked and not up
    level = int(levels[robot]) + wp.where(up, 1, 0) - wp.where(down, 1, 0)
    level = wp.max(level, 0)
    if level >= rows:
        level = int(random[robot])
    levels[robot] = wp.int64(level)
    tile = level * columns + int(column[robot])
    for i in range(3):
        origins[robot, i] = tiles[tile, i]
    judged[0, robot] = wp.where(mask, 1.0, 0.0)
    judged[1, robot] = wp.where(up, 1.0, 0.0)
    judged[2, robot] = wp.where(down, 1.0, 0.0)


@wp.kernel
def add_rewards(
    values: wp.array2d[float],
    factors: wp.array2d[float],
    before_clip: wp.array2d[float],
    valid: wp.array[wp.bool],
    largest: float,
    only_positive: bool,
    fine: wp.array2d[wp.bool],
    last: wp.array2d[float],
    sums: wp.array2d[float],
    total: wp.array[float],
):
    """Add up the rewards of all terms (`Rewards.compute`). One thread per robot; each row of an array belongs to a term. The
    compiler moves no read ahead of a write. So terms are processed in groups of four. The values and sums of a group are read
    first, so that these reads wait for memory at the same time.
    """
    robot = wp.tid()
    clipped, whole = wp.float32(0.0), wp.float32(0.0)
    counts = valid[robot]
    for first in range(0, values.shape[0], 4):
        given, before = wp.vec4(), wp.vec4()
        for k in range(4):
            if first + k < values.shape[0]:
                given[k] = values[first + k, robot]
                before[k] = sums[first + k, robot]
        for k in range(4):
            term = first + k
            if term < values.shape[0]:
                value = given[k] * factors[term, 0]
                number = wp.abs(value) < largest
                fine[term, robot] = number
                if not (number and counts):
                    value = 0.0
                last[term, robot] = value
                sums[term, robot] = before[k] + value
                if only_positive:
                    clipped += value * before_clip[term, 0]
                    whole += value * (1.0 - before_clip[term, 0])
                else:
                    whole += value
    total[robot] = wp.max(clipped, 0.0) + whole


KERNELS = {
    kernel.key: kernel
    for kernel in (
        *(hold_joints, drive_joints, run_mlp, run_lstm, advance_feet, renew_commands, follow_commands),
        *(find_moments, take_fresh, disturb, advance_map, widen_commands),
        *(scan_heights, read_bodies, move_levels, add_rewards),
    )
}
"""Name -> kernel."""
MOST_PREPARED = 200
"""Largest number of recorded launches per task."""


class TaskKernels:
    """Launches the kernels of this folder on an engine's device, on torch's current stream."""

    def __init__(self, on_device: Callable[[], AbstractContextManager[Any]]) -> None:
        """Make all launches within the context that `on_device` returns."""
        self._on_device = on_device
        self._prepared: dict[tuple[Any, ...], Any] = {}
        """Recorded CPU launches by kernel, dimension and arguments."""

    def launch(self, name: str, dim: int | tuple[int, ...], *arguments: Tensor | float) -> None:
        """Launch the kernel called `name`. Its array arguments are torch tensors; an array of vectors is a tensor (..., 3).

        On a CPU the launch is recorded, because preparing it takes longer than running it. The next call with the same
        kernel, dimension and tensors replays it.
        """
        kernel = KERNELS[name]
        with self._on_device():
            key = None
            if wp.get_device().is_cpu:
                key = (name, dim, *(_identity(a) for a in arguments))
                if prepared := self._prepared.get(key):
                    prepared.launch()
                    return
            inputs = [
                wp.from_torch(given, dtype=wanted.type.dtype) if isinstance(given, Tensor) else given
                for given, wanted in zip(arguments, kernel.adj.args, strict=True)
            ]
            wp.launch(kernel, dim=dim, inputs=inputs)
            if key is not None and (prepared := wp.launch(kernel, dim=dim, inputs=inputs, record_cmd=True)):
                # The table fills up only if each step creates new tensors. Old launches are then useless, and are dropped.
                if len(self._prepared) >= MOST_PREPARED:
                    self._prepared.clear()
                self._prepared[key] = prepared


def _identity(argument: Tensor | float) -> Any:
    """Return a number unchanged. For a tensor, return the properties that a recorded launch depends on."""
    if isinstance(argument, Tensor):
        return argument.data_ptr(), argument.shape, argument.stride(), argument.dtype
    return argument
