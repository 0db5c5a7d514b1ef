"""Attributes of tasks in legged_gym and its forks, for tasks of this package. Some are the package's tensors under a second
name. Others are computed at each reading. Some do not exist here, so reading one raises an error with a hint.

These attributes cost nothing until they are read. If a class sets an attribute with such a name, its own value is used.
"""

import difflib
import inspect
import re
from collections.abc import Callable
from types import MappingProxyType, SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from legged.envs.class_checks import names_in
from legged.graph import guard
from legged.graph.guard import memory_of
from legged.math import get_euler_xyz, masked_set_, quat_rotate
from legged.robots.stance import lowest_point, stance

guard.HINTS |= {
    r"\bcommands\[:, ?([4-9]|\d\d)\b": "self.commands (N, 4) has vx, vy, yaw rate, heading; keep others in your own tensor",
    r"\.terrain_heights\(": "self.height_scan.ground_at(points) has heights of the ground; self.base_height is above it",
    r"\bquat_(conjugate|mul)\(": "legged.math has quat_multiply and quat_conjugate, w first",
}

WRITES = re.compile(r"__setitem__|__i(add|sub|mul|truediv|floordiv|mod|pow|and|or|xor)__|.*[^_]_")
"""Names of the methods that write to their tensor."""


class ReadOnly(Tensor):
    """Value of an attribute that is computed at each reading. Writing to this tensor or to a view of it would not change the
    task, so it raises an AttributeError that names an alternative. Results computed from the tensor are ordinary tensors.
    """

    instead: str = ""
    w_last = True
    """Quaternions in it have w last, so that functions of legged.math refuse them."""

    @classmethod
    def of(cls, tensor: Tensor, instead: str) -> "ReadOnly":
        """Return a read-only view of `tensor`. An attempt to write raises an AttributeError with the text `instead`."""
        result = tensor.as_subclass(cls)
        result.instead = instead
        return result

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        writes = WRITES.fullmatch(getattr(func, "__name__", ""))
        first = args[0] if args else None
        for target in (first if writes else None, kwargs.get("out")):
            if isinstance(target, cls):
                raise AttributeError(target.instead)
        with torch._C.DisableTorchFunctionSubclass():
            result = func(*args, **kwargs)
            if isinstance(first, cls) and type(result) is Tensor and memory_of(first) == memory_of(result):
                return cls.of(result, first.instead)
        return result


class Wide(Tensor):
    """Tensor that can also be indexed in the layout of forks in which it has one more axis. In all else it is an ordinary
    tensor, and so are the results computed from it.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]
    there: Callable[[], Tensor]

    @classmethod
    def of(cls, tensor: Tensor, there: Callable[[], Tensor]) -> "Wide":
        """Return a view of `tensor` whose parts `[i, j, ...]` are those of `there()` if there are more indices than axes."""
        result = tensor.as_subclass(cls)
        result.there = there
        return result

    def __getitem__(self, index: Any) -> Tensor:
        more = isinstance(index, tuple) and len(index) > self.dim() and not any(i is None or i is ... for i in index)
        return self.there()[index] if more else super().__getitem__(index)


def _root_states(task: Any) -> Tensor:
    """Return the states of the bases (N, 13) in Isaac Gym's layout."""
    quat = task.base_quat
    velocity = quat_rotate(quat, task.base_lin_vel)
    return torch.cat([task.base_pos, quat[:, 1:], quat[:, :1], velocity, quat_rotate(quat, task.base_ang_vel)], dim=1)


def _once(task: Any, name: str, make: Callable[[Any], Any]) -> Any:
    """Return `make(task)` of the first call with this `name`."""
    made = vars(task).setdefault("_legged_gym", {})
    if name not in made:
        made[name] = make(task)
    return made[name]


def _sole_depths(task: Any) -> Tensor:
    """Return (F,) how far each foot's lowest point is below its centre in the default pose [m]."""
    model = task.physics.model
    data = stance(model, task.robot.default_qpos)
    feet = [[model.geom(name).id for name in foot] for foot in task.robot.feet_shapes]
    depths = [data.geom_xpos[foot, 2].mean() - min(lowest_point(model, data, shape) for shape in foot) for foot in feet]
    return torch.tensor(depths, dtype=torch.float32, device=task.device)


def _foot_heights(task: Any) -> Tensor:
    ground = task.height_scan.ground_at(task.feet_pos[:, :, :2])
    return (task.feet_pos[:, :, 2] - _once(task, "sole_depths", _sole_depths) - ground).clamp(0.0, 1.0)


def _feet_bodies(task: Any) -> Tensor:
    """Return (F,) the indices of the feet's bodies in the model."""
    bodies = [int(task.physics.model.geom(foot[0]).bodyid[0]) for foot in task.robot.feet_shapes]
    return torch.tensor(bodies, device=task.device)


def _feet_angles(task: Any) -> list[Tensor]:
    """Return roll, pitch and yaw of the feet's bodies, (N, F) each [rad]."""
    if "xquat" not in task.QUANTITIES:
        raise AttributeError("needs the orientations of bodies; write QUANTITIES = ('xquat',) in the class")
    quat = task.physics.quantity("xquat").index_select(1, _once(task, "feet_bodies", _feet_bodies))
    return [angle.view(quat.shape[:2]) for angle in get_euler_xyz(quat.flatten(0, 1))]


def _tiles(task: Any) -> Any:
    """Return the terrain's curriculum."""
    if task.terrain_curriculum is None:
        raise AttributeError("the ground is a plane (terrain.mesh_type) and has no tiles")
    return task.terrain_curriculum


def _friction(task: Any) -> Tensor:
    drawn = task.randomization.fields
    if "friction" not in drawn:
        raise AttributeError("friction is not randomised (domain_rand.randomize_friction is off)")
    return drawn["friction"].view(-1, 1, 1)


def _beyond_limits(task: Any) -> Tensor:
    """Return (N, D) how far the joints are beyond their soft limits [rad]."""
    low, high = task.dof_pos_limits.unbind(dim=1)
    return torch.maximum(low - task.dof_pos, task.dof_pos - high).clamp(min=0.0)


def _joint_pos_target(task: Any) -> Tensor:
    if task.control.law != "P":
        raise AttributeError("only control.control_type P has joint angles as targets")
    return task.default_dof_pos + task.control.spread(task.actions)


def _obs_scales(task: Any) -> SimpleNamespace:
    scales = task.observation_scales()
    names = {"lin_vel": "base_lin_vel", "ang_vel": "base_ang_vel", "dof_pos": "dof_pos", "dof_vel": "dof_vel"}
    names["height_measurements"] = "heights"
    return SimpleNamespace(**{theirs: scales.get(ours, 1.0) for theirs, ours in names.items()})


def _noise_scale_vec(task: Any) -> Tensor:
    errors, noisy = task.observation_terms.errors, task.cfg.observations.groups["actor"].noise
    measured = errors.noise if errors is not None and noisy else {}  # noise that `errors` adds
    return torch.cat([term.scale * measured.get(term.name, term.noise) for term in task.observation_groups["actor"].terms])


def _command_ranges(task: Any) -> dict[str, Any]:
    says = "self.command_ranges cannot be written: commands.curriculum in the YAML says how ranges widen"
    rows = zip(("lin_vel_x", "lin_vel_y", "ang_vel_yaw"), task.command_sampler.ranges, strict=True)
    return {name: ReadOnly.of(row, says) for name, row in rows} | {"heading": list(task.cfg.commands.ranges.heading)}


PLAIN: dict[str, Callable[[Any], Any]] = {
    "env": lambda task: task,  # walk-these-ways has its rewards in another class, which reads self.env.dof_pos
    "num_dof": lambda task: task.robot.num_dof,
    "num_dofs": lambda task: task.robot.num_dof,
    "dof_names": lambda task: list(task.robot.joint_names),
    "num_actuated_dof": lambda task: task.num_actions,
    "num_bodies": lambda task: task.physics.model.nbody - 1,
    "feet_num": lambda task: len(task.feet_indices),
    "feet_names": lambda task: list(task.robot.feet_names),
    "num_obs": lambda task: task.observation_groups["actor"].buffer.shape[1],
    "num_privileged_obs": lambda task: task.observation_groups["critic"].buffer.shape[1],
    "num_height_points": lambda task: len(task.height_scan.points),
    "max_episode_length_s": lambda task: task.cfg.env.episode_length_s,
    "custom_origins": lambda task: task.terrain is not None,
    "add_noise": lambda task: task.cfg.observations.add_noise,
    "obs_scales": _obs_scales,
    "command_ranges": _command_ranges,
    "reward_scales": lambda task: MappingProxyType(task.rewards.scales),
    "reward_names": lambda task: list(task.rewards.names),
    "reward_functions": lambda task: list(task.rewards.functions.values()),
    "obs_buf": lambda task: task.observation_groups["actor"].buffer,
    "privileged_obs_buf": lambda task: task.observation_groups["critic"].buffer,
    "p_gains": lambda task: task.control.stiffness,
    "d_gains": lambda task: task.control.damping,
    "torque_limits": lambda task: task.control.torque_limits,
    "penalised_contact_indices": lambda task: task.penalised_indices,
    "penalized_contact_indices": lambda task: task.penalised_indices,
    "termination_contact_indices": lambda task: task.termination_indices,
    "contact_filt": lambda task: task.contacts.in_contact,
    "base_position": lambda task: task.base_pos,
    "raw_default_dof_pos": lambda task: task.default_dof_pos,
    "default_joint_pd_target": lambda task: task.default_dof_pos,
    "foot_positions": lambda task: task.feet_pos,
    "foot_velocities": lambda task: task.feet_vel,
    "friction_coeffs": _friction,
    "max_terrain_level": lambda task: _tiles(task).rows,
    "terrain_levels": lambda task: _tiles(task).levels,
    "terrain_types": lambda task: _tiles(task).columns,
}
"""Name in legged_gym -> function that returns the value, which the task has under another name. Tensors are not copied."""

_STATE = "to set a state, call self.physics.write(mask, qpos, qvel) in reset_idx(mask)"
COMPUTED: dict[str, tuple[Callable[[Any], Tensor], str]] = {
    "root_states": (_root_states, _STATE),
    "dof_state": (lambda task: torch.stack([task.dof_pos, task.dof_vel], dim=2).view(-1, 2), _STATE),
    "rpy": (lambda task: torch.stack(get_euler_xyz(task.base_quat), dim=1), "it follows from self.base_quat"),
    "base_euler_xyz": (lambda task: task.rpy, "it follows from self.base_quat"),
    "base_height": (lambda task: task.base_pos[:, 2] - task.measured_heights.mean(dim=1), "it follows from self.base_pos"),
    "base_lin_acc": (
        lambda task: (task.physics.robot_state.base_lin_vel_w - task.last_root_vel[:, :3]) / task.dt,
        "it follows from self.root_states and self.last_root_vel",
    ),
    "dof_acc": (lambda task: (task.dof_vel - task.last_dof_vel) / task.dt, "it follows from self.dof_vel"),
    "foot_heights": (_foot_heights, "it follows from self.feet_pos and the ground"),
    "feet_roll": (lambda task: _feet_angles(task)[0], "it follows from self.physics.quantity('xquat')"),
    "feet_yaw": (lambda task: _feet_angles(task)[2], "it follows from self.physics.quantity('xquat')"),
    "joint_pos_target": (_joint_pos_target, "self.control computes it from the actions"),
}
"""Name in legged_gym -> function that computes the value at each reading, and a hint for users who try to write to it."""

CONSTANT: dict[str, Callable[[Any], Tensor]] = {
    "gravity_vec": lambda task: torch.tensor([[0.0, 0.0, -1.0]], device=task.device).repeat(task.num_envs, 1),
    "forward_vec": lambda task: torch.tensor([[1.0, 0.0, 0.0]], device=task.device).repeat(task.num_envs, 1),
    "base_init_state": lambda task: torch.tensor(
        [0.0, 0.0, task.robot.file.spawn_height, 0.0, 0.0, 0.0, 1.0, *[0.0] * 6], device=task.device
    ),
    "commands_scale": lambda task: torch.tensor(task.observation_scales()["commands"], device=task.device),
    "noise_scale_vec": _noise_scale_vec,
    "height_points": lambda task: torch.nn.functional.pad(task.height_scan.points, (0, 1)).repeat(task.num_envs, 1, 1),
    "terrain_origins": lambda task: _tiles(task).tiles.view(_tiles(task).rows, -1, 3),
}
"""Name in legged_gym -> function that makes a constant at the first reading."""

KEPT: dict[str, Callable[[Any], Tensor]] = {
    "feet_air_time": lambda task: task.contacts.air_time,
    "last_root_vel": lambda task: _root_states(task)[:, 7:],
    "last_contacts": lambda task: task.contact_forces[:, task.feet_indices, 2] > task.contacts.force,
    "last_torques": lambda task: task.torques,
    "last_dof_pos": lambda task: task.dof_pos,
    "last_feet_pos": lambda task: task.feet_pos,
    "prev_foot_velocities": lambda task: task.feet_vel,
    "last_contact_forces": lambda task: task.contact_forces,
    "last_last_actions": lambda task: task.last_actions,
    "last_joint_pos_target": _joint_pos_target,
    "last_last_joint_pos_target": lambda task: task.last_joint_pos_target,
    "rwd_linVelTrackPrev": lambda task: task._reward_tracking_lin_vel(),
    "rwd_angVelTrackPrev": lambda task: task._reward_tracking_ang_vel(),
}
"""Name in legged_gym -> function. If a term reads the name, each step stores the function's value for the next step. So a
reward may count in `feet_air_time` or assign `last_contacts`, as legged_gym's do: the next step starts from the true values.
"""

SUBSTEPS: dict[str, Callable[[Any], Tensor]] = {
    "substep_torques": lambda task: task.torques,
    "substep_dof_vel": lambda task: task.dof_vel,
    "substep_exceed_dof_pos_limits": lambda task: _beyond_limits(task) > 0.0,
    "substep_exceed_dof_pos_limit_abs": _beyond_limits,
}
"""Name in forks of legged_gym -> function. If a term reads the name, the values after each physics step are stored."""

_BODIES = (
    "self.feet_pos and self.feet_vel (N, F, 3) hold the states of the feet; for all bodies, the class attribute"
    " QUANTITIES = ('xpos', 'xquat', 'cvel') makes them readable by self.physics.quantity(name)"
)
_OWN = "allocate your own tensors in _init_buffers(), and write them in place in advance()"


def _drawn(name: str) -> str:
    return f"self.randomization.fields['{name}'] has the values that domain_rand.ranges.{name} draws (docs/randomisation.md)"


HINTS = {
    "common_step_counter command_counter global_counter": "count in your own tensor: allocate it in _init_buffers(), and let"
    " the hook advance() increment it in place",
    "gym sim viewer envs actor_handles": "there is no Isaac Gym: self.physics makes the steps; to change a step, override the"
    " hooks that _step() calls",
    "sim_params": "self.cfg.sim.dt is the physics step, self.dt the control step",
    "extras": "write a method _metric_<name> for each figure to be logged; step() returns its own extras",
    "rigid_body_states rigid_body_state rigid_body_pos rigid_state rb_states": _BODIES,
    "height_samples": "self.measured_heights (N, P) are heights around each robot; self.terrain.height_map has all heights",
    "hip_indices front_hip_indices rear_hip_indices knee_indices thigh_indices calf_indices": "self.joints('hip') has the"
    " indices of the joints whose names contain 'hip'; other patterns work alike",
    "roll pitch yaw": "self.rpy (N, 3) has roll, pitch and yaw, each in [-pi, pi]",
    "foot_indices": f"self.feet_indices are indices of shapes; for the phases of a gait, {_OWN}",
    "first_contact": "self.contacts.first_contact (N, F) is True for the feet that touch down at this step",
    "obs_history obs_history_buf": "observations.groups.<group>.history in the YAML is the number of steps in a group",
    "env_frictions friction_coeffs_tensor": _drawn("friction"),
    "restitutions": _drawn("restitution"),
    "payload payloads": _drawn("added_base_mass"),
    "com_displacement com_displacements": _drawn("base_com_x"),
    "motor_strength motor_strengths": _drawn("motor_strength"),
    "motor_offsets": _drawn("joint_offset"),
    "Kp_factors": _drawn("p_gain"),
    "Kd_factors": _drawn("d_gain"),
    "headless debug_viz": "nothing is drawn while training; play.py makes pictures (legged/rendering)",
    "init_done": "the hooks that a step calls always find the tensors that _init_buffers() allocated",
}
"""Names in legged_gym or its forks that do not exist here -> hint at their replacement."""
ABSENT = {name: hint for names, hint in HINTS.items() for name in names.split()}
NAMES = {*PLAIN, *COMPUTED, *CONSTANT, *KEPT, *SUBSTEPS, *ABSENT}


class LeggedGymNames:
    """Mixin of LeggedRobot with legged_gym's names. N robots, D joints, F feet, P heights.

    `root_states` (N, 13) has position [m], orientation (x, y, z, w), linear [m/s] and angular velocity [rad/s], all in the
    world frame, as in Isaac Gym. (In `base_quat` w is first; `base_lin_vel` and `base_ang_vel` are in the base frame.)
    `dof_state` (N * D, 2) has angles [rad] and velocities [rad/s]. `feet_air_time` (N, F) has the durations of swings up to
    the previous step [s]. `rpy` and `base_euler_xyz` (N, 3) have roll, pitch and yaw in [-pi, pi] [rad].
    `base_height` (N,) is the base's height above the mean of the scanned ground [m]. `base_lin_acc` (N, 3) in the world frame
    [m/s^2] and `dof_acc` (N, D) [rad/s^2] are changes over the control step, divided by its length. `foot_heights` (N, F) are
    heights of soles above the ground under the feet's centres, clipped to [0, 1] m; a sole is as far below the centre as in
    the default pose. `feet_roll` and `feet_yaw` (N, F) are angles of the feet's bodies [rad]. `substep_torques` (N, S, D)
    [N m] and its like have a row for each of the S physics steps of this control step, oldest first: torques during it,
    velocities [rad/s] and angles beyond soft limits [rad] after it. `rwd_linVelTrackPrev` and `rwd_angVelTrackPrev` (N,) are
    the tracking rewards before this step, for the same commands. `friction_coeffs` is (N, 1, 1),
    `height_points` (N, P, 3) in the yaw frame [m], `terrain_origins` (rows, columns, 3). `noise_scale_vec` has a number for
    each column of the actor's observations. All other names have the shapes and units of their counterparts in this package.
    """

    QUANTITIES: ClassVar[tuple[str, ...]]
    cfg: Any
    reset_buf: Tensor

    def __init_subclass__(cls) -> None:
        """Add the quantities that methods of the class need to `QUANTITIES`."""
        super().__init_subclass__()
        code = [getattr(inspect.unwrap(member), "__code__", None) for member in vars(cls).values()]
        read = set().union(*(names_in(own) for own in code if own is not None))
        if read & {"feet_roll", "feet_yaw"} and "xquat" not in cls.QUANTITIES:
            cls.QUANTITIES = (*cls.QUANTITIES, "xquat")

    def __setattr__(self, name: str, value: Any) -> None:
        if name in vars(self).get("_kept_names", ()):  # a graph goes on reading the tensor that it recorded
            vars(self)[name].copy_(value)
        else:
            super().__setattr__(name, value)

    if not TYPE_CHECKING:  # type checkers do not see __getattr__, so they still report missing attributes

        def __getattr__(self, name: str) -> Any:
            if hasattr(type(self), name):  # a property failed; reading it again raises the original error
                return object.__getattribute__(self, name)
            if name in NAMES:
                try:
                    return self._by_their_name(name)
                except AttributeError as error:
                    raise AttributeError(f"self.{name}: {error}") from None
            near = None if name.startswith("_") else self._nearest(name)
            hint = f"did you mean '{near}'?" if near else f"paste it too if it is a method; {_OWN}"
            raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'; {hint}")

    def _nearest(self, name: str) -> str | None:
        """Return the readable attribute that `name` may be a misspelling of: it has as many words, each of them similar,
        with the same first letter.
        """

        def alike(one: str, other: str) -> bool:
            return one[:1] == other[:1] and difflib.SequenceMatcher(None, one, other).ratio() > 0.6

        words = name.split("_")
        known = {*vars(self), *NAMES} - {*ABSENT}
        public = [other for other in sorted(known) if other[:1] != "_" and other.count("_") == len(words) - 1]
        likely = [other for other in public if all(map(alike, words, other.split("_")))]
        near = difflib.get_close_matches(name, likely, n=len(likely) or 1, cutoff=0.75)
        return next((other for other in near if other in (*KEPT, *SUBSTEPS) or hasattr(self, other)), None)

    def _by_their_name(self, name: str) -> Any:
        """Return the value of legged_gym's attribute `name`.

        Raises:
            AttributeError: this task does not have the attribute; the message suggests a replacement.
        """
        if name in PLAIN:
            return PLAIN[name](self)
        if name in COMPUTED:
            compute, instead = COMPUTED[name]
            return ReadOnly.of(compute(self), f"self.{name} is computed when it is read, and cannot be written: {instead}")
        if name in CONSTANT:
            return _once(self, name, CONSTANT[name])
        if name not in ABSENT:
            graph = vars(self).get("_graph")
            if graph is not None and graph.captured:
                raise AttributeError("is stored only if a term reads it; none had read it when the step was captured")
            value = (KEPT | SUBSTEPS)[name](self)
            if name in SUBSTEPS:
                value = value.unsqueeze(1).repeat(1, self.cfg.control.decimation, 1)
            vars(self)[name] = kept = torch.zeros_like(value, memory_format=torch.contiguous_format)
            vars(self).setdefault("_kept_names", []).append(name)
            return kept
        raise AttributeError(f"is not there; {ABSENT[name]}")

    def _init_buffers(self) -> None:
        super()._init_buffers()  # type: ignore[misc]
        task: Any = self
        default, last = task.default_dof_pos, task.last_actions
        task.default_dof_pos = Wide.of(default, lambda: default.unsqueeze(0))
        task.last_actions = Wide.of(last, lambda: torch.stack([last, task.last_last_actions], dim=2))

    def apply_control(self) -> None:
        self._store_substep()
        super().apply_control()  # type: ignore[misc]

    def advance(self) -> None:
        super().advance()  # type: ignore[misc]
        self._store_substep()

    def _store_substep(self) -> None:
        """Append the values of names in `SUBSTEPS` that a term has read, and drop those of the oldest physics step."""
        for name in vars(self).get("_kept_names", ()):
            if name in SUBSTEPS:
                kept = vars(self)[name]
                kept.copy_(kept.roll(-1, dims=1))
                kept[:, -1].copy_(SUBSTEPS[name](self))

    def remember(self) -> None:
        """Store values of names in `KEPT` that a term has read, before BaseTask's `remember` overwrites `last_actions`."""
        kept = [name for name in vars(self).get("_kept_names", ()) if name in KEPT]
        older = [name for name in kept if name.startswith("last_last_")]
        for name in sorted(kept, key=lambda name: name not in older):  # they read values that the others overwrite
            vars(self)[name].copy_(KEPT[name](self))
        super().remember()  # type: ignore[misc]
        for name in older:  # a new episode must not see values of the old one
            masked_set_(vars(self)[name], self.reset_buf, KEPT[name](self))
