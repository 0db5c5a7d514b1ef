"""Mapping of a fork's settings and methods to a task."""

import re
from typing import Any

from legged.config.checks import build
from legged.config.dotted import value_at
from legged.config.legged import STATE_TERMS
from legged.config.origins import Origins
from legged.config.robot import TerrainConfig
from legged.envs import LeggedRobot
from legged.errors import ConfigError
from legged.migration import tables
from legged.migration.reading import DEFAULTS as OF_LEGGED_GYM
from legged.migration.reading import DIGESTS, Fork, Found
from legged.migration.translation import DEFAULTS, Translation, is_number
from legged.terrain import TERRAIN_TYPES
from legged.terrain.terrain import check_terrain

SIGMA = "tracking_sigma"
OF_HEADING = ("_post_physics_step_callback", "_resample_commands")
"""Methods of legged_gym that use commands[:, 3], the heading."""


def map_settings(fork: Fork) -> Translation:
    """Translate the settings and methods of a fork of legged_gym into a task."""
    result = Translation(_moved(fork.settings))
    for theirs, ours in tables.SAME.items():
        if theirs in tables.ABSENT and theirs not in result.theirs:
            result.put(ours, tables.ABSENT[theirs], "", "the fork has no such setting")
    result.take(tables.SAME)
    if not result.settings.get("domain_rand.randomize_base_mass", False):
        result.settings.pop("domain_rand.added_mass_range", None)
    _terrain(result, fork)
    _commands(result, fork)
    _contacts(result)
    _rewards(result, fork)
    _observations(result, fork)
    _recurrent(result)
    _random_model(result)
    _delay(result)
    _hooks(result, fork)
    _rest(result)
    return result


def _moved(settings: dict[str, Found]) -> dict[str, Found]:
    """Return the settings with legged_gym's paths in place of the fork's."""
    paths = {}
    for path in settings:
        start = next((old for old in tables.MOVED if path == old or (old.endswith(".") and path.startswith(old))), "")
        paths[path] = tables.MOVED[start] + path.removeprefix(start) if start else path
    return {paths[path]: found for path, found in settings.items() if paths[path] == path or paths[path] not in settings}


def _terrain(result: Translation, fork: Fork) -> None:
    mesh, path = result.get("terrain.mesh_type", "plane"), "terrain.terrain_proportions"
    result.done |= {path, *tables.OF_TERRAIN, *tables.OF_HEIGHTS}
    if result.get("terrain.measure_heights", False):
        result.take(tables.OF_HEIGHTS)
    if mesh in ("plane", "none", None):
        return
    if mesh not in ("trimesh", "heightfield"):
        result.lose("terrain.mesh_type", "terrain.mesh_type here is plane or height_map")
        return
    result.put("terrain.mesh_type", "height_map", "terrain.mesh_type")
    result.take(tables.OF_TERRAIN)
    rows = int(result.get("terrain.num_rows", 10.0))
    if result.get("terrain.max_init_terrain_level", 5.0) >= rows > 0:
        result.put("terrain.max_init_terrain_level", rows - 1, "terrain.max_init_terrain_level", "limited to the last row")
    named = path in result.theirs and isinstance(result.theirs[path].value, dict)
    _fits(result, "flat")
    shares = result.get(path, {}) if named else _shares(result.get(path, []), fork.terrains)
    shares = {name: share for name, share in shares.items() if share > 0.0}
    kept = {name: share for name, share in shares.items() if name in TERRAIN_TYPES and _fits(result, name)}
    unknown = [name for name in shares if name not in kept]
    if unknown:
        result.lose(path, f"unknown here, or too large for the tiles: {', '.join(unknown)}; docs/terrain.md lists the types")
    comment = "the fork's types do not exist here" if not kept else f"without {', '.join(unknown)}" if unknown else ""
    kept = kept or {"flat": 1.0}
    total = sum(kept.values())
    kept, joined = _of_whole_columns({name: share / total for name, share in kept.items()}, result)
    comment = comment or (f"{', '.join(joined)} would have less than one column" if joined else "")
    result.put("terrain.proportions", kept, path, comment)


def _shares(proportions: list[float], functions: list[Any] | None) -> dict[str, float]:
    """Return terrain type -> share. `functions` gives the types of each of `proportions`; None means legged_gym's types."""
    shares: dict[str, float] = {}
    kinds = tables.TERRAINS if functions is None else functions
    for i, share in enumerate(proportions):
        parts = kinds[i] if i < len(kinds) else [None]
        for part in parts:
            name = part
            if isinstance(part, list):
                name = tables.TERRAIN_FUNCTIONS.get(part[0], [""] * 3)[part[1] + 1] or part[0]
            name = name or f"entry {i + 1}"
            shares[name] = shares.get(name, 0.0) + share / len(parts)
    return shares


def _fits(result: Translation, name: str) -> bool:
    """Return True if a terrain type fits on the fork's tiles. If not even `flat` fits, take the default tiles."""
    sizes = {path.removeprefix("terrain."): v for path, v in result.settings.items() if path.startswith("terrain.")}
    try:
        check_terrain(build(TerrainConfig, sizes | {"proportions": {name: 1.0}}, ""), Origins())
    except ConfigError as error:
        if name != "flat":
            return False
        for path in tables.OF_TERRAIN:
            if result.settings.pop(path, None) is not None:
                result.lose(path, f"the terrain would be refused: {str(error).partition('terrain.')[2]}")
    return True


def _of_whole_columns(shares: dict[str, float], result: Translation) -> tuple[dict[str, float], list[str]]:
    """Give the shares of types with less than one column to other types. Return the new shares and the removed types."""
    columns, out = int(result.settings.get("terrain.num_cols", DEFAULTS["terrain"]["num_cols"])), []
    while len(shares) > 1 and min(shares.values()) * columns < 1.0 - 1e-9:
        name = min(shares, key=lambda key: shares[key])
        share = shares.pop(name)
        twin = name.replace("_up", "_down") if "_up" in name else name.replace("_down", "_up")
        shares[twin if twin in shares else max(shares, key=lambda key: shares[key])] += share
        out.append(name)
    rounded = {name: round(share, 4) for name, share in shares.items()}
    largest = max(rounded, key=lambda key: rounded[key])
    rounded[largest] = round(rounded[largest] + 1.0 - sum(rounded.values()), 4)
    return rounded, out


def _commands(result: Translation, fork: Fork) -> None:
    """Map the range of yaw rates in heading mode, where legged_gym clips to a number in its code, and the command curriculum.
    legged_gym widens the range of vx by 0.5 m/s at a time, up to max_curriculum.
    """
    path = "commands.ranges.ang_vel_yaw"
    if result.get("commands.heading_command") is True:
        clips = (method.reads["yaw"] for methods in fork.methods.values() for method in methods if "yaw" in method.reads)
        limit = float(next(clips, 1.0))
        result.put(path, [-limit, limit], "")
        if path in result.theirs and result.get(path) != [-limit, limit]:
            result.lose(path, f"the fork does not use it in heading mode; the range here is its limit there, {limit:g} rad/s")
    limit = result.get("commands.max_curriculum", 0.0)
    speeds = result.get("commands.ranges.lin_vel_x", [])
    if result.get("commands.curriculum", False) is not True or len(speeds) != 2:
        return
    low, high = speeds
    if limit <= max(-low, high):
        return
    comment = f"the fork widens {low:g} to {high:g} up to max_curriculum"
    result.put("commands.ranges.lin_vel_x", [-limit if low < 0 else low, limit], "commands.max_curriculum", comment)
    result.put("commands.curriculum.enabled", True, "commands.curriculum")
    start = round(max(-low, high) / limit, 4)
    comment = "share of the full range, on every axis; legged_gym widens only vx"
    result.put("commands.curriculum.start", start, "commands.max_curriculum", comment)


def _contacts(result: Translation) -> None:
    """Map self-collisions, friction and restitution. PhysX averages the robot's ranges with the ground's values."""
    for name, ours, of_ground, usual in tables.OF_CONTACTS:
        path = f"domain_rand.{name}_range"
        if path in result.theirs and result.get(f"domain_rand.randomize_{name}") is True:
            pair, ground = result.get(path, []), result.get(f"terrain.{of_ground}", usual)
            mean = [round(0.5 * (value + ground), 4) for value in pair]
            told = " to ".join(f"{value:g}" for value in pair)
            result.put(ours, mean, path, f"PhysX averages the robot's {told} with the ground's {ground:g}")
    path = "asset.self_collisions"
    if path in result.theirs and result.get(path, 1.0) == 0:
        if result.theirs[path].place.startswith("legged_gym's"):
            result.lose(path, "legged_gym simulates self-collisions by default; here sim.self_collisions=true does")
        else:
            result.put("sim.self_collisions", True, path, "in the fork this is a filter, and 0 allows self-collisions")


def _rewards(result: Translation, fork: Fork) -> None:
    """Map the scales of rewards that have legged_gym's formula. All other rewards get no scale. For these,
    a note lists the methods that the user has to paste.
    """
    known, prefix = LeggedRobot.terms("_reward_"), "rewards.scales."
    sigma, mapped, paste = "", set(), []
    for path in [path for path in result.theirs if path.startswith(prefix)]:
        name, found = path.removeprefix(prefix), result.theirs[path]
        scale = result.get(path, 0.0) if result.get(path) else 0.0
        if not scale:
            continue
        methods = fork.methods.get(f"_reward_{name}", [])
        own = next((method for method in methods if not method.original), None)
        # legged_gym's scale feet_stumble is meant for its method _reward_stumble, but has no effect because the names differ.
        ours = "stumble" if name == "feet_stumble" and not fork.methods else name
        then = f"rewards.scales.{name}: {scale:g}"
        if fork.methods and not methods:
            paste.append(f"nothing for {then} ({found.place}): the fork's classes have no _reward_{name}")
        elif own is not None or f"_reward_{ours}" not in DIGESTS or ours not in known:
            paste.append(f"_reward_{name} ({own.place if own else found.place}), then set {then}")
            sigma = sigma or (own.place if own is not None and SIGMA in own.reads else "")
        else:
            mapped.add(ours)
            result.put(f"{prefix}{ours}", float(scale), path)
    for name in [name for name in DEFAULTS["rewards"]["scales"] if name not in mapped]:
        result.put(f"{prefix}{name}", 0.0, "")
    path = f"rewards.{SIGMA}"
    if sigma and path in result.theirs:
        result.lose(path, f"divides the squared error here, but the formula at {sigma} differs: set it with that method")
    else:
        result.take({path: path})
    counted = f"{len(mapped)} of {len(mapped) + len(paste)} scales are mapped, with legged_gym's formulas"
    if not fork.methods:
        counted += "; no class with rewards was found near the file, so formulas of the same names are not compared"
    result.note("rewards", counted + (f"; {len(paste)} wait for the fork's own methods" if paste else ""))
    result.note("paste", *paste) if paste else None


def _observations(result: Translation, fork: Fork) -> None:
    """Map the observations that compute_observations joins. Without an environment class, guess them from their number."""
    numbers = [result.get(f"env.{name}") for name in ("num_observations", "num_privileged_obs")]
    history, one = (result.get(result.has(*names) or names[0]) for names in (tables.HISTORY, tables.ONE_STEP))
    if history is None and is_number(one) and is_number(numbers[0]) and one and numbers[0] % one == 0:
        history = numbers[0] // one
    groups: list[list[str] | None] = [None, None]
    if "compute_observations" not in fork.methods:
        (groups[0], steps), (groups[1], _) = (_by_number(result, number) for number in numbers)
        history = history or steps
        text = "guessed from their number, because no class was found near the file"
        if groups[0] is None:
            text = f"{numbers[0]} numbers are not legged_gym's observations: the default groups remain"
    elif fork.observations[0] is None:
        text = f"{fork.methods['compute_observations'][0].place} joins them in an unknown way: the default groups remain"
    else:
        own: list[str] = []
        groups = [part and _terms(part, own) for part in fork.observations]
        text = ", ".join(groups[0] or []) or "no terms of this package"
        if own:
            where = fork.methods["compute_observations"][0].place
            text += f"; write a method _obs_<name> for {', '.join(dict.fromkeys(own))} ({where})"
    if any("normal" in method.reads for method in fork.methods.get("compute_observations", [])):
        text += "; its noise is normal, here it is uniform: 1.73 times the fork's noise_level has the same variance"
    result.note("observations", text)
    if groups[0]:
        for group, terms in (("actor", groups[0]), ("critic", groups[1] or groups[0])):
            result.put(f"observations.groups.{group}.terms", terms, "env.num_observations")
    if isinstance(history, int) and history > 1:
        comment = "oldest first; forks may have the newest first"
        result.put("observations.groups.actor.history", history, "env.num_observations", comment)


def _terms(parts: list[list[str]], own: list[str]) -> list[str]:
    """Return the terms of this package for the parts of an observation. Add the names of parts without a term to `own`."""
    terms = []
    for names in parts:
        used = {name for name in names if "scale" not in name}
        term = next((term for term, its in tables.PARTS.items() if its == used), None)
        if term is None:
            first = next((name for name in names if name.startswith("self.")), names[0])
            own.append(re.sub(r"^self\.|[\[(].*|\.(unsqueeze|view|float|clone)$", "", first))
        elif term not in terms:
            terms.append(term)
    return terms


def _by_number(result: Translation, number: Any) -> tuple[list[str] | None, int]:
    """Return legged_gym's terms and the number of steps, at most 20, that give `number` numbers; None and 1 if none fit."""
    joints = int(result.get("env.num_actions", 12.0))
    groups = {12 + 3 * joints: list(STATE_TERMS), 9 + 3 * joints: list(STATE_TERMS[1:])}
    if result.get("terrain.measure_heights", False):
        columns, rows = (result.get(path, []) for path in tables.OF_HEIGHTS)
        groups = {size + len(columns) * len(rows): [*terms, "heights"] for size, terms in groups.items()} | groups
    fits = ((groups[size], steps) for steps in range(1, 21) for size in groups if number == steps * size)
    return next(fits, (None, 1))


def _recurrent(result: Translation) -> None:
    kind = result.theirs.get("runner.policy_class_name")
    if kind is not None and "Recurrent" in str(kind.value):
        result.done.add("runner.policy_class_name")
        result.take(tables.OF_RECURRENT)
        result.put("train.policy.rnn_type", result.get("policy.rnn_type", "lstm"), "policy.rnn_type")
    result.done |= set(tables.OF_RECURRENT)


def _random_model(result: Translation) -> None:
    """Map the randomised properties of forks; leave out those that are switched off."""
    rand = "domain_rand."
    for ours, names in tables.RANDOM_MODEL.items():
        for switch, _, other in (name.partition(":") for name in names.split()):
            switch, stem = f"{rand}randomize_{switch}", other or switch
            path = result.has(f"{rand}{stem}_range", f"{rand}randomize_{stem}_range")
            if path is None or switch not in result.theirs or result.theirs[switch].value is not True:
                continue
            pair = result.get(path, [])
            if len(pair) != 2:
                result.done -= {path} - {entry.setting for entry in result.lost}
                continue
            result.done.add(switch)
            # This package adds an offset to the measured angle. Forks add it to the target, so the sign changes.
            pair = [0 - pair[1], 0 - pair[0]] if ours == "joint_offset" else pair
            for field in ours.split():
                result.put(field if "." in field else f"domain_rand.ranges.{field}", pair, path)
    if result.has(f"{rand}rand_com_vec") and result.get(f"{rand}randomize_base_com", False):
        for axis, value in zip("xyz", result.get(f"{rand}rand_com_vec", []), strict=False):
            result.put(f"domain_rand.ranges.base_com_{axis}", [0 - value, value], f"{rand}rand_com_vec")
    if result.has("env.rand_yaw_range") and result.get("env.randomize_start_yaw", False):
        turn = result.get("env.rand_yaw_range", 0.0)
        result.put("init_state.yaw", [0 - turn, turn], "env.rand_yaw_range")
    for path, found in result.theirs.items():
        section, _, name = path.partition(".")
        if found.value is False and path.startswith(("domain_rand.", "env.randomize_")):
            off = rf"{section}\.(randomize_)?{re.escape(name.removeprefix('randomize_'))}(_.*)?$"
            result.done |= {other for other in result.theirs if re.match(off, other)}


def _delay(result: Translation) -> None:
    """Map delays of the motors' targets to physics steps."""
    rand, steps, lag = "domain_rand.", None, result.theirs.get("domain_rand.lag_timesteps")
    if result.has(f"{rand}delay_ms_range") and result.get(f"{rand}randomize_action_delay", False):
        steps = [round(ms / 1000 / result.get("sim.dt", 0.005)) for ms in result.get(f"{rand}delay_ms_range", [])]
    elif lag is not None and isinstance(lag.value, int) and result.get(f"{rand}randomize_lag_timesteps", False):
        steps = [result.get(f"{rand}lag_timesteps")] * 2
    elif result.has(f"{rand}delay") and result.get(f"{rand}delay") is True:
        steps = [0, int(result.get("control.decimation", 4.0)) - 1]
        result.put("control.actuator.delay_varies", True, f"{rand}delay")
    if steps is not None:
        result.put("control.actuator.delay", steps, f"{rand}delay", "in physics steps")


def _hooks(result: Translation, fork: Fork) -> None:
    """Note the fork's own methods that no setting replaces, and those that read the fourth or a later column of commands."""
    own = {name: method for name, methods in fork.methods.items() for method in methods if not method.original}
    hooks = [f"{name} ({own[name].place})" for name in own if not name.startswith(("_reward_", "compute_observations"))]
    if hooks:
        result.note("methods", f"move the fork's own methods by hand (docs/migrating.md): {', '.join(hooks)}")
    readers = [f"{name} ({m.place})" for name, m in own.items() if "fourth" in m.reads and name not in OF_HEADING]
    if readers:
        result.note("commands", f"commands[:, 3] is the heading here, and no column follows it; check {', '.join(readers)}")


def _rest(result: Translation) -> None:
    """List the settings of the file that no other function handled."""
    for path, found in result.theirs.items():
        changed = found.why_unknown or found.value != value_at(OF_LEGGED_GYM, path)
        if path in result.done or re.match(tables.OF_THE_ROBOT, path) or not changed:
            continue
        reason = next((text for pattern, text in tables.NEAR.items() if re.match(pattern, path, re.IGNORECASE)), "")
        items = found.value if isinstance(found.value, list) else [found.value]
        plain = not found.why_unknown and all(isinstance(item, bool | int | float | str) for item in items)
        if path.startswith("rewards.") and plain and not reason:
            name = path.removeprefix("rewards.").replace(".", "_")
            result.put(f"custom.{name}", found.value, path, f"read it as self.cfg.rewards.{name}")
        elif re.match(tables.MINOR, path):
            result.minor.append(path)
        else:
            result.lose(path, found.why_unknown or reason)
