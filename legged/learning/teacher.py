"""Teacher of a student: any policy of this package, with the observations that the policy was trained on."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from legged.config import TaskConfig, follows_velocities, has_robot
from legged.config.learning import PolicyConfig
from legged.config.mdp import ObservationGroupConfig
from legged.config.networks import groups_of
from legged.envs.privileged_terms import PREFIX as DRAWN
from legged.envs.privileged_terms import largest_of, observed, observed_forces
from legged.errors import ConfigError, suggest
from legged.learning.checkpoint import (
    Saved,
    check_joints,
    check_networks_fit,
    check_weights,
    networks,
    read_checkpoint,
)
from legged.learning.run_folder import find_checkpoint, run_config, run_named
from legged.process.paths import exists, relative
from legged.registry import task_class

FIELD = "train.distillation.teacher"
PREFIX = "teacher_"
"""Prefix that the names of a teacher's observation groups get in the student's task."""
OF_A_NETWORK = ("activation", "obs_normalization", "noise_std_type", "state_dependent_std", "rnn_type")
OF_ACTIONS = ("control_type", "action_scale", "held", "clip_actions")
"""Fields of `control` that define the meaning of an action."""


@dataclass(frozen=True)
class Teacher:
    """Policy that a student imitates."""

    origin: Mapping[str, str | int]
    """File, task and iteration of the policy."""
    groups: Mapping[str, ObservationGroupConfig]
    """Observation groups that the policy reads, in order and without noise, by their names in the student's task."""
    network: Mapping[str, Any]
    """Description of the network, as in checkpoints. Its entry `observations` has the groups' names in the student's task."""
    weights: Mapping[str, Tensor]

    @property
    def policy(self) -> PolicyConfig:
        """Description of the network as a configuration."""
        said = {name: self.network[name] for name in OF_A_NETWORK if name in self.network}
        if said["rnn_type"] != "none":
            said |= {name: self.network[name] for name in ("rnn_hidden_dim", "rnn_num_layers")}
        hidden, groups = self.network["hidden_dims"], self.network["observations"]
        return PolicyConfig(actor_hidden_dims=tuple(hidden), actor_observations=tuple(groups), **said)

    def told(self) -> str:
        """Return a text that names the teacher."""
        return f"{self.origin['file']} ({self.origin['task']}, iteration {self.origin['iteration']})"


def find_teacher(cfg: TaskConfig) -> Teacher:
    """Find the teacher that a student's configuration names. Check that the student's task offers the observations that the
    teacher was trained on.

    Raises:
        ConfigError: there is no teacher, or the teacher's observations or actions differ from the student's task.
    """
    name, where = cfg.train.distillation.teacher, cfg.origins.where(FIELD)
    if not name:
        raise ConfigError(f"--teacher: '{cfg.task}' learns from a teacher; name one with --teacher POLICY")
    file = Path(name) if name.endswith(".pt") and exists(Path(name)) else None
    path = file or find_checkpoint(run_named(name, where), None)
    there, saved = run_config(path.parent), read_checkpoint(path)
    check_joints(f"{where}: {relative(path)}", saved["infos"].get("robot", {}), cfg)
    check_networks_fit(relative(path), {name: part for name, part in saved.items() if name != "critic_state_dict"}, there)
    if there.train.policy.estimator.targets:
        raise ConfigError(f"{where}: {relative(path)} has an estimator; a teacher can't have one")
    read = groups_of(there, "actor")
    groups = {PREFIX + group: replace(there.observations.groups[group], noise=False) for group in read}
    terms = dict.fromkeys(term for group in groups.values() for term in group.terms)
    missing = [term for term in terms if not hasattr(task_class(cfg.task), f"_obs_{term}") and not term.startswith(DRAWN)]
    if missing:
        known = suggest(missing[0], task_class(cfg.task).terms("_obs_"), "observations")
        unknown = ", ".join(f"'{term}'" for term in missing)
        raise ConfigError(f"{where}: {relative(path)} observes {unknown}, which '{cfg.task}' does not have{known}")
    found = differences(cfg, there, terms)
    if found:
        raise ConfigError(f"{where}: {relative(path)} was trained with other settings than '{cfg.task}': {'; '.join(found)}")
    network = {**networks(there)["actor"], "observations": list(groups)}
    origin: dict[str, str | int] = {"file": relative(path), "task": there.task, "iteration": saved["iter"]}
    teacher = Teacher(origin, groups, network, saved["actor_state_dict"])
    task_class(cfg.task).check(with_teacher(cfg, teacher))
    return teacher


def differences(here: TaskConfig, there: TaskConfig, terms: Iterable[str]) -> list[str]:
    """Return a line such as 'observations.clip 100 there, 10 here' for each setting that differs between the student's task
    (`here`) and the teacher's (`there`). Only settings that affect the `terms` or the actions are compared.
    """
    pairs: dict[str, tuple[Any, Any]] = {"the control step": (here.dt, there.dt)}
    for name in OF_ACTIONS:
        pairs[f"control.{name}"] = tuple(getattr(cfg.control, name, None) for cfg in (here, there))  # type: ignore[assignment]
    pairs["observations.clip"] = (here.observations.clip, there.observations.clip)
    for term in terms:
        pairs[f"observations.scales.{term}"] = (scale_of(here, term), scale_of(there, term))
        drawn = term.removeprefix(DRAWN)
        if drawn != term:
            pairs[f"domain_rand.observed_ranges.{drawn}"] = (_observed_as(here, drawn), _observed_as(there, drawn))
    if "push_force" in terms:
        pairs["domain_rand.forces"] = (_largest_forces(here), _largest_forces(there))
    if {"dof_pos", "dof_vel"} & {*terms}:
        pairs["observations.joints"] = tuple(getattr(cfg.observations, "joints", ()) for cfg in (here, there))  # type: ignore[assignment]
    if "heights" in terms and has_robot(here) and has_robot(there):
        for name in ("measured_points_x", "measured_points_y", "scan"):
            pairs[f"terrain.{name}"] = (getattr(here.terrain, name), getattr(there.terrain, name))
        for name in ("heights_offset", "heights_limit", "depth_limit"):
            pairs[f"observations.{name}"] = (getattr(here.observations, name), getattr(there.observations, name))
    return [f"{name} {_shown(theirs)} there, {_shown(ours)} here" for name, (ours, theirs) in pairs.items() if ours != theirs]


def _observed_as(cfg: TaskConfig, name: str) -> str:
    """Return as text the range that scales the observation of a randomised property."""
    draw = observed(cfg, name)
    if draw is None:
        return "not drawn"
    low, high = draw.range
    return f"[{low:g}, {high:g}]" + (" log_uniform" if draw.distribution == "log_uniform" else "")


def _largest_forces(cfg: TaskConfig) -> str:
    """Return as text the largest value of each observed force. A force is observed as a share of this value."""
    forces = observed_forces(cfg) if has_robot(cfg) else {}
    return ", ".join(f"{name} up to {largest_of(force):g} N" for name, force in forces.items()) or "none"


def _shown(value: Any) -> str:
    """Return a value as text for an error. A long list gives its length, a list of numbers also its first and last one."""
    if isinstance(value, tuple) and len(value) > 3:
        return f"{len(value)} from {value[0]:g} to {value[-1]:g}" if isinstance(value[0], float) else f"{len(value)} names"
    return f"{value:g}" if isinstance(value, float) else str(value)


def scale_of(cfg: TaskConfig, term: str) -> float | tuple[float, float]:
    """Return the factor of an observation term. Commands have the factors of linear and angular velocity by default."""
    scales = cfg.observations.scales
    if term == "commands" and term not in scales and follows_velocities(cfg):
        return scales.get("base_lin_vel", 1.0), scales.get("base_ang_vel", 1.0)
    return scales.get(term, 1.0)


def with_teacher(cfg: TaskConfig, teacher: Teacher) -> TaskConfig:
    """Return the configuration of a student's task with the teacher's observation groups added.

    Raises:
        ConfigError: the student has a different group with the name of a teacher's group.
    """
    groups = cfg.observations.groups
    for name, group in teacher.groups.items():
        if groups.get(name, group) != group:
            path = f"observations.groups.{name}"
            raise cfg.origins.error(path, "the teacher's group has this name; rename the student's group")
    # A student has no value function to warm up, and does not learn from mirror images. Without `symmetry`, the checks of the
    # task do not ask how the teacher's observations are mirrored.
    algorithm = replace(cfg.train.algorithm, symmetry=False, critic_warmup_iterations=0)
    return replace(
        cfg,
        observations=replace(cfg.observations, groups={**groups, **teacher.groups}),
        train=replace(cfg.train, algorithm=algorithm),
    )


def teacher_in(path: Path, saved: Saved) -> Teacher:
    """Return the teacher stored in a student's checkpoint.

    Raises:
        ConfigError: the checkpoint holds no teacher.
    """
    infos, name = saved["infos"], relative(path)
    try:
        network, weights = infos["networks"]["teacher"], saved["teacher_state_dict"]
        layouts, histories = infos["observations"], infos["histories"]
        groups = {group: ObservationGroupConfig(tuple(layouts[group]), histories[group]) for group in network["observations"]}
        teacher = Teacher({"file": name, "task": "", "iteration": 0, **infos["teacher"]}, groups, network, weights)
        teacher.policy  # noqa: B018 (fails if an entry is missing)
    except (KeyError, TypeError) as error:
        raise ConfigError(f"{name}: holds no teacher to continue with ({error})") from error
    check_weights(saved["teacher_state_dict"], f"{name}: its teacher")
    return teacher
