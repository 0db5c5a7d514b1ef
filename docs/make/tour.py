"""Film of a tour of the walking league: `python docs/make/tour.py g1_teleop --run 3 --out docs/images/tour.gif`.

The robot walks in C MuJoCo on the CPU, in the stage `punches`. A disc on the ground is the waypoint, with an arrow along its
heading. The other arrow is a punch. It lasts 0.08 s, and is drawn for half a second.
"""

import sys
from argparse import Namespace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco
import numpy as np
import torch

from legged.commandline.command import run_main
from legged.config import follows_velocities
from legged.deploy.command_parser import CommandParser, check_between
from legged.errors import ConfigError
from legged.evaluation.league.measuring import rules, with_ideal_motors
from legged.evaluation.league.protocol import CONTROL_DT, POINT_S, RUN_S
from legged.evaluation.league.robot import check_robot, league_robot
from legged.evaluation.league.task import Course, LeagueTask, make_league
from legged.mdp.control import control_gains
from legged.play.films import write_film
from legged.policies.restore import TrainedPolicy, policy_of, restore
from legged.process.paths import ready_to_write
from legged.rendering.camera import RobotsCamera
from legged.robots.robot import load_robot

EVERY = 4
"""Control steps from one picture to the next."""
SHOWN_S, METRES = 0.5, 1e-3
"""Time for which a punch is drawn [s], and length of its arrow per force [m/N]."""
RED, GREEN = (0.85, 0.15, 0.1, 1.0), (0.1, 0.6, 0.2, 0.6)


class TourCamera(RobotsCamera):
    """A camera that shows waypoint and punch of a league's robot."""

    task: LeagueTask
    _punch: tuple[int, np.ndarray] = (0, np.zeros(3))
    _left = 0

    def note(self) -> None:
        """Remember the punch of this control step."""
        every = self.task.physics.forces
        assert every is not None
        forces = every[0, :, :3].cpu().numpy().copy()
        body = int(np.abs(forces).sum(axis=1).argmax())
        if forces[body].any():
            self._punch, self._left = (body, forces[body]), round(SHOWN_S / CONTROL_DT)
        self._left -= 1

    def annotate(self, bases: np.ndarray) -> None:
        x, y, yaw = self.task.course.points[0, int(self.task._slot()[0])]
        place, ahead = np.array([x, y, 0.01]), np.array([np.cos(yaw), np.sin(yaw), 0.0])
        self.add_shape(mujoco.mjtGeom.mjGEOM_CYLINDER, GREEN, [0.1, 0.005, 0.0], place)
        self._connect(place, place + 0.3 * ahead)
        if self._left > 0:
            body, force = self._punch
            struck = self.data.xpos[body]  # the scene has one robot, whose bodies have the numbers of the model
            self._connect(struck - METRES * force, struck)

    def _connect(self, start: np.ndarray, end: np.ndarray) -> None:
        kind = mujoco.mjtGeom.mjGEOM_ARROW
        mujoco.mjv_connector(self.add_shape(kind, RED, np.zeros(3), start), kind, 0.02, start, end)


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    parser = CommandParser("tour", __doc__, "python docs/make/tour.py g1_teleop --run 3 --out docs/images/tour.gif")
    parser.add_argument("policy", metavar="TASK | RUN", help="task or run of a G1 or H1")
    parser.add_argument("--run", type=int, default=0, help="id of the league's run; 0")
    parser.add_argument("--from", type=float, dest="begin", default=60.0, help="beginning of the film in the run [s]; 60")
    parser.add_argument("--seconds", type=float, default=2.0 * POINT_S, help="length of the film [s]; 10")
    parser.add_argument("--side", type=int, default=360, help="width and height of the film [pixels]; 360")
    parser.add_argument("--out", type=Path, required=True, help="the file, .gif or .png")
    args = parser.parse_args(argv)
    check_between("--from", args.begin, 0.0, RUN_S - 1.0)
    ready_to_write(args.out.parent, 4.0)
    print(write_film(_film(policy_of(args.policy), args), args.out, 1.0 / (EVERY * CONTROL_DT)))
    return 0


def _film(policy: TrainedPolicy, args: Namespace) -> list[np.ndarray]:
    """Return the pictures of a tour."""
    given = policy.cfg
    if not follows_velocities(given):
        raise ConfigError(f"POLICY: '{given.task}' follows no velocities")
    cfg, own = with_ideal_motors(given), load_robot(given.robot)
    check_robot(own, cfg.task)
    ranges = cfg.commands.ranges
    limits = np.array([ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw])
    with TemporaryDirectory() as folder:
        course = Course.of([args.run], league_robot(own.name, Path(folder)), limits)
        changes = [*rules(cfg, course, "punches", control_gains(own, cfg.control)), ("sim.physics", "mujoco")]
        make = partial(make_league, course, "punches")
        task, act = restore(TrainedPolicy(cfg, policy.checkpoint), changes, torch.device("cpu"), False, None, make)
        camera = TourCamera(task, 1, args.side, args.side)
        camera.come_near(0.75, 0.1)
        observations, pictures = task.reset(), []
        for step in range(round((args.begin + args.seconds) / CONTROL_DT)):
            with torch.inference_mode():
                observations, _, _, _ = task.step(act(observations))
            camera.note()
            if step * CONTROL_DT >= args.begin and step % EVERY == 0:
                pictures.append(camera.picture([f"{step * CONTROL_DT:.1f} s"]))
        camera.close()
    return pictures


if __name__ == "__main__":
    sys.exit(main())
