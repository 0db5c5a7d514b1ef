"""Kernels that resample randomised values within a step, push robots, and update height-map errors. legged/mdp has the same
formulas in torch.

The kernels have a separate module, so that training without randomisation does not compile them.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def find_moments(
    reset: wp.array[wp.bool],
    interval: wp.array[float],
    steps_left: wp.array2d[float],
    due: wp.array2d[wp.bool],
    any_due: wp.array[wp.bool],
    steps: wp.array[float],
    chosen_at: int,
    new_chosen: wp.array[wp.int64],
    chosen: wp.array[wp.int64],
    chosen_due: wp.array[wp.bool],
):
    """Find the values that must be resampled now (`Randomization.redraw`). One thread per robot. Column 0 of `due` is never
    true. Column 1 is true at a reset, each further column at the end of an interval. If column `chosen_at` is true, the model
    variant changes.
    """
    robot = wp.tid()
    something = wp.bool(reset[robot])
    due[robot, 1] = something
    for k in range(interval.shape[0]):
        left = steps_left[robot, k] - 1.0
        now = left <= 0.0
        if now:
            left = wp.float32(interval[k])
            something = True
        steps_left[robot, k] = left
        due[robot, 2 + k] = now
    any_due[robot] = something
    due[robot, 0] = False
    if due[robot, chosen_at]:
        chosen[robot] = new_chosen[robot]
    if chosen_at > 0:
        chosen_due[robot] = due[robot, chosen_at]
    if robot == 0:
        steps[0] = steps[0] + 1.0


@wp.kernel
def take_fresh(due: wp.array2d[wp.bool], moment: wp.array[wp.int64], fresh: wp.array2d[float], drawn: wp.array2d[float]):
    """Copy new random values to the robots that are due (`Randomization.redraw`). One thread per robot and column."""
    robot, column = wp.tid()
    if due[robot, wp.int32(moment[column])]:
        drawn[robot, column] = fresh[robot, column]


@wp.kernel
def disturb(
    mask: wp.array[wp.bool],
    drawn: wp.array2d[float],
    dt: float,
    last_moment: float,
    bodies: wp.array[int],
    time_left: wp.array2d[float],
    left: wp.array2d[float],
    force: wp.array2d[float],
    steps: wp.array[float],
    due: wp.array[wp.bool],
    velocity: wp.array2d[float],
    total: wp.array3d[float],
):
    """Update kicks and external forces (`Disturbances.act`). One thread per robot and body. The thread of body 0 (the world)
    updates the kicks. `drawn` first holds seven numbers per kick: six of the velocity, and the interval. Then it holds five
    numbers per push: three of the force, the interval, and the duration. `total` (N, bodies, 6) receives the forces. The
    caller applies the kicks: `velocity` where `due` is true.
    """
    robot, body = wp.tid()
    goes_on = wp.bool(mask[robot])
    kicks = time_left.shape[1]
    if body == 0:
        if robot == 0:
            steps[0] = steps[0] + 1.0
        kicked = wp.bool(False)
        change = wp.spatial_vector()
        for k in range(kicks):
            until = time_left[robot, k] - dt
            if until <= last_moment and goes_on:
                until = wp.float32(drawn[robot, 7 * k + 6])
                kicked = True
                for i in range(6):
                    change[i] += drawn[robot, 7 * k + i]
            time_left[robot, k] = until
        due[robot] = kicked
        for i in range(6):
            velocity[robot, i] = change[i]

    if bodies.shape[0] == 0:
        return
    pushed = wp.vec3()
    for k in range(bodies.shape[0]):
        if bodies[k] == body:
            # All reads precede all writes, so that reads wait for memory together. The compiler moves no read ahead of a
            # write.
            at = 7 * kicks + 5 * k
            lasting, pause = left[robot, 2 * k] - dt, left[robot, 2 * k + 1] - dt
            now = wp.vec3(force[robot, 3 * k], force[robot, 3 * k + 1], force[robot, 3 * k + 2])
            new = wp.vec3(drawn[robot, at], drawn[robot, at + 1], drawn[robot, at + 2])
            new_pause, new_lasting = wp.float32(drawn[robot, at + 3]), wp.max(drawn[robot, at + 4], dt)
            if lasting <= last_moment or not goes_on:
                now = wp.vec3()
            if pause <= last_moment and goes_on:
                lasting = new_lasting
                pause = new_pause + lasting
                now = new
            left[robot, 2 * k] = lasting
            left[robot, 2 * k + 1] = pause
            for i in range(3):
                force[robot, 3 * k + i] = now[i]
            pushed += now
    for i in range(3):
        total[robot, body, i] = pushed[i]
        total[robot, body, 3 + i] = 0.0


@wp.kernel
def advance_map(
    begun: wp.array[wp.bool],
    drawn: wp.array2d[float],
    chances: wp.array2d[float],
    share: float,
    lost: float,
    error: wp.array2d[float],
    rate: wp.array2d[float],
    holes: wp.array2d[wp.bool],
):
    """Update the errors of height maps (`HeightMapErrors.advance`). One thread per robot and map point, or per robot if maps
    have no holes. The last column of `chances` decides whether the whole map is lost.
    """
    robot, point = wp.tid()
    fresh = wp.bool(begun[robot])
    if point < holes.shape[1] and fresh:
        holes[robot, point] = chances[robot, point] < share or chances[robot, holes.shape[1]] < lost
    if point > 0:
        return
    for k in range(3):
        if fresh:
            error[robot, k] = drawn[robot, k]
            rate[robot, k] = drawn[robot, 3 + k]
        else:
            error[robot, k] = error[robot, k] + rate[robot, k]
