"""The simulation of a live view: the watched policy, a few robots on the chosen ground, and the speed of the simulation."""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from legged.config import TaskConfig, follows_velocities, has_robot
from legged.envs import is_velocity_task
from legged.errors import ConfigError
from legged.learning.checkpoint import check_fits, read_checkpoint
from legged.learning.run_folder import BEST, BEST_MODEL, checkpoints, find_checkpoint, newest_run, run_config, run_named
from legged.math import yaw_of
from legged.play.live.plots import History
from legged.play.playground import SETTING, Playground
from legged.policies.actor import Actor
from legged.policies.restore import nominal, undisturbed
from legged.process.paths import relative
from legged.registry import make_task
from legged.terrain import TERRAIN_TYPES, Terrain

NEWEST = "newest"
"""The choice to follow the newest checkpoint. The alternative is BEST, if the training evaluates its policy."""
OWN, PLANE = "the task's own", "plane"
"""Kinds of ground other than a terrain type: tiles of all types of the task, and a plane."""
HOURS_S = 36000.0
"""Length of an episode of robots that follow commands. It is long, so that no time-out interrupts the view [s]."""
APART = 1.0
"""Largest distance in x and in y of a start from the tile's middle, if robots share a tile and `terrain.scale` is 1 [m]."""
MOST_ROBOTS = 16
"""Largest number of robots."""
SLOWEST, FASTEST = 0.1, 4.0
"""Limits of the speed, as multiples of real time."""
HARDEST_PUSH = 3.0
"""Largest change of a robot's velocity by one push [m/s]."""
BEHIND_S = 0.2
"""Largest delay that the simulation makes up for [s]. The rest of a longer delay is dropped."""
PACE_S = 2.0
"""Real time over which the pace is measured [s]."""
FREE_JOINT = 0
"""MuJoCo's joint type of a floating base."""


@dataclass
class Watched:
    """A run folder or a shipped policy, watched for a new checkpoint to show."""

    cfg: TaskConfig
    folder: Path
    checkpoint: int | None = None
    """Iteration of the checkpoint that is shown; None to follow the training."""
    choice: str = NEWEST
    """Checkpoint that is followed, NEWEST or BEST. It has no effect if `checkpoint` is an iteration."""
    shown: tuple[Path, int, int] | None = field(default=None, init=False)
    """File that `changed` returned last, with the time of its last change [ns] and its size [bytes]. If this is set to None,
    the next call returns the file again.
    """

    @property
    def has_best(self) -> bool:
        """Return whether BEST can be chosen."""
        return self.checkpoint is None and (self.folder / BEST_MODEL).is_file()

    def wanted(self) -> Path | None:
        """Return the checkpoint to show; None before the first one is written."""
        found = checkpoints(self.folder)
        if self.checkpoint is not None:
            return found.get(self.checkpoint)
        if self.choice == BEST and self.has_best:
            return self.folder / BEST_MODEL
        return found[max(found)] if found else None

    def changed(self) -> Path | None:
        """Return the checkpoint to show if the file is new or was rewritten since the last call, else None."""
        path = self.wanted()
        if path is None:
            return None
        try:
            stat = path.stat()
        except OSError:  # the file has just been removed
            return None
        before, self.shown = self.shown, (path, stat.st_mtime_ns, stat.st_size)
        return None if self.shown == before else path


def find_watched(name: str | None, checkpoint: int | str | None) -> Watched:
    """Return the run that the user named as POLICY (`name`), or the newest run if `name` is None. The run need not have a
    checkpoint yet. `checkpoint` is an iteration, BEST, or None for the newest checkpoint.

    Raises:
        ConfigError: there is no such run, or it has no such checkpoint.
    """
    folder = newest_run("POLICY") if name is None else run_named(name, "POLICY", begun=True)
    cfg = run_config(folder)
    if checkpoint in (None, -1):
        return Watched(cfg, folder)
    find_checkpoint(folder, checkpoint)
    return Watched(cfg, folder, choice=BEST) if checkpoint == BEST else Watched(cfg, folder, int(checkpoint or 0))


def grounds_of(cfg: TaskConfig) -> list[str]:
    """Return the kinds of ground that can be chosen, the task's own first. There is only one if the model has its own floor
    or the task's terrain is a single tile.
    """
    if not has_robot(cfg):
        return [OWN]
    on_plane = cfg.terrain.mesh_type == "plane"
    if not on_plane and cfg.terrain.num_rows * cfg.terrain.num_cols == 1:
        return [OWN]
    return [PLANE if on_plane else OWN, *TERRAIN_TYPES]


def check_ground(cfg: TaskConfig, kind: str | None, difficulty: float | None) -> str:
    """Return the kind of ground for the options --terrain and --difficulty: OWN, PLANE or a terrain type.

    Raises:
        ConfigError: the type or the difficulty does not exist, or the task has a single ground.
    """
    kinds = grounds_of(cfg)
    if len(kinds) > 1 or not has_robot(cfg):
        Playground.of(cfg, kind, difficulty)
        return kinds[0] if kind is None else kind
    for flag, given in (("terrain", kind), ("difficulty", difficulty)):
        if given is not None:
            raise ConfigError(f"--{flag}: '{cfg.task}' has no terrain to choose: its ground is fixed")
    return kinds[0]


def changes_for(cfg: TaskConfig, num_envs: int, asked: Sequence[tuple[str, Any]]) -> list[tuple[str, Any]]:
    """Return overrides for `num_envs` undisturbed robots; the overrides in `asked` may disturb them."""
    # On the only ground, the task's own length ends episodes before robots reach a tile's edge.
    seconds = HOURS_S if follows_velocities(cfg) and len(grounds_of(cfg)) > 1 else None
    return [*undisturbed(cfg, num_envs, seconds), *asked, ("env.num_envs", num_envs)]


class Session:
    """Simulation of a few robots that a policy controls; not thread-safe."""

    def __init__(
        self,
        watched: Watched,
        changes: Sequence[tuple[str, Any]],
        kind: str,
        difficulty: float | None = None,
        device: torch.device | str = "cpu",
        graph: bool = False,
    ) -> None:
        """Build the task of the watched policy, with the overrides `changes`, and load the present checkpoint. The `kind` of
        ground is OWN, PLANE or a terrain type; the `difficulty` of tiles is 0 to 1, by default that of `play`.

        Raises:
            ConfigError: the task cannot be built, or the policy does not fit it.
        """
        self.watched, self.changes = watched, list(changes)
        self.device, self._graph = torch.device(device), graph
        self.grounds = grounds_of(watched.cfg)
        """Kinds of ground that can be chosen; if there is only one, there is no choice."""
        self.iteration: int | None = None
        """Training iterations of the loaded policy; None without a checkpoint."""
        self.checkpoint = watched.wanted()
        """File of the loaded policy."""
        self.problem = ""
        """Reason why a newer checkpoint or another ground was refused; empty if none was."""
        self.running, self.speed = True, 1.0
        self.time = 0.0
        """Simulated time since the start of the session [s]."""
        self.followed = 0
        """Number of the robot that the camera follows and the plots show."""
        self.pace = 1.0
        """Measured speed over the last PACE_S as a share of the chosen speed. It is below 1 if the machine is too slow."""
        self._due = self._wanted = self._made = 0.0
        if self.checkpoint is not None:  # check the checkpoint before anything is built
            check_fits(self.checkpoint, read_checkpoint(self.checkpoint), watched.cfg)
        self._build(kind, difficulty)
        self.command = self.clipped([0.0, 0.0, 0.0])
        """Command of all robots: vx, vy [m/s], yaw rate [rad/s]."""
        if self.problem:
            raise ConfigError(self.problem)

    # ---- the policy --------------------------------------------------------------------------------------------------

    def follow(self, choice: str) -> None:
        """Show the NEWEST or the BEST checkpoint from now on."""
        self.watched.choice = choice
        self.look()

    def look(self) -> bool:
        """If the checkpoint to show has changed, load it; return whether a policy was loaded. If loading fails, `problem`
        holds the reason, and the present policy stays in use.
        """
        path = self.watched.changed()
        if path is None:
            return False
        try:
            check_fits(path, read_checkpoint(path), self.watched.cfg)
            self.iteration = self.act.load(path)
        except ConfigError as error:
            self.problem = str(error)
            return False
        self.checkpoint, self.problem = path, ""
        return True

    def title(self) -> str:
        """Return a line about the loaded policy."""
        task = self.task.cfg.task
        if self.checkpoint is None or self.iteration is None:
            return f"{task}: no checkpoint yet in {relative(self.watched.folder)}; robots keep their default pose"
        written = ""
        if self.checkpoint.stem.startswith("model_"):
            with suppress(OSError):  # the file may have been removed
                written = f", written {ago(max(0.0, time.time() - self.checkpoint.stat().st_mtime))}"
        return f"{task}: iteration {self.iteration}{written} ({relative(self.checkpoint)})"

    # ---- time --------------------------------------------------------------------------------------------------------

    def pass_time(self, seconds: float) -> int:
        """Make the control steps that are due after `seconds` of real time [s]; return the number of steps."""
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
        if self.has_commands:
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
        self.history.rows.clear()

    def set_speed(self, speed: float) -> None:
        """Set the speed of the simulation as a multiple of real time."""
        self.speed = min(max(float(speed), SLOWEST), FASTEST)

    # ---- commands, pushes and ground ---------------------------------------------------------------------------------

    def clipped(self, command: Sequence[float]) -> list[float]:
        """Return a command of vx, vy [m/s] and yaw rate [rad/s], clipped to the ranges of the training."""
        ranges = self.ranges or [[0.0, 0.0]] * 3
        return [min(max(float(value), low), high) for value, (low, high) in zip(command, ranges, strict=True)]

    def ask(self, axis: int, value: float) -> None:
        """Set one component of the command: 0 vx, 1 vy [m/s], 2 yaw rate [rad/s]."""
        self.command = self.clipped([*self.command[:axis], value, *self.command[axis + 1 :]])

    def stand(self) -> None:
        """Set each component of the command to zero or, if its range lacks zero, to the limit that is nearest to zero."""
        self.command = self.clipped([0.0, 0.0, 0.0])

    def select(self, robot: int) -> None:
        """Follow another robot."""
        self.followed = min(max(int(robot), 0), self.task.num_envs - 1)
        self.history.rows.clear()

    @torch.inference_mode()
    def push(self, degrees: float, strength: float, everybody: bool = False) -> None:
        """Push the followed robot, or all robots if `everybody`. A push changes the velocity of the base by `strength` [m/s].
        Its direction is `degrees` to the left of the robot's heading.
        """
        if not self.can_be_pushed:
            return
        strength = min(max(strength, 0.0), HARDEST_PUSH)
        angle = yaw_of(self.task.physics.qpos[:, 3:7]) + np.radians(degrees)
        mask = torch.full((self.task.num_envs,), everybody, device=self.device)
        mask[self.followed] = True
        self.task.physics.push(mask, strength * torch.stack([angle.cos(), angle.sin()], dim=1))
        self.task.sense()

    def go_to(self, kind: str, difficulty: float | None) -> None:
        """Move the robots to another `kind` of ground: OWN, PLANE or a terrain type, with tiles of a `difficulty`, 0 to 1. If
        the ground cannot be built, `problem` holds the reason, and the present ground stays.
        """
        try:
            self._build(kind, difficulty)
        except ConfigError as error:
            self.problem = str(error)

    def place(self) -> str:
        """Return a description of the ground below the followed robot, such as 'stairs_up, step height 0.194 m'."""
        if self.playground is None:
            return PLANE if self.kind == PLANE else ""
        return self.playground.label(self.task.terrain, self.task.base_pos[self.followed].tolist())

    def _build(self, kind: str, difficulty: float | None) -> None:
        """Build the task on a ground, and load the present checkpoint.

        Raises:
            ConfigError: the configuration cannot be built, or tiles are too small.
        """
        cfg = nominal(self.watched.cfg, self.changes)
        playground: Playground | None = None
        terrain: Terrain | None = None
        if kind != PLANE and len(self.grounds) > 1:
            playground = Playground.of(cfg, None if kind == OWN else kind, difficulty)
        if has_robot(cfg) and playground is not None:
            setting: list[tuple[str, Any]] = [*SETTING]
            if cfg.env.num_envs > len(playground.order):
                side = min(cfg.terrain.terrain_length, cfg.terrain.terrain_width)
                setting.append(("terrain.spawn_range", min(APART * cfg.terrain.scale, 0.2 * side)))
            cfg = nominal(self.watched.cfg, [*setting, *self.changes, *playground.changes(cfg)])
            terrain = playground.build(cfg)  # type: ignore[arg-type]
        self.task: Any = make_task(cfg, self.device, self._graph, terrain)
        self.can_be_pushed = self.task.physics.model.jnt_type[:1].tolist() == [FREE_JOINT]
        """True if the base floats, because only floating bases can be pushed."""
        self.has_commands = is_velocity_task(self.task)
        self.ranges: list[list[float]] = self.task.command_sampler.full_ranges.tolist() if self.has_commands else []
        """Ranges of vx, vy [m/s] and yaw rate [rad/s] in training; empty for tasks without commands."""
        self.playground, self.kind, self.difficulty = playground, kind, difficulty
        if playground is not None:
            playground.place(self.task)
        self.act = Actor(self.task, self.device)
        self.history = History(self.task)
        self.followed = min(self.followed, self.task.num_envs - 1)
        self.reset()
        self.iteration = self.watched.shown = None
        self.look()


def ago(seconds: float) -> str:
    """Return a duration as '12 s ago', '3 min ago', '2 h ago' or '5 days ago'."""
    for unit, length, until in (("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, 172800.0)):
        if seconds < until:
            return f"{seconds / length:.0f} {unit} ago"
    return f"{seconds / 86400.0:.0f} days ago"
