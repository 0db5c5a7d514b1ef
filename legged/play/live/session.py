"""The simulation behind a live view: a few robots, their policy, and the pace of time."""

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
"""Largest number of robots."""
SLOWEST, FASTEST = 0.1, 4.0
"""Limits of the speed, as multiples of real time."""
HARDEST_PUSH = 3.0
"""Largest change of a robot's velocity by one push [m/s]."""
BEHIND_S = 0.2
"""Largest delay that is made up for; longer ones mean that the machine is too slow or was busy [s]."""
PACE_S = 2.0
"""Time over which the pace is measured [s]."""
FREE_JOINT = 0
"""MuJoCo's joint type of a floating base."""


class Session:
    """A few robots under a policy; not thread-safe."""

    def __init__(
        self,
        watched: Watched,
        changes: Sequence[tuple[str, Any]],
        ground: ChosenGround,
        device: torch.device | str = "cpu",
        graph: bool = False,
    ) -> None:
        """Build the task of the watched policy's configuration with `changes` on `ground`, and load the present checkpoint.

        Raises:
            ConfigError: the task cannot be built, or the policy does not fit it.
        """
        self.watched, self.changes, self.ground = watched, list(changes), ground
        self.device, self._graph = torch.device(device), graph
        self.follower = CheckpointFollower(watched)
        self.iteration: int | None = None
        """Training iterations of the loaded policy; None without a checkpoint."""
        self.checkpoint = self.follower.wanted()
        """File of the loaded policy."""
        self.problem = ""
        """Reason why a newer checkpoint or another ground was refused; empty if none was."""
        self.running = True
        self.speed = 1.0
        self.time = 0.0
        """Simulated time since the start of the session [s]."""
        self.followed = 0
        """Number of the robot that the camera follows and the plots show."""
        self.command = [0.0, 0.0, 0.0]
        """Command of all robots: vx, vy [m/s], yaw rate [rad/s]."""
        self.pace = 1.0
        """Share of the recently due steps that were made: below 1 if the machine is too slow."""
        self._due = self._wanted = self._made = 0.0
        if self.checkpoint is not None:  # before anything is built
            self._check(self.checkpoint)
        self._build(ground)
        self.command = self.clipped(self.command)
        self.reset()
        self.look()
        if self.problem:
            raise ConfigError(self.problem)

    # ---- state ------------------------------------------------------------------------------------------------------

    @property
    def cfg(self) -> TaskConfig:
        """Return the configuration of the present task."""
        return self.task.cfg

    @property
    def has_commands(self) -> bool:
        """Return whether the robots follow velocity commands."""
        return isinstance(self.task, LeggedRobot)

    @property
    def can_be_pushed(self) -> bool:
        """Return whether the base floats, as a push requires."""
        joints = self.task.physics.model.jnt_type
        return len(joints) > 0 and int(joints[0]) == FREE_JOINT

    @property
    def grounds(self) -> list[str]:
        """Return the kinds of ground that can be chosen; a single one means that there is no choice."""
        return grounds_of(self.watched.cfg)

    @property
    def ranges(self) -> list[tuple[float, float]]:
        """Return the ranges of vx, vy [m/s] and yaw rate [rad/s] in training; empty for tasks without commands."""
        if not isinstance(self.task, LeggedRobot):
            return []
        return [(low, high) for low, high in self.task.command_sampler.full_ranges.tolist()]

    # ---- the policy --------------------------------------------------------------------------------------------------

    def follow(self, choice: str) -> None:
        """Show the newest or the best checkpoint from now on."""
        if choice not in (NEWEST, BEST):
            raise ValueError(f"there is no checkpoint '{choice}'")
        self.follower.choice = choice
        self.look()

    def look(self) -> bool:
        """Load the checkpoint to show if it has changed; return whether a policy was loaded. If loading fails, `problem`
        holds the reason and the present policy stays in use.
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
        """Return a line about the loaded policy."""
        if self.checkpoint is None or self.iteration is None:
            return f"{self.cfg.task}: no checkpoint yet in {relative(self.watched.folder)}; robots keep their default pose"
        name = relative(self.checkpoint)
        seconds = age(self.checkpoint)
        written = "" if seconds is None or not self.checkpoint.stem.startswith("model_") else f", written {ago(seconds)}"
        return f"{self.cfg.task}: iteration {self.iteration}{written} ({name})"

    # ---- time --------------------------------------------------------------------------------------------------------

    def pass_time(self, seconds: float) -> int:
        """Make the control steps that are due after some real time [s]; return their number."""
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
        """Reset all robots."""
        self.observations = self.task.reset()
        self.history.clear()

    def set_speed(self, speed: float) -> None:
        """Set the speed of the simulation as a multiple of real time."""
        self.speed = min(max(float(speed), SLOWEST), FASTEST)

    # ---- commands, pushes and ground ---------------------------------------------------------------------------------

    def clipped(self, command: Sequence[float]) -> list[float]:
        """Return a command of vx, vy [m/s] and yaw rate [rad/s], clipped to the ranges of the training."""
        ranges = self.ranges
        if not ranges:
            return [0.0, 0.0, 0.0]
        return [min(max(float(value), low), high) for value, (low, high) in zip(command, ranges, strict=True)]

    def ask(self, axis: int, value: float) -> None:
        """Set one component of the command: 0 vx, 1 vy [m/s], 2 yaw rate [rad/s]."""
        wanted = [*self.command]
        wanted[axis] = value
        self.command = self.clipped(wanted)

    def stand(self) -> None:
        """Set the command to zero, or to the slowest one of the training."""
        self.command = self.clipped([0.0, 0.0, 0.0])

    def select(self, robot: int) -> None:
        """Follow another robot."""
        self.followed = min(max(int(robot), 0), self.task.num_envs - 1)
        self.history.clear()

    @torch.inference_mode()
    def push(self, degrees: float, strength: float, everybody: bool = False) -> None:
        """Change the velocity of the followed robot's base, or of all bases with `everybody`, by `strength` [m/s], in a
        direction that is `degrees` to the left of the heading.
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
        """Move the robots to tiles of a type and a difficulty, 0 to 1, to the task's own ground, or to a plane. If it cannot
        be built, `problem` has the reason and the present ground stays.
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
        """Return a description of the ground below the followed robot: 'stairs_up, step height 0.194 m'."""
        terrain = getattr(self.task, "terrain", None)
        if self.playground is None or terrain is None:
            return PLANE if self.ground.kind == PLANE else ""
        return self.playground.label(terrain, self.task.base_pos[self.followed].tolist())

    def _build(self, ground: ChosenGround) -> None:
        """Build the task on a ground, without a reset."""
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
    """Return a duration as '12 s ago', '3 min ago', '2 h ago' or '5 days ago'."""
    for unit, length, until in (("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, 172800.0)):
        if seconds < until:
            return f"{seconds / length:.0f} {unit} ago"
    return f"{seconds / 86400.0:.0f} days ago"
