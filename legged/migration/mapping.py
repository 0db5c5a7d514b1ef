"""Mapping of legged_gym's configuration classes to a task."""

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from legged.config.schema import STATE_TERMS
from legged.envs import LeggedRobot
from legged.migration.found import Found, Place
from legged.migration.legged_gym_defaults import LEFT_OUT
from legged.migration.settings import (
    ELSEWHERE,
    OF_HEIGHTS,
    OF_LEARNING,
    OF_RECURRENT,
    OF_TERRAIN,
    OF_THE_ROBOT,
    REWARDS,
    SAME,
    SAME_REWARDS,
    SECTIONS_ELSEWHERE,
    TERRAINS,
)
from legged.migration.translation import DEFAULTS, Translation, flat, is_number
from legged.terrain import TERRAIN_TYPES

LONGEST_HISTORY = 20
"""Largest number of steps of an observation history that is tried."""
BLIND_TERMS = STATE_TERMS[1:]
"""Usual observations of a robot that does not measure its velocity."""


def map_settings(environment: type, learner: type | None) -> Translation:
    """Map the configuration classes of an environment and of its learner."""
    theirs = flat(environment)
    learning = {} if learner is None else flat(learner)
    for section, values in LEFT_OUT.items():
        named = {path for path in learning if path.startswith(f"{section}.")}
        if named:  # a section without base class leaves missing settings to rsl_rl
            place = next(learning[path].place for path in sorted(named))
            learning |= {
                f"{section}.{name}": Found(value, Place(f"rsl_rl's default; {place}", 0))
                for name, value in values.items()
                if f"{section}.{name}" not in named
            }
    result = Translation(theirs | learning)
    result.take(SAME)
    _base_mass(result)
    _terrain(result)
    _commands(result)
    _friction(result)
    _collisions(result)
    _rewards(result)
    _observations(result)
    _learning(result)
    _random_model(result)
    _rest(result)
    return result


def _base_mass(result: Translation) -> None:
    """Remove the range of the base's mass if the mass is not randomised."""
    drawn = result.settings.get("domain_rand.randomize_base_mass", False)
    if not drawn:
        result.settings.pop("domain_rand.added_mass_range", None)


def _terrain(result: Translation) -> None:
    mesh = result.get("terrain.mesh_type", "trimesh")
    proportions = result.get("terrain.terrain_proportions")
    result.done |= set(OF_TERRAIN) | set(OF_HEIGHTS)
    if result.get("terrain.measure_heights", False):
        result.take(OF_HEIGHTS)
    if mesh in ("plane", "none", None):
        return
    if mesh not in ("trimesh", "heightfield"):
        result.lose("terrain.mesh_type", "terrain.mesh_type here is plane or height_map")
        return
    result.put("terrain.mesh_type", "height_map", "terrain.mesh_type")
    result.take(OF_TERRAIN)
    rows = int(result.number("terrain.num_rows", 10))
    if result.number("terrain.max_init_terrain_level", 5) >= rows > 0:
        result.put("terrain.max_init_terrain_level", rows - 1, "terrain.max_init_terrain_level", "of the rows there are")
    if isinstance(proportions, dict):
        given = {name: share for name, share in result.table("terrain.terrain_proportions").items() if share > 0.0}
        shares = {name: share for name, share in given.items() if name in TERRAIN_TYPES}
        if len(shares) < len(given):
            result.lose("terrain.terrain_proportions", f"types here are {', '.join(TERRAIN_TYPES)}")
    else:
        shares = _shares(result, result.numbers("terrain.terrain_proportions", []))
    total = sum(shares.values())
    if not total:
        result.put(
            "terrain.proportions", {"flat": 1.0}, "terrain.terrain_proportions", "none of the file's types exists here"
        )
        return
    comment = "" if abs(total - 1.0) < 1e-6 else f"theirs sum to {total:g}"
    columns = max(1, int(result.number("terrain.num_cols", 20)))
    shares, joined = _of_whole_columns({name: share / total for name, share in shares.items()}, columns)
    if joined:
        comment = f"{', '.join(joined)} would have less than one of {columns} columns"
    result.put("terrain.proportions", shares, "terrain.terrain_proportions", comment)


def _shares(result: Translation, proportions: list[Any]) -> dict[str, float]:
    """Return terrain type -> share, from a list in legged_gym's order."""
    shares: dict[str, float] = {}
    for share, types in zip(proportions, TERRAINS, strict=False):
        for name, part in types.items() if share > 0.0 else ():
            shares[name] = float(share) * part
    more = [share for share in proportions[len(TERRAINS) :] if share]
    if more:
        result.lose(
            "terrain.terrain_proportions",
            f"legged_gym has {len(TERRAINS)} types; later entries have a meaning of the fork's, and are left out",
        )
    return shares


def _of_whole_columns(shares: dict[str, float], columns: int) -> tuple[dict[str, float], list[str]]:
    """Return shares rounded to whole columns, at least one each, and the types that have less than one column and are left
    out.
    """
    out: list[str] = []
    while len(shares) > 1 and min(shares.values()) * columns < 1.0 - 1e-9:
        name = min(shares, key=lambda key: shares[key])
        share = shares.pop(name)
        twin = name.replace("_up", "_down") if "_up" in name else name.replace("_down", "_up")
        taker = twin if twin in shares else max(shares, key=lambda key: shares[key])
        shares[taker] += share
        out.append(name)
    rounded = {name: round(share, 4) for name, share in shares.items()}
    largest = max(rounded, key=lambda key: rounded[key])
    rounded[largest] = round(rounded[largest] + 1.0 - sum(rounded.values()), 4)
    return rounded, out


def _commands(result: Translation) -> None:
    """Map the command curriculum: legged_gym widens vx by 0.5 m/s up to max_curriculum."""
    limit = result.number("commands.max_curriculum", 0.0)
    speeds = result.numbers("commands.ranges.lin_vel_x", [-1.0, 1.0])
    if result.get("commands.curriculum", False) is not True or len(speeds) != 2:
        return
    low, high = speeds
    if limit <= max(-low, high):
        return
    result.put("commands.ranges.lin_vel_x", [-limit if low < 0 else low, limit], "commands.max_curriculum")
    result.put("commands.curriculum.enabled", True, "commands.curriculum")
    start = round(max(-low, high) / limit, 3)
    comment = "of the full range, on every axis; legged_gym widens vx alone"
    result.put("commands.curriculum.start", start, "commands.max_curriculum", comment)


def _friction(result: Translation) -> None:
    """Average the robot's friction with the ground's, as PhysX does; MuJoCo takes the robot's."""
    own = result.numbers("domain_rand.friction_range", [])
    ground = result.number("terrain.static_friction", 1.0)
    if len(own) != 2:
        return
    mean = [round(0.5 * (value + ground), 4) for value in own]
    comment = f"PhysX averages the robot's {own[0]:g} to {own[1]:g} with the ground's {ground:g}"
    if result.get("domain_rand.randomize_friction", True):
        result.put("domain_rand.friction_range", mean, "domain_rand.friction_range", comment)


def _collisions(result: Translation) -> None:
    path = "asset.self_collisions"
    if result.number(path, 1) == 0:
        if path in result.theirs and not result.theirs[path].place.file.startswith("legged_gym's"):
            result.put("sim.self_collisions", True, path, "theirs is a filter, 0 lets through")
        else:
            result.lose(path, "legged_gym lets a robot touch itself unless told otherwise; sim.self_collisions=true does")


def _rewards(result: Translation) -> None:
    known = LeggedRobot.terms("_reward_")
    prefix = "rewards.scales."
    scales = {path.removeprefix(prefix): found for path, found in result.theirs.items() if path.startswith(prefix)}
    for name, found in scales.items():
        ours = REWARDS.get(name, name)
        path = f"{prefix}{name}"
        if found.why_unknown:
            result.lose(path, found.why_unknown)
        elif found.value is not None and not is_number(found.value):
            result.lose(path, "expected a number")
        elif ours in known:
            if found.value or ours in DEFAULTS["rewards"]["scales"]:
                result.put(f"rewards.scales.{ours}", float(found.value or 0.0), path)
            if found.value and ours not in SAME_REWARDS:
                result.lose(
                    path,
                    f"is the reward of that name here, whose formula may differ; for yours write a method _reward_{name}",
                )
        elif found.value:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
            hint = f"; the nearest is {near[0]}" if near else ""
            own = f"a method _reward_{name} and rewards.scales.{name}: {found.value}"
            result.lose(path, f"there is no reward of that name here{hint}; write {own} (docs/migrating.md)")
        result.done.add(path)
    for name in DEFAULTS["rewards"]["scales"]:
        if name not in {REWARDS.get(other, other) for other in scales}:
            result.put(f"rewards.scales.{name}", 0.0, "", "theirs have none")


def _observations(result: Translation) -> None:
    """Infer the observation terms from the number of observations."""
    joints = int(result.number("env.num_actions", 12))
    points = len(result.numbers("terrain.measured_points_x", [])) * len(result.numbers("terrain.measured_points_y", []))
    measured = bool(result.get("terrain.measure_heights", False)) and points > 0
    number, seen_by_critic = result.get("env.num_observations"), result.get("env.num_privileged_obs")
    actor = _terms(result, number, joints, points if measured else 0, "env.num_observations")
    _group(result, "actor", *actor, "env.num_observations")
    critic = actor
    if seen_by_critic is not None:
        critic = _terms(result, seen_by_critic, joints, points if measured else 0, "env.num_privileged_obs")
    _group(result, "critic", *critic, "env.num_privileged_obs")


def _terms(result: Translation, number: Any, joints: int, points: int, theirs: str) -> tuple[list[str], int]:
    """Return the usual terms with exactly this many numbers, and their number of steps; if no group has it, the largest group
    that fits.
    """
    groups = {12 + 3 * joints: list(STATE_TERMS), 9 + 3 * joints: list(BLIND_TERMS)}
    if points:
        groups = {size + points: [*terms, "heights"] for size, terms in groups.items()} | groups
    for history in range(1, LONGEST_HISTORY + 1):
        for size, terms in groups.items():
            if number == history * size:
                return terms, history
    if not isinstance(number, int) or theirs not in result.theirs:
        return list(STATE_TERMS), 1
    size = max((size for size in groups if size < number), default=min(groups))
    more = f"{number - size} more are the fork's own" if size < number else "which are more than that"
    result.lose(
        theirs,
        f"{', '.join(groups[size])} are {size} numbers, {more}; write a method _obs_<name> for each, and list the terms in"
        " observations.groups",
    )
    return groups[size], 1


def _group(result: Translation, group: str, terms: list[str], history: int, theirs: str) -> None:
    path = f"observations.groups.{group}"
    result.put(f"{path}.terms", terms, theirs)
    result.put(f"{path}.history", history, theirs, "oldest first; forks have the newest first" if history > 1 else "")


def _learning(result: Translation) -> None:
    result.take(OF_LEARNING)
    if result.settings.get("train.runner.experiment_name") == "test":  # legged_gym's default
        del result.settings["train.runner.experiment_name"]
    kind = result.get("runner.policy_class_name", "ActorCritic")
    if "Recurrent" in str(kind):
        result.take(OF_RECURRENT)
        result.put("train.policy.rnn_type", result.get("policy.rnn_type", "lstm"), "policy.rnn_type")
    elif kind != "ActorCritic":
        result.lose("runner.policy_class_name", "networks here are those of train.policy")
    else:
        result.done |= set(OF_RECURRENT)
    for path, usual in (("runner.algorithm_class_name", "PPO"), ("runner_class_name", "OnPolicyRunner")):
        if result.get(path, usual) != usual:
            result.lose(path, f"training here is rsl-rl's {usual}")


RANDOM_MODEL = (
    ("link_mass", "link_mass", ("link_mass",)),
    ("motor_strength", "motor_strength", ("motor_strength",)),
    ("restitution", "restitution", ("restitution",)),
    ("com_displacement", "com_displacement", ("base_com_x", "base_com_y", "base_com_z")),
    ("kp", "kp", ("p_gain",)),
    ("kd", "kd", ("d_gain",)),
    ("gains", "stiffness_multiplier", ("p_gain",)),
    ("gains", "damping_multiplier", ("d_gain",)),
    ("motor_offset", "motor_offset", ("joint_offset",)),
)
"""Randomised properties of forks: randomize_<first> switches on <second>_range; the third is the property here with that
meaning.
"""


def _random_model(result: Translation) -> None:
    """Map the randomised properties of forks that have the same meaning here; leave out those that are switched off."""
    prefix = "domain_rand."
    mapped, waiting = set(), set()
    for name_of_switch, name, fields in RANDOM_MODEL:
        switch, path = f"{prefix}randomize_{name_of_switch}", f"{prefix}{name}_range"
        on, values = result.get(switch), result.numbers(path, [])
        if on and len(values) == 2:
            mapped.add(switch)
            for field_of_model in fields:
                result.put(f"domain_rand.ranges.{field_of_model}", list(values), path)
        elif on is not False:
            waiting |= {switch, path} if on else {path}
    # Properties that may be switched on and have no meaning here are listed with the rest.
    result.done -= waiting - mapped - {entry.setting for entry in result.lost}
    angles = result.get(f"{prefix}initial_joint_pos_range")
    if result.get(f"{prefix}randomize_initial_joint_pos", False) and angles is not None:
        result.put("init_state.dof_pos_factor", angles, f"{prefix}initial_joint_pos_range")
    for path in [path for path in result.theirs if path.startswith(f"{prefix}randomize_")]:
        if path not in result.done and result.theirs[path].value is False:
            result.done |= {path, f"{prefix}{path.removeprefix(f'{prefix}randomize_')}_range"}


def _rest(result: Translation) -> None:
    """List the settings of the file that no other function handled."""
    for path in [path for path in result.theirs if path not in result.done and path not in OF_THE_ROBOT]:
        if not result.given(path):
            continue
        section = next((why for start, why in SECTIONS_ELSEWHERE.items() if path.startswith(start)), None)
        reason = ELSEWHERE.get(path, section)
        found = result.theirs[path]
        if path.startswith("rewards.") and not found.why_unknown and _is_plain(found.value):
            name = path.removeprefix("rewards.").replace(".", "_")
            result.put(f"custom.{name}", found.value, path, f"self.cfg.custom['{name}']; theirs is self.cfg.{path}")
        else:
            result.lose(path, reason or found.why_unknown or f"no setting here has that meaning{_near(path)}")


def _is_plain(value: Any) -> bool:
    return isinstance(value, bool | int | float | str) or (
        isinstance(value, list | tuple) and all(isinstance(item, bool | int | float | str) for item in value)
    )


def _near(path: str) -> str:
    """Return a hint at the setting with the nearest name."""
    names = {name.rpartition(".")[2]: name for name in _paths(DEFAULTS)}
    near = difflib.get_close_matches(path.rpartition(".")[2], names, n=1, cutoff=0.75)
    return f"; the nearest name is {names[near[0]]}" if near else ""


def _paths(data: Mapping[str, Any], prefix: str = "") -> Iterable[str]:
    for key, value in data.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _paths(value, f"{prefix}{key}.")
