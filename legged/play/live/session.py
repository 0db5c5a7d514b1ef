"""What a live view shows and can be told, without the page: a few robots, their policy, and how time passes for them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from legged.config import TaskConfig
from legged.envs import BaseTask, LeggedRobot
from legged.errors import ConfigError
from legged.learning.checkpoint import check_fits, read_checkpoint
from legged.learning.run_folder import BEST
from legged.play.live.ground import PLANE, ChosenGround, build, grounds_of
from legged.play.live.history import History
from legged.play.live.source import NEWEST, CheckpointFollower, Watched, age
from legged.policies.actor import Actor
from legged.process.paths import relative

MOST_ROBOTS = 16
"""So many are shown at most."""
SLOWEST, FASTEST = 0.1, 4.0
"""Speeds of time, as multiples of the real one."""
HARDEST_PUSH = 3.0
"""Largest change of a robot's velocity by one push [m/s]."""
BEHIND_S = 0.2
"""More time than this is never made up for: the machine is too slow, or was busy [s]."""
PACE_S = 2.0
"""How long the pace is measured [s]."""
FREE_JOINT = 0
"""MuJoCo's number of the type of joint that lets a base float."""


class Session:
    """A few robots under a policy. All calls come from one thread."""

    def __init__(
        self,
        watched: Watched,
        changes: Sequence[tuple[str, Any]],
        ground: ChosenGround,
        device: torch.device | str = "cpu",
        graph: bool = False,
    ) -> None:
        """Build the task of the watched policy's configuration with `changes` on `ground`, and take the policy that there is.

        Raises:
            ConfigError: the task can't be built, or the policy does not fit it.
        """
        self.watched, self.changes, self.ground = watched, list(changes), ground
        self.device, self._graph = torch.device(device), graph
        self.follower = CheckpointFollower(watched)
        self.iteration: int | None = None
        """How many iterations the policy on show was trained for; none while there is no checkpoint."""
        self.checkpoint = self.follower.wanted()
        """The file that it comes from."""
        self.problem = ""
        """Why a newer checkpoint, or another ground, could not be taken; empty where nothing is wrong."""
        self.running = True
        self.speed = 1.0
        self.time = 0.0
        """Since the session began, as simulated [s]."""
        self.followed = 0
        """The robot that is followed and plotted."""
        self.command = [0.0, 0.0, 0.0]
        """What all robots are asked: vx, vy [m/s], yaw rate [rad/s]."""
        self.pace = 1.0
        """Share of the steps that were due lately which could be made: less than 1 where the machine is too slow."""
        self._due = self._wanted = self._made = 0.0
        if self.checkpoint is not None:  # before anything is built
            self._check(self.checkpoint)
        self._build(ground)
        self.command = self.clipped(self.command)
        self.reset()
        self.look()
        if self.problem:
            raise ConfigError(self.problem)

    # ---- what there is -----------------------------------------------------------------------------------------------

    @property
    def cfg(self) -> TaskConfig:
        """Return the configuration of the task on show."""
        return self.task.cfg

    @property
    def has_commands(self) -> bool:
        """Whether robots are told how fast to go."""
        return isinstance(self.task, LeggedRobot)

    @property
    def can_be_pushed(self) -> bool:
        """Whether the robots' base floats, so that a push has a direction."""
        joints = self.task.physics.model.jnt_type
        return len(joints) > 0 and int(joints[0]) == FREE_JOINT

    @property
    def grounds(self) -> list[str]:
        """Return the kinds of ground that can be chosen; one alone where there is nothing to choose."""
        return grounds_of(self.watched.cfg)

    @property
    def ranges(self) -> list[tuple[float, float]]:
        """Return the lowest and the highest vx, vy [m/s] and yaw rate [rad/s] that was trained; nothing without commands."""
        if not isinstance(self.task, LeggedRobot):
            return []
        return [(low, high) for low, high in self.task.command_sampler.full_ranges.tolist()]

    # ---- the policy --------------------------------------------------------------------------------------------------

    def follow(self, choice: str) -> None:
        """Show the newest checkpoint from now on, or the best."""
        if choice not in (NEWEST, BEST):
            raise ValueError(f"there is no checkpoint '{choice}'")
        self.follower.choice = choice
        self.look()

    def look(self) -> bool:
        """Take the checkpoint that is to be shown, if it is another one; return whether it was. One that can't be taken is
        named in `problem`, and the policy before stays.
        """
        path = self.follower.changed()
        if path is None:
            return False
        try:
            self._check(path)
            self.iteration = self.act.load(path)
        except ConfigError as error:
            self.problem = str(error)
            return False
        self.checkpoint, self.problem = path, ""
        return True

    def _check(self, path: Any) -> None:
        check_fits(path, read_checkpoint(path), self.watched.cfg)

    def title(self) -> str:
        """Say in a line which policy is on show."""
        if self.checkpoint is None or self.iteration is None:
            return f"{self.cfg.task}: no checkpoint yet in {relative(self.watched.folder)}; robots keep their default pose"
        name = relative(self.checkpoint)
        seconds = age(self.checkpoint)
        written = "" if seconds is None or not self.checkpoint.stem.startswith("model_") else f", written {ago(seconds)}"
        return f"{self.cfg.task}: iteration {self.iteration}{written} ({name})"

    # ---- time --------------------------------------------------------------------------------------------------------

    def pass_time(self, seconds: float) -> int:
        """Let so much of the real time pass [s]: make the control steps that are due by it, and return how many."""
        if not self.running:
            self._due = 0.0
            return 0
        self._due = min(self._due + self.speed * seconds, max(BEHIND_S * self.speed, self.task.dt))
        steps = int(self._due / self.task.dt + 1e-9)
        for _ in range(steps):
            self.step()
        self._due -= steps * self.task.dt
        self._wanted += self.speed * seconds
        self._made += steps * self.task.dt
        if self._wanted > self.speed * PACE_S:
            self.pace = min(1.0, self._made / self._wanted)
            self._wanted = self._made = 0.0
        return steps

    @torch.inference_mode()
    def step(self) -> None:
        """Make one control step of all robots."""
        if isinstance(self.task, LeggedRobot):
            self.observations = self.task.hold_commands(torch.tensor(self.command, device=self.device))
        if self.iteration is None:
            actions = torch.zeros(self.task.num_envs, self.task.num_actions, device=self.device)
        else:
            actions = self.act(self.observations)
        self.observations, _, _, _ = self.task.step(actions)
        self.time += self.task.dt
        self.history.add(self.task, self.followed, self.time)

    @torch.inference_mode()
    def reset(self) -> None:
        """Put all robots back to where they start."""
        self.observations = self.task.reset()
        self.history.clear()

    def set_speed(self, speed: float) -> None:
        """Let time pass so many times as fast as it does."""
        self.speed = min(max(float(speed), SLOWEST), FASTEST)

    # ---- what the robots are told ------------------------------------------------------------------------------------

    def clipped(self, command: Sequence[float]) -> list[float]:
        """Return the nearest command to vx, vy [m/s], yaw rate [rad/s] that was trained."""
        ranges = self.ranges
        if not ranges:
            return [0.0, 0.0, 0.0]
        return [min(max(float(value), low), high) for value, (low, high) in zip(command, ranges, strict=True)]

    def ask(self, axis: int, value: float) -> None:
        """Ask all robots for a velocity along an axis: 0 vx, 1 vy [m/s], 2 yaw rate [rad/s]."""
        wanted = [*self.command]
        wanted[axis] = value
        self.command = self.clipped(wanted)

    def stand(self) -> None:
        """Ask all robots to stand, or to go as slowly as they were trained to."""
        self.command = self.clipped([0.0, 0.0, 0.0])

    def select(self, robot: int) -> None:
        """Follow another robot."""
        self.followed = min(max(int(robot), 0), self.task.num_envs - 1)
        self.history.clear()

    @torch.inference_mode()
    def push(self, degrees: float, strength: float, everybody: bool = False) -> None:
        """Change the velocity of the followed robot's base, or of all, by `strength` [m/s], towards so many degrees to the
        left of where it looks.
        """
        if not self.can_be_pushed:
            return
        strength = min(max(strength, 0.0), HARDEST_PUSH)
        w, x, y, z = self.task.physics.qpos[:, 3:7].unbind(dim=1)
        angle = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) + np.radians(degrees)
        mask = torch.ones(self.task.num_envs, dtype=torch.bool, device=self.device)
        if not everybody:
            mask.fill_(False)
            mask[self.followed] = True
        self.task.physics.push(mask, strength * torch.stack([angle.cos(), angle.sin()], dim=1))
        self.task.sense()

    def go_to(self, kind: str, difficulty: float | None) -> None:
        """Put the robots on tiles of a type and a difficulty, 0 to 1; or on the task's own ground, or a plane. What can't be
        built is named in `problem`, and the ground before stays.
        """
        if kind not in self.grounds:
            raise ValueError(f"there is no ground '{kind}' for {self.cfg.task}")
        try:
            self._build(ChosenGround(kind, difficulty))
        except ConfigError as error:
            self.problem = str(error)
            return
        self.reset()
        self.follower.forget()
        self.iteration = None
        self.look()

    def place(self) -> str:
        """Name the ground below the followed robot: 'stairs_up, step height 0.194 m'."""
        terrain = getattr(self.task, "terrain", None)
        if self.playground is None or terrain is None:
            return PLANE if self.ground.kind == PLANE else ""
        return self.playground.label(terrain, self.task.base_pos[self.followed].tolist())

    def _build(self, ground: ChosenGround) -> None:
        """Build the task on a ground; the robots have not been reset."""
        task, playground = build(self.watched.cfg, self.changes, ground, self.device, self._graph)
        assert isinstance(task, BaseTask)
        self.task: Any = task
        self.playground, self.ground = playground, ground
        if playground is not None:
            playground.place(self.task)
        self.act = Actor(self.task, self.device)
        self.history = History(self.task)
        self.followed = min(self.followed, self.task.num_envs - 1)


def ago(seconds: float) -> str:
    """Say how long ago something was: '12 s ago', '3 min ago', '2 h ago', '5 days ago'."""
    for unit, length, until in (("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, 172800.0)):
        if seconds < until:
            return f"{seconds / length:.0f} {unit} ago"
    return f"{seconds / 86400.0:.0f} days ago"
