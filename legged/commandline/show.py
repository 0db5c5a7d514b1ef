"""Summary of a configuration for `--show`: tables of observations, rewards, terminations, actions and joints."""

import inspect
from collections.abc import Iterator
from pathlib import Path

import mujoco
import torch

from legged.config import TaskConfig, override
from legged.config.networks import groups_in
from legged.config.randomization import DrawConfig
from legged.config.robot import RobotDomainRandConfig
from legged.envs import BaseTask, is_robot_task
from legged.mdp.control import action_scales
from legged.mdp.distributions import standard_deviation
from legged.physics import FIELDS
from legged.registry import make_task
from legged.robots.similarity import Size, growth, size_of

ALONE = [("env.num_envs", 1), ("sim.physics", "mujoco"), ("sim.threads", 1), ("train.algorithm.num_mini_batches", 1)]
"""Overrides with which a task of one robot can be built on any machine."""


def summary(cfg: TaskConfig) -> list[str]:
    """Build the task that `cfg` configures, with one robot on the C engine, and return lines that describe the task. Each
    line begins with '#', so that the lines may follow a configuration in YAML.

    Raises:
        ConfigError: the task cannot be built.
        TermError: one of its terms fails.
    """
    if torch.get_num_threads() > 1:
        torch.set_num_threads(1)
    task = make_task(override(cfg, ALONE), "cpu", graph=False)
    parts = (_robot, _observations, _rewards, _terminations, _randomisation, _actions, _joints)
    return [f"# {line}".rstrip() for part in parts for line in part(task)]


def _says(task: BaseTask, method: str) -> str:
    """Return the first sentence of a term's docstring."""
    text = " ".join((inspect.getdoc(getattr(task, method)) or "").split())
    return text.partition(". ")[0].rstrip(".")


def _table(title: str, *rows: tuple[str, ...]) -> Iterator[str]:
    """Yield the lines of a table: an empty line, the title, and the rows with aligned columns."""
    yield from ("", title)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    widths[-1] = 0
    for row in rows:
        yield "  " + "  ".join(map(str.ljust, row, widths))


_number = "{:.6g}".format


def _robot(task: BaseTask) -> Iterator[str]:
    """Yield the size of a legged robot, and the factors by which settings written for another robot are rescaled."""
    if not is_robot_task(task):
        return
    size = Size(task.robot.mass, task.robot.height)
    line = f"robot: {task.robot.name}, {size.mass:.4g} kg, {size.height:.3g} m high"
    for name in task.cfg.origins.reference_robots:
        by = growth(size_of(name), size)
        if set(by.values()) == {1.0}:
            line += "; its settings are written for this robot"
        else:
            factors = f"masses x {by['kg']:.3g}, lengths x {by['m']:.3g}, times x {by['s']:.3g}"
            line += f"; numbers written for {Path(name).name} are rescaled: {factors}"
    yield from ("", line)


def _observations(task: BaseTask) -> Iterator[str]:
    for name, group in task.observation_groups.items():
        width = sum(len(term.scale) for term in group.terms)
        rows = [("columns", "term", "scale", "noise", "what it is")]
        for term in group.terms:
            scales = term.scale.tolist()
            scales = scales[:1] if len(set(scales)) == 1 else scales
            noise = f"+-{_number(term.noise)}" if term.noise else "-"
            errors = task.observation_terms.errors if groups_in(task.cfg)[name].noise else None
            if errors is not None and term.name in errors.names:
                noise = errors.describe(term.name)
            columns = f"{term.columns.start}:{term.columns.stop}"
            rows.append((columns, term.name, ", ".join(map(_number, scales)), noise, _says(task, f"_obs_{term.name}")))
        steps = f" x {group.history} steps, oldest first" if group.history > 1 else ""
        yield from _table(f"observations '{name}': {width} numbers{steps}; noise is added before scaling", *rows)


def _rewards(task: BaseTask) -> Iterator[str]:
    scales = task.cfg.rewards.scales
    times = f"times the control step of {task.dt:g} s" if task.cfg.rewards.times_dt else "per control step"
    rows = [("reward", "scale", "what it is")]
    rows += [(name, _number(scales[name]), _says(task, f"_reward_{name}")) for name in task.rewards.names]
    off = [name for name, scale in scales.items() if scale == 0.0]
    clip = "; their sum is clipped at 0" if task.cfg.rewards.only_positive_rewards else ""
    yield from _table(f"rewards, {times}{clip}{'; off: ' + ', '.join(off) if off else ''}", *rows)


def _terminations(task: BaseTask) -> Iterator[str]:
    failures, time_outs = task.active_terminations()
    rows = [("termination", "kind", "what it is")]
    for kind, names in (("failure", failures), ("time-out", time_outs)):
        rows += [(name, kind, _says(task, f"_terminate_{name}")) for name in names]
    rows.append(("(time)", "time-out", f"{task.max_episode_length} control steps, {task.cfg.env.episode_length_s:g} s"))
    rows.append(("(numbers)", "failure", "a number of the physics, a reward or an observation is not finite"))
    yield from _table("terminations", *rows)


def _randomisation(task: BaseTask) -> Iterator[str]:
    """Yield two tables: randomised properties and disturbances. Settings with legged_gym's names are included."""
    rand, draws = task.cfg.domain_rand, task.randomization.draws
    drawn = {name: (draw, task.randomization.is_each(name)) for name, draw in draws.items()}
    pushes: list[tuple[str, str, str]] = []
    if isinstance(rand, RobotDomainRandConfig):
        mass = ("added_base_mass", rand.randomize_base_mass, rand.added_mass_range)
        for name, on, span in (mass, ("friction", rand.randomize_friction, rand.friction_range)):
            if on and name not in draws:
                drawn = {name: (DrawConfig(range=span), False)} | drawn
        pushes += _pushes(rand)
    rows = []
    for name, (draw, each) in drawn.items():
        sigma = f", sigma {_number(standard_deviation(draw))}" if draw.distribution == "gaussian" else ""
        moment = {"start": "once", "reset": "each episode", "interval": f"every {_number(draw.interval_s)} s"}[draw.when]
        moment += _grown(draw.grow) + (f", for each of {task.field_rows[name]}" if each else "")
        field = FIELDS[name]
        rows.append((name, _span(draw.range, field.unit), draw.distribution + sigma, moment, field.meaning))
    if rows:
        header = ("property", "range", "distribution", "drawn", "what it is")
        yield from _table("randomised properties; by default play and evaluation do not randomise", header, *rows)
    if pushes:
        yield from _table("disturbances", ("name", "how much", "when"), *pushes)


def _span(span: tuple[float, float], unit: str) -> str:
    return f"{_number(span[0])} to {_number(span[1])}{'' if unit == '1' else f' {unit}'}"


def _grown(grow: tuple[float, float]) -> str:
    return f", grows over iterations {grow[0]:g} to {grow[1]:g}" if grow[1] else ""


def _pushes(rand: RobotDomainRandConfig) -> Iterator[tuple[str, str, str]]:
    """Yield for each disturbance its name, its size, and when it acts."""
    if rand.push_robots:
        size = f"sets the base's horizontal velocity, x and y +-{_number(rand.max_push_vel_xy)} m/s"
        yield "push_robots", size, f"every {_number(rand.push_interval_s)} s"
    for name, kick in rand.kicks.items():
        parts = [(axis, "m/s" if axis in "xyz" else "rad/s") for axis in ("x", "y", "z", "roll", "pitch", "yaw")]
        size = ", ".join(f"{axis} {_span(getattr(kick, axis), unit)}" for axis, unit in parts if any(getattr(kick, axis)))
        yield name, f"adds to the base's velocity: {size}", f"every {_span(kick.interval_s, 's')}{_grown(kick.grow)}"
    for name, force in rand.forces.items():
        given = [axis for axis in ("x", "y", "z", "size") if any(getattr(force, axis))]
        size = ", ".join(f"{axis} {_span(getattr(force, axis), 'N')}" for axis in given)
        place = f"a joint of {', '.join(force.joints)}" if force.joints else force.body or "the base"
        moments = f"for {_span(force.duration_s, 's')}, every {_span(force.interval_s, 's')}{_grown(force.grow)}"
        yield name, f"force on {place}: {size}", moments
    if (goals := rand.held_goals).step:
        change = f"goals of held joints change by sigma {_number(goals.step)} rad{', mirrored' if goals.mirrored else ''}"
        yield "held_goals", change, f"every {_number(goals.period_s)} s{_grown(goals.grow)}"


def _actions(task: BaseTask) -> Iterator[str]:
    model, clip = task.physics.model, task.cfg.control.clip_actions
    rows = [("action", "actuator", "what it does")]
    acted = list(task.control.acted) if is_robot_task(task) else list(range(task.num_actions))
    for i in range(model.nu):
        rows.append((str(acted.index(i)) if i in acted else "-", model.actuator(i).name or f"({i})", _effect(task, i)))
    yield from _table(f"actions: {task.num_actions} numbers, clipped at +-{clip:g}", *rows)


def _effect(task: BaseTask, i: int) -> str:
    """Return the effect of actuator `i` as text."""
    model = task.physics.model
    on_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
    gains = model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
    bias = model.actuator_biastype[i] != mujoco.mjtBias.mjBIAS_NONE
    # A joint's motor (fixed gain, no bias) has a force proportional to the control. For others, the text has the control.
    if not on_joint or not gains or bias:
        return f"control {float(task.control_middle[i]):g} + {float(task.control_reach[i]):g} a"
    number = int(model.actuator_trnid[i, 0])
    joint = model.joint(number).name or f"({number})"
    if not is_robot_task(task):
        force = float(model.actuator_gear[i, 0] * model.actuator_gainprm[i, 0])
        middle = float(task.control_middle[i]) * force
        slides = model.jnt_type[number] == mujoco.mjtJoint.mjJNT_SLIDE
        offset = f"{middle:g} + " if middle else ""
        return f"{joint}: {offset}{float(task.control_reach[i]) * force:g} a [{'N' if slides else 'N m'}]"
    control, law = task.control, task.cfg.control
    p, d, limit = (float(control.nominal[name][i]) for name in ("p_gain", "d_gain", "torque_limit"))
    scales = dict(zip(control.acted, action_scales(task.robot, law).tolist(), strict=True))
    if i not in scales:
        goal = " + its goal" if task.cfg.domain_rand.held_goals.step else ""
        target = f"position {float(task.default_dof_pos[i]):g}{goal} [rad], held"
    elif control.laws[i] == "P":
        target = f"position {float(task.default_dof_pos[i]):g} + {scales[i]:g} a [rad]"
    else:
        target = f"{'velocity' if control.laws[i] == 'V' else 'torque'} {scales[i]:g} a"
    gains = "" if control.laws[i] == "T" else f", stiffness {p:g}, damping {d:g}"
    motor = "" if control.actuator is None else f"; {control.actuator.describe(i)}"
    rotor = f", rotor {task.robot.armature[i]:g} kg m^2" if task.robot.armature[i] else ""
    return f"{joint}: {target}{gains}, torque at most {limit:g} N m{rotor}{motor}"


def _joints(task: BaseTask) -> Iterator[str]:
    model = task.physics.model
    kinds = {int(kind): kind.name.removeprefix("mjJNT_").lower() for kind in mujoco.mjtJoint.__members__.values()}
    rows = [("joint", "kind", "qpos", "qvel", "range")]
    for i in range(model.njnt):
        joint = model.joint(i)
        places = ((int(joint.qposadr[0]), joint.qpos0), (int(joint.dofadr[0]), joint.damping))
        qpos, qvel = (f"{first}:{first + len(numbers)}" for first, numbers in places)
        limits = f"{joint.range[0]:.4g} to {joint.range[1]:.4g}" if joint.limited else "-"
        rows.append((joint.name or f"({i})", kinds[int(joint.type[0])], qpos, qvel, limits))
    yield from _table(f"joints: {model.nq} positions, {model.nv} velocities", *rows)
