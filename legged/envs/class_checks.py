"""Checks of user-defined task classes: methods that are never called, overrides without super(), and terms that are not
methods.
"""

import dataclasses
import inspect
import re
from pathlib import Path
from types import CodeType
from typing import Any

from legged.config.networks import groups_in, path_of_terms
from legged.config.task import TaskConfig
from legged.envs.marks import unit_of
from legged.errors import LONGEST, ConfigError, suggest
from legged.physics.quantities import check_quantities
from legged.process.paths import relative

_OBSERVE = "write a method _obs_<name> for each observation; list <name> in observations.groups.actor.terms and .critic.terms"
_STEP = "override a hook that _step() calls (advance, compute_reward, remember, ...), and call the parent's method in it"
_SUBSTEP = (
    "override take_actions() for code that runs once before a control step's physics, or apply_control() for code that runs"
    " before each physics step, and call the parent's method in it"
)
_START = (
    "init_state.dof_pos_factor, init_state.yaw and init_state.base_velocity set the initial states; for other states,"
    " override reset_idx(mask) and call self.physics.write(mask, qpos, qvel) after super().reset_idx(mask)"
)
_BUILD = "the keys 'robot' and 'terrain' in the task's YAML set the robot and the ground (or override make_terrain())"
_DRAWING = "nothing is drawn while training; play.py makes pictures (legged/rendering)"
_TORQUES = "control.control_type, .stiffness and .damping set the control law; other laws go into legged/mdp/control.py"
_RANDOM = "domain_rand.ranges names the properties that are randomised (docs/randomisation.md)"

HOOKS = {
    # Methods of legged_gym, its forks and Isaac Lab that share a hint.
    **dict.fromkeys(("post_physics_step", "_post_physics_step_callback", "_reset_buffers", "_call_train_eval"), _STEP),
    **dict.fromkeys(("pre_physics_step", "post_decimation_step"), _SUBSTEP),
    **dict.fromkeys(("_reset_dofs", "_reset_root_states"), _START),
    **dict.fromkeys(
        ("_create_envs", "_create_ground_plane", "_create_heightfield", "_create_trimesh", "create_sim", "_setup_scene"),
        _BUILD,
    ),
    **dict.fromkeys(("_compute_torques", "_pre_physics_step", "_apply_action"), _TORQUES),
    **dict.fromkeys(("_randomize_dof_props", "_randomize_rigid_body_props", "refresh_actor_rigid_shape_props"), _RANDOM),
    **dict.fromkeys(("_draw_debug_vis", "render", "set_camera"), _DRAWING),
    # Other methods of legged_gym and its forks.
    "_parse_cfg": "__init__() gets the complete configuration; your own numbers go under the key 'custom' in the YAML",
    "_prepare_reward_function": "rewards.scales in the YAML names the _reward_<name> methods that run; self.rewards has them",
    "get_privileged_observations": "observations.groups.critic.terms lists the _obs_<name> methods that the critic sees",
    "_get_noise_scale_vec": "observations.noise, noise_level and observations.add_noise in the YAML set the noise",
    "_resample_commands": "commands.ranges, commands.resampling_time_s, standing_share and single_axis_share set the"
    " sampling; another way of sampling goes into legged/mdp/commands.py",
    "_push_robots": "domain_rand.push_robots, push_interval_s and max_push_vel_xy set the pushes",
    "_update_terrain_curriculum": "terrain.curriculum switches it on; other rules go into legged/mdp/terrain_curriculum.py",
    "update_command_curriculum": "commands.curriculum configures it; other rules go into legged/mdp/command_curriculum.py",
    "_get_heights": "self.measured_heights (N, P) is current after a step; terrain.measured_points_x and _y set the points",
    "_init_height_points": "terrain.measured_points_x and terrain.measured_points_y set the points of the height scan",
    "_process_rigid_shape_props": "domain_rand.randomize_friction and friction_range set friction; all else is in the MJCF",
    "_process_dof_props": "joint and effort limits are in the MJCF, velocity limits in robot.yaml; rewards.soft_* scale them",
    "_process_rigid_body_props": "domain_rand.randomize_base_mass and added_mass_range add mass; all else is in the MJCF",
    "_get_env_origins": "self.env_origins (N, 3) come from the terrain; terrain.spawn_range scatters robots around them",
    "_init_foot": "self.feet_pos and self.feet_vel (N, F, 3) exist already; allocate your own buffers in _init_buffers()",
    "update_feet_state": "self.feet_pos and self.feet_vel (N, F, 3) are current after every step",
    "compute_termination_observations": "keep_final_step(task) keeps the final observations of episodes"
    " (legged/envs/final_observation.py)",
    "_disturbance_robots": "domain_rand.forces and kicks push robots; for other disturbances override disturb(mask) and"
    " call self.physics.push",
    "_step_contact_targets": "override advance(), call super().advance() and write your own tensors in place",
    "_fill_extras": "write a method _metric_<name> for each figure to be logged; step() returns its own extras",
    "_randomize_gravity": "domain_rand.ranges.gravity_x, _y and _z are added to gravity (docs/randomisation.md)",
    # Other methods of Isaac Lab.
    "_get_observations": _OBSERVE,
    "_get_rewards": "write a method _reward_<name> for each reward and set its scale in rewards.scales",
    "_get_dones": "write a method _terminate_<name> and list the name in terminations.failures or terminations.time_outs",
    "_reset_idx": "override reset_idx(mask), where mask has one bool per robot",
}
"""Hook of another framework -> hint at its replacement in this package."""
OBSERVES = re.compile(r"_?compute_\w*observations")
"""Names of methods that compute observations in other frameworks, in addition to those in HOOKS."""
OUTSIDE = {
    "step": "training runs _step() as a CUDA graph, not step(); override a hook of _step() and call the parent's hook in it",
    "get_observations": "training does not call it, but reads the buffers of observation_groups; " + _OBSERVE,
}
"""Method that play and evaluation call, but training does not -> hint at what to override instead."""

EXTENDED = {
    "advance": "otherwise episode_length_buf and self.contacts would stand still",
    "check_termination": "otherwise falls would not be counted, and robots whose physics has diverged would not be reset;"
    " write a method _terminate_<name> and list it in terminations.failures or terminations.time_outs",
    "compute_reward": "otherwise every reward would be 0; write a method _reward_<name>, with its scale in rewards.scales",
    "draw": "otherwise all episodes would begin in the same state, under the same commands",
    "remember": "otherwise last_actions and last_dof_vel would keep their initial values",
    "reset_idx": "otherwise no episode would begin",
}
"""Hook whose override must call super()'s method -> effect of a missing call."""
RESERVED = {"falls", "episode_length", "non_finite_worlds", "contact_overflows"}
"""Names of metrics that every task logs."""


def check_class(cls: Any) -> None:
    """Check a task class, and its parents that do not belong to this package.

    Raises:
        ConfigError: training would never call a method, and OWN_HELPERS does not list it; an override of a hook in EXTENDED
            does not call super()'s method; or a constructor takes other arguments than (self, cfg, device, graph). The text
            names all of these methods. Or else a metric has a name in RESERVED, or a quantity in QUANTITIES does not exist.
    """
    _check_overrides(cls)
    for name in RESERVED & cls.terms("_metric_"):
        raise ConfigError(f"{cls.__name__}._metric_{name}: every task logs Metrics/{name} already; rename the method")
    try:
        check_quantities(cls.QUANTITIES)
    except ValueError as error:
        raise ConfigError(f"{cls.__name__}.QUANTITIES: {error}") from error


def _check_overrides(cls: type) -> None:
    base = next(part for part in cls.__mro__ if part.__module__.startswith("legged."))
    between = [part for part in cls.__mro__ if part not in base.__mro__]
    helpers: set[str] = set()
    for part in between:
        own = vars(part).get("OWN_HELPERS", ())
        helpers |= {own} if isinstance(own, str) else set(own)
    wrong: dict[str, str] = {}
    in_vain: list[str] = []
    for part in between:
        for name, member in vars(part).items():
            fault = ""
            if name == "__init__":
                fault = _constructor_fault(member)
            elif name in EXTENDED and not _names(member, name):
                fault = f"must call super().{name}(): {EXTENDED[name]}"
            elif name not in helpers and (name in OUTSIDE or not hasattr(base, name)):
                fault = never_called(name)
                in_vain += [name] if fault else []
            if fault:
                wrong[f"{place(part, member)}: {part.__name__}.{name}"] = fault
    if wrong:
        names = f"'{in_vain[0]}'," if len(in_vain) == 1 else "..."
        called = f" (if your own code calls it, write OWN_HELPERS = ({names}) in the class)" if in_vain else ""
        raise ConfigError(_listed(wrong) + called)


def _listed(wrong: dict[str, str]) -> str:
    """Return the faults of methods as one text that fits into an error. `wrong` maps the place of a method to its fault.
    Methods with the same fault share its words. If the text is too long, the last methods are named without their faults.
    """
    texts: list[str] = []
    others: list[str] = []
    for fault in dict.fromkeys(wrong.values()):
        methods = [said for said in wrong if wrong[said] == fault]
        text = f"{', '.join(methods)} {fault}"
        if texts and sum(map(len, texts)) + len(text) > LONGEST // 2:
            others += [said.rpartition(".")[2] for said in methods]
        else:
            texts.append(text)
    return "; ".join(texts) + (f"; wrong too: {', '.join(others)}" if others else "")


def never_called(name: str) -> str:
    """Return what to write instead of a method `name` that training never calls; empty for any other name."""
    if name in OUTSIDE:
        return f"would have no effect: {OUTSIDE[name]}"
    hint = HOOKS.get(name) or (_OBSERVE if OBSERVES.fullmatch(name) else "")
    return f"would never be called: {hint}" if hint else ""


def _names(member: Any, name: str) -> bool:
    """Return whether the code of a method uses `name`. A member without code counts as one that does."""
    code = getattr(inspect.unwrap(member), "__code__", None)
    return code is None or name in names_in(code)


def names_in(code: CodeType) -> set[str]:
    """Return the names of the attributes and globals that a function or its nested functions use."""
    within = [constant for constant in code.co_consts if isinstance(constant, CodeType)]
    return set(code.co_names).union(*(names_in(constant) for constant in within))


def _constructor_fault(constructor: Any) -> str:
    """Return what is wrong with a constructor that does not take the arguments that the registry passes, else nothing."""
    try:
        inspect.signature(constructor).bind(None, None, "cpu", True)
    except TypeError as error:
        text = "must take (self, cfg, device, graph), without the arguments of Isaac Gym"
        return f"{text} ({error}); allocate buffers in _init_buffers()"
    except ValueError:  # the constructor has no signature
        pass
    return ""


KINDS = {"_reward_": "reward", "_obs_": "observation", "_terminate_": "termination"}
"""Prefix of a term's method -> word for the term in error messages."""


def named_terms(cfg: TaskConfig) -> list[tuple[str, str, str]]:
    """Return the terms that a configuration names. Each term is given as the prefix of its method, its name, and the dotted
    path of the setting that names the term.
    """
    named = [("_reward_", name, f"rewards.scales.{name}") for name in cfg.rewards.scales]
    for group, content in groups_in(cfg).items():
        named += [("_obs_", name, path_of_terms(cfg, group)) for name in content.terms]
    for part in ("scales", "noise", "bias", "delay", "dropped"):
        named += [("_obs_", name, f"observations.{part}.{name}") for name in getattr(cfg.observations, part)]
    for part in ("failures", "time_outs"):
        named += [("_terminate_", name, f"terminations.{part}") for name in getattr(cfg.terminations, part)]
    return named


def check_terms(cls: Any, cfg: TaskConfig) -> None:
    """Check that the terms that a configuration names exist and can be called, and that they declare a unit where one is
    needed.

    Raises:
        ConfigError: a term is missing, is not a method, or takes arguments; a group has no observations; a termination is a
            failure and a time-out; or a term in use has a number other than 0 that was rescaled from another robot, but
            declares no unit.
    """
    groups, error = cfg.observations.groups, cfg.origins.error
    for group in groups or ("actor",):
        if not groups or not groups[group].terms:
            empty = f"must not be empty{suggest('', cls.terms('_obs_'), 'observations')}"
            raise error(f"observations.groups.{group}.terms", empty)
    for prefix, name, path in named_terms(cfg):
        known = cls.terms(prefix)
        if name not in known:
            raise error(path, f"{cls.__name__} has no {KINDS[prefix]} '{name}'{suggest(name, known)}")
        if fault := _term_fault(cls, prefix + name):
            raise error(path, f"{cls.__name__}.{prefix}{name} {fault}")
    for name in cfg.terminations.failures:
        if name in cfg.terminations.time_outs:
            twice = f"'{name}' is also in terminations.failures; remove it from one of the two"
            raise error("terminations.time_outs", twice)
    _check_units(cls, cfg)


def _term_fault(cls: type, name: str) -> str:
    """Return why the attribute `name` of a class is not the method of a term; empty if it is one."""
    found = inspect.getattr_static(cls, name)
    if isinstance(found, property) or not callable(getattr(cls, name)):
        return f"is not a method but a {type(found).__name__}; a term is a method without arguments"
    # The signature of a plain method begins with `self`. The signature of a static or class method has only the arguments.
    bound = isinstance(found, classmethod | staticmethod)
    parameters = list(inspect.signature(getattr(cls, name)).parameters.values())
    if not bound and not (parameters and parameters[0].kind is not parameters[0].KEYWORD_ONLY):
        return "takes no self; a term is a method with self as its only argument"
    needed = [p.name for p in parameters if p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    listed = ", ".join(needed[0 if bound else 1 :])
    return f"takes arguments ({listed}); a term takes only self, and reads the task's tensors" if listed else ""


def _check_units(cls: Any, cfg: TaskConfig) -> None:
    """Check that every term in use whose number was rescaled from another robot declares its unit."""
    used = {"_reward_": set(cfg.rewards.scales), "_obs_": {name for g in groups_in(cfg).values() for name in g.terms}}
    fields = [(part, field) for part in ("rewards", "observations") for field in dataclasses.fields(getattr(cfg, part))]
    for section, field in fields:
        prefix, _ = field.metadata.get("unit_of", ("", 1))
        entries = getattr(getattr(cfg, section), field.name) if prefix in used else {}
        for name in (name for name, number in entries.items() if number and name in used[prefix]):
            path, method = f"{section}.{field.name}.{name}", f"{prefix}{name}"
            if cfg.origins.of(path) not in cfg.origins.rescaled or unit_of(getattr(cls, method)) is not None:
                continue
            parents = (unit_of(getattr(part, method, None)) for part in cls.__mro__)
            example = next((unit for unit in parents if unit is not None), "m^2/s^2")
            raise cfg.origins.error(
                path,
                f"the number is rescaled from another robot, but {cls.__name__}.{method} declares no unit. Write"
                f' @unit("{example}") above the method, with the unit of its return value (from legged import unit). For a'
                ' value without a unit, write @unit("1"). A unit in the docstring is not read',
            )


def place(cls: type, attribute: Any) -> str:
    """Return file and line of a class's attribute. If Python does not know the line, return the file or the module."""
    function = inspect.unwrap(getattr(attribute, "fget", None) or getattr(attribute, "__func__", attribute))
    code = getattr(function, "__code__", None)
    if code is not None:
        return f"{relative(Path(code.co_filename))}:{code.co_firstlineno}"
    module = inspect.getmodule(cls)
    return relative(Path(module.__file__)) if module is not None and module.__file__ else cls.__module__
