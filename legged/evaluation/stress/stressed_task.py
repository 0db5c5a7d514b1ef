"""A task whose robots each have a disturbance of their own, all in one simulation."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from legged.config import LeggedConfig
from legged.envs import LeggedRobot
from legged.evaluation.stress.table import PUSH_INTERVAL, Disturbance
from legged.math import masked_set_, quat_rotate
from legged.mdp.height_scan import HeightScan
from legged.physics import FIELDS, Scene
from legged.registry import task_class
from legged.terrain import Terrain


def declared(rows: Sequence[Disturbance]) -> list[tuple[str, Any]]:
    """Return overrides that a task needs for these disturbances: what will be given to the physics, and pushes."""
    pushes = max(row.push for row in rows)
    changes: list[tuple[str, Any]] = [("domain_rand.ranges", {"friction": [1.0, 1.0], "added_base_mass": [0.0, 0.0]})]
    if pushes > 0.0:
        changes += [
            ("domain_rand.push_robots", True),
            ("domain_rand.push_interval_s", PUSH_INTERVAL),
            ("domain_rand.max_push_vel_xy", pushes),
        ]
    return changes


def make_stressed(
    cfg: LeggedConfig, rows: Sequence[Disturbance], device: torch.device, graph: bool, terrain: Terrain | None
) -> LeggedRobot:
    """Build the task of a configuration with robots of `rows`, one each (N)."""
    kind: Any = task_class(cfg.task)
    stressed: Any = type(f"Stressed{kind.__name__}", (StressedTask, kind), {"rows": tuple(rows), "__module__": __name__})
    other_ground = {} if terrain is None else {"terrain": terrain}  # a user's constructor may not know the argument
    return stressed(cfg, device, graph, **other_ground)


class StressedTask(LeggedRobot):
    """What is put before a task's class, so that each robot has the disturbance of its row. Random numbers of disturbances
    are drawn once, by a generator of their own: what the task draws stays as it is.
    """

    rows: tuple[Disturbance, ...] = ()
    """One for each of the N robots."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Build the task, then give the physics frictions and masses, which nothing changes afterwards."""
        super().__init__(*args, **kwargs)
        self.physics.randomize("friction", self._frictions())
        self.physics.randomize("added_base_mass", self._per_robot("payload"))
        self.reset()

    def _per_robot(self, name: str) -> Tensor:
        """Return one number of each robot's disturbance, (N,)."""
        values = [float(getattr(row, name)) for row in self.rows]
        return torch.tensor(values, dtype=torch.float32, device=torch.device(self.device))

    def make_scene(self) -> Scene:
        self._scene = super().make_scene()
        return self._scene

    def _frictions(self) -> Tensor:
        """Return the friction of each robot, (N,), or of each of its shapes if they differ by themselves, (N, shapes)."""
        model = self.physics.model
        own = [float(value) for value in model.geom_friction[FIELDS["friction"].rows(self._scene, model), 0]]
        shapes = own[:1] if len(set(own)) == 1 else own
        values = [[value if row.friction is None else row.friction for value in shapes] for row in self.rows]
        return torch.tensor(values, dtype=torch.float32, device=torch.device(self.device)).squeeze(1)

    def _init_buffers(self) -> None:
        super()._init_buffers()
        n, device = self.num_envs, torch.device(self.device)
        random = torch.Generator().manual_seed(self.cfg.env.seed)

        def draw(*shape: int) -> Tensor:
            """Return U(-1, 1), the same on every device."""
            return (2.0 * torch.rand(n, *shape, generator=random) - 1.0).to(device)

        self._strength = self._per_robot("motors").unsqueeze(1)
        self._pushed = self._per_robot("push") > 0.0
        late = (self._per_robot("delay") / self.dt).round().long()
        self._sent = torch.zeros(n, int(late.max()) + 1, self.num_actions, device=device)
        """(N, K + 1, D) the last actions of the policy, newest first."""
        self._late = late.view(n, 1, 1).expand(n, 1, self.num_actions).contiguous()
        self._policy_actions = torch.zeros_like(self.actions)
        self._true_dof_pos = self.dof_pos
        self._zero_offset = self._per_robot("zero_offset").unsqueeze(1) * draw(self.robot.num_dof)
        self.dof_pos = self._true_dof_pos + self._zero_offset
        """(N, D) joint angles as the encoders report them [rad]."""
        half, axis = 0.5 * self._per_robot("tilt"), torch.pi * draw()
        level = (half.sin() * axis.cos(), half.sin() * axis.sin())
        self._mounting = torch.stack([half.cos(), *level, torch.zeros_like(half)], dim=1)
        self._map = HeightScan(self.cfg.terrain, self.terrain, n, device, self.physics.kernels)
        direction, sign = torch.pi * draw(), torch.where(draw() < 0.0, -1.0, 1.0)
        shift = torch.stack([direction.cos(), direction.sin(), torch.zeros_like(direction)], dim=1)
        self._map_shift = self._per_robot("map_shift").unsqueeze(1) * shift
        self._map_place = torch.zeros_like(self._map_shift)  # launches know it by its address
        self._map_height = (sign * self._per_robot("map_height")).unsqueeze(1)
        points = self.measured_heights.shape[1]
        self._unseen = 0.5 * (draw(points) + 1.0) < self._per_robot("map_holes").unsqueeze(1)
        self.measured_heights = torch.zeros_like(self.measured_heights)
        """(N, P) heights of the ground as the robot's map has them [m]."""

    # ---- motors ------------------------------------------------------------------------------------------------------

    def set_controls(self) -> None:
        """Give the motors what the policy wanted some steps ago. What it observes of its last action is what it sent."""
        self._sent[:, 1:].copy_(self._sent[:, :-1].clone())
        self._sent[:, 0].copy_(self.actions)
        self._policy_actions.copy_(self.actions)
        self.actions.copy_(self._sent.gather(1, self._late).squeeze(1))
        super().set_controls()
        self.actions.copy_(self._policy_actions)

    def apply_control(self) -> None:
        """Let the law of control see what encoders report, and weaken what comes of it."""
        self._read_encoders()
        super().apply_control()
        self.physics.ctrl.mul_(self._strength)

    def reset_idx(self, mask: Tensor) -> None:
        super().reset_idx(mask)
        masked_set_(self._sent, mask, 0.0)

    def disturb(self, mask: Tensor) -> None:
        super().disturb(mask & self._pushed)

    # ---- sensors -----------------------------------------------------------------------------------------------------

    def _read_encoders(self) -> None:
        torch.add(self._true_dof_pos, self._zero_offset, out=self.dof_pos)

    def sense(self) -> None:
        super().sense()
        self._read_encoders()
        torch.add(self.base_pos, self._map_shift, out=self._map_place)
        self._map.update(self._map_place, self.base_quat)
        torch.add(self._map.heights, self._map_height, out=self.measured_heights)
        under = self.height_scan.ground.unsqueeze(1)
        self.measured_heights.copy_(torch.where(self._unseen, under, self.measured_heights))

    def _obs_projected_gravity(self) -> Tensor:
        return quat_rotate(self._mounting, super()._obs_projected_gravity())

    def _obs_base_ang_vel(self) -> Tensor:
        return quat_rotate(self._mounting, super()._obs_base_ang_vel())
