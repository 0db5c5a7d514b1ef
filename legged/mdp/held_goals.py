"""Moving goals for joints without an action, such as arms that work while the legs walk."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from legged.config.randomization import DrawConfig, HeldGoalsConfig
from legged.config.robot import RobotControlConfig
from legged.errors import ConfigError
from legged.math import masked_set_
from legged.mdp.control import acted_joints
from legged.mdp.mirror_images import mirror_of_actions
from legged.physics import Physics
from legged.robots.patterns import match_names, match_values
from legged.robots.robot import Robot

LARGEST_STEP = 4.0
"""Largest change from one goal to the next, in standard deviations."""


class HeldGoals:
    """Random walk of the goals of K held joints, in each of N robots. Of these joints, W walk on their own; with `mirrored`,
    the others mirror them.
    """

    STATE = ("left", "begin", "goal", "offsets")

    def __init__(
        self,
        cfg: HeldGoalsConfig,
        robot: Robot,
        control: RobotControlConfig,
        num_envs: int,
        dt: float,
        device: torch.device,
        where: Callable[[str], str] = str,
    ) -> None:
        """Hold all joints at their default angles. The first `act` draws goals. `dt` is the control step [s]. `where` turns a
        dotted path into the beginning of an error message.

        Raises:
            ConfigError: as for `held_walk`.
        """

        def tensor(values: Sequence[float] | np.ndarray) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        held, walking, source, signs, limits = held_walk(cfg, robot, control, where)
        most = LARGEST_STEP * cfg.step
        draw = DrawConfig(range=(-most, most), distribution="gaussian", std=cfg.step, grow=cfg.grow)
        self.WIDTH = len(walking)
        """Number of random columns of a new goal: one change for each walking joint."""
        self.columns, self.start = [draw] * self.WIDTH, [0.0] * self.WIDTH
        """Distribution of each random column, and the value that its range starts from."""
        self._dt, self._period = dt, cfg.period_s
        self._low, self._high = tensor((limits - robot.default_dof_pos[list(walking), None]).T)
        self._source, self._signs = torch.tensor(source, device=device), tensor(signs)
        self.left = torch.zeros(num_envs, device=device)
        """(N,) time until the goals are reached [s]."""
        self.begin, self.goal = torch.zeros(2, num_envs, self.WIDTH, device=device).unbind()
        """(N, W) previous and present goals of the walking joints, minus their default angles [rad]."""
        self.offsets = torch.zeros(num_envs, len(held), device=device)
        """(N, K) targets of the held joints in the next control step, minus their default angles [rad]."""

    def take(self, drawn: Tensor) -> None:
        """Use the tensor `drawn` (N, W), which holds each robot's next change of its goals [rad]."""
        self._drawn = drawn

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Move the targets by a control step, and draw new goals where the last ones are reached. Robots outside `mask` (N,)
        begin an episode: their targets are the default angles, and their goals are new.
        """
        begun = ~mask
        self.left.sub_(self._dt)
        due = (self.left <= 0.5 * self._dt) | begun
        masked_set_(self.begin, due, self.goal)
        masked_set_(self.begin, begun, 0.0)
        masked_set_(self.goal, due, torch.clamp(self.begin + self._drawn, self._low, self._high))
        masked_set_(self.left, due, self._period)
        now = torch.lerp(self.goal, self.begin, (self.left / self._period).unsqueeze(1))
        torch.mul(now.index_select(1, self._source), self._signs, out=self.offsets)

    def end(self) -> None:
        """Begin again at the default angles."""
        for tensor in (self.left, self.begin, self.goal, self.offsets):
            tensor.zero_()


def held_walk(
    cfg: HeldGoalsConfig, robot: Robot, control: RobotControlConfig, where: Callable[[str], str] = str
) -> tuple[list[int], list[int], list[int], list[float], np.ndarray]:
    """Return the indices of the K held joints, and of the W joints among them that walk on their own; for each held joint the
    walking joint that it follows (an index from 0 to W - 1) and the sign with which it does; and the limits of the goals of
    the walking joints (W, 2) [rad].

    Raises:
        ConfigError: no joint is held, a pattern of `limits` matches no held joint, a joint has no angle within its limits, or
            joints are to be mirrored that have no mirror image.
    """
    path = "domain_rand.held_goals"
    acted = acted_joints(robot, control, where)
    held = [i for i in range(robot.num_dof) if i not in acted]
    if not held:
        raise ConfigError(f"{where(f'{path}.step')}: no joint is held; name joints in control.held, or set step to 0")
    names = [robot.joint_names[i] for i in held]
    limits = robot.dof_pos_limits[held].copy()
    if cfg.limits:
        place = where(f"{path}.limits")
        own = list(match_names(tuple(cfg.limits), names, place))
        given = match_values(cfg.limits, [names[k] for k in own], place)
        within = np.clip(given, limits[own, :1], limits[own, 1:])
        for k, allowed, wanted in zip(own, limits[own], given, strict=True):
            if wanted[0] >= allowed[1] or wanted[1] <= allowed[0]:
                span = f"{allowed[0]:g} to {allowed[1]:g} rad"
                raise ConfigError(f"{place}: '{names[k]}' has the range {span}, got {wanted.tolist()}")
        limits[own] = within
    source, signs = list(range(len(held))), [1.0] * len(held)
    if cfg.mirrored:
        why = f"{where(f'{path}.mirrored')}: the held joints of '{robot.name}' have no mirror image"
        if robot.mirror is None or robot.mirror.uneven_joint(robot.default_dof_pos) is not None:
            raise ConfigError(f"{why}: left and right differ; set mirrored to false")
        if (image := mirror_of_actions(robot.mirror, held)) is None:
            raise ConfigError(f"{why}: control.held names joints on one side only; set mirrored to false")
        first = [partner if partner < k else k for k, partner in enumerate(image[0])]
        signs = [sign if partner < k else 1.0 for k, (partner, sign) in enumerate(zip(*image, strict=True))]
        kept = sorted(set(first))
        source = [kept.index(k) for k in first]
        return held, [held[k] for k in kept], source, signs, limits[kept]
    return held, held, source, signs, limits
