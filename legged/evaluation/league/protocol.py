"""Waypoints, goals of the arms, and punches of the league's runs. They follow from a run's id alone."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from legged.evaluation.league.streams import Stream
from legged.math import quat_from_angle_axis, quat_multiply, quat_rotate

TOUR, PUNCHES, ARMS = 2, 3, 4
"""Numbers of the random streams."""
CONTROL_DT = 0.02
"""Control step [s]."""
POINTS, POINT_S = 18, 5.0
"""Number of waypoints, and time for each [s]."""
RUN_S = POINTS * POINT_S
"""Length of a run [s]."""
CENTRE, RADIUS = (0.3, 0.0), 0.75
"""Disc of the waypoints in the frame of the start [m]."""
STRONGEST, WEAKEST_SHARE, FIRST_SHARE, CLIMB_S = 500.0, 0.5, 1.0 / 3.0, 60.0
"""Largest force of a punch [N]. A force is at least WEAKEST_SHARE of the largest at its time, which climbs from FIRST_SHARE
of STRONGEST to STRONGEST within CLIMB_S [s]."""
PUNCH_AT_S, PUNCH_S = 0.1, 0.08
"""Time from the beginning of a waypoint's slot to the punch, and duration of the punch [s]."""
GOAL_S = 0.5
"""Time from one goal of the arms to the next [s]."""
WANDER, WANDER_STEPS = 0.06, 25
"""A goal is WANDER_STEPS uniform steps of at most WANDER [rad] away from the last one."""
TRIES = 8
"""Number of goals that are tried until the hands are in front of the body. After that the arms stay."""


@dataclass(frozen=True)
class Arm:
    """A left arm with K joints. The right arm is its mirror image."""

    stance: np.ndarray
    """(K,) angles at the start [rad]."""
    limits: np.ndarray
    """(K, 2) lowest and highest angles [rad]."""
    links: Sequence[tuple[Sequence[float], Sequence[float], Sequence[float]]]
    """(K,) position [m] and orientation (w, x, y, z) of each link in the frame of the link before, first the torso, and the
    joint's axis."""
    hand: np.ndarray
    """(C, 3) points of the hand in the frame of the last link [m]."""
    head: float
    """Height of the lower end of the head in the frame of the torso [m]."""


@dataclass(frozen=True)
class Punches:
    """The punches of one run."""

    joint: np.ndarray
    """(POINTS,) index of the joint at whose anchor the force acts, on the link that the joint moves."""
    of_child: np.ndarray
    """(POINTS,) True if the force keeps its direction in the frame of this link, False: in the frame of the link's parent."""
    force: np.ndarray
    """(POINTS, 3) force in this frame [N]."""


def waypoints(run: int) -> np.ndarray:
    """Return x, y [m] and yaw [rad] of a run's waypoints in the frame of the start, (POINTS, 3)."""
    stream, found = Stream(run, TOUR), []
    for _ in range(POINTS):
        radius = RADIUS * math.sqrt(stream.between(0.0, 1.0))
        bearing, yaw = stream.between(0.0, 2.0 * math.pi), stream.between(0.0, 2.0 * math.pi)
        x, y = CENTRE[0] + radius * math.cos(bearing), CENTRE[1] + radius * math.sin(bearing)
        found.append((x, y, math.remainder(yaw, 2.0 * math.pi)))
    return np.array(found)


def punches(run: int, joints: int) -> Punches:
    """Return the punches of a run, on a robot with this number of joints."""
    stream, found = Stream(run, PUNCHES), []
    for point in range(POINTS):
        joint, of_child = stream.below(joints), stream.below(2) == 1
        z, turn = stream.between(-1.0, 1.0), stream.between(0.0, 2.0 * math.pi)
        climbed = FIRST_SHARE + (1.0 - FIRST_SHARE) * min(point * POINT_S / CLIMB_S, 1.0)
        size, across = STRONGEST * climbed * stream.between(WEAKEST_SHARE, 1.0), math.sqrt(1.0 - z * z)
        force = (size * across * math.cos(turn), size * across * math.sin(turn), size * z)
        found.append((joint, of_child, force))
    return Punches(*(np.array(values) for values in zip(*found, strict=True)))


def reach(arm: Arm, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far back and how far up the left hand reaches at arm angles (M, K) [rad], (M,) each: smallest x and largest
    z of its points in the frame of the torso [m]. The right arm is the mirror image, so its hand reaches as far.
    """
    given = torch.from_numpy(angles)
    place, turn = torch.zeros(len(given), 3, dtype=torch.float64), torch.zeros(len(given), 4, dtype=torch.float64)
    turn[:, 0] = 1.0
    for angle, link in zip(given.T, arm.links, strict=True):
        shift, own, axis = (torch.tensor(numbers, dtype=torch.float64) for numbers in link)
        place = place + quat_rotate(turn, shift.expand_as(place))
        turn = quat_multiply(quat_multiply(turn, own.expand_as(turn)), quat_from_angle_axis(angle, axis))
    points = torch.from_numpy(arm.hand).expand(len(given), -1, -1)
    reached = place.unsqueeze(1) + quat_rotate(turn.unsqueeze(1).expand(-1, len(arm.hand), -1), points)
    return reached[..., 0].amin(dim=1).numpy(), reached[..., 2].amax(dim=1).numpy()


def arm_goals(runs: Sequence[int], arm: Arm) -> np.ndarray:
    """Return the angles of the left arm at the start and at the end of each GOAL_S, (N, 1 + goals, K) [rad], for the N runs
    with the ids `runs`. Between the ends, the angles change linearly.

    At every goal both hands are no further back than at the start, and below the head.
    """
    streams, (furthest_back, _) = [Stream(run, ARMS) for run in runs], reach(arm, arm.stance[None])
    goals = np.tile(arm.stance, (len(runs), 1 + round(RUN_S / GOAL_S), 1))
    for k in range(1, goals.shape[1]):
        goals[:, k] = goals[:, k - 1]
        waiting = np.arange(len(runs))
        for _ in range(TRIES):
            steps = [streams[i].units(WANDER_STEPS * len(arm.stance)).reshape(WANDER_STEPS, -1) for i in waiting]
            tried = goals[waiting, k - 1]
            for step in np.moveaxis(np.array(steps), 1, 0):
                tried = np.clip(tried + WANDER * (2.0 * step - 1.0), *arm.limits.T)
            back, up = reach(arm, tried)
            allowed = (back >= furthest_back) & (up <= arm.head)
            goals[waiting[allowed], k] = tried[allowed]
            waiting = waiting[~allowed]
            if not len(waiting):
                break
    return goals


def league_frames(model: mujoco.MjModel) -> np.ndarray:
    """Return the orientations (bodies, 4) of the league's link frames in those of this package's robots, (w, x, y, z).

    Here all frames are parallel to the base's at zero angles. In the league, each joint turns about a coordinate axis of its
    link, and frames of leaning joints lean with them.
    """
    frames = np.tile([1.0, 0.0, 0.0, 0.0], (model.nbody, 1))
    for body in range(2, model.nbody):
        axis = model.jnt_axis[model.body_jntadr[body]]
        nearest = np.eye(3)[np.abs(axis).argmax()]
        half = np.array([1.0 + nearest @ axis, *np.cross(nearest, axis)])  # half of the way from `nearest` to `axis`
        frames[body] = half / np.linalg.norm(half)
    return frames
