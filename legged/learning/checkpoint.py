"""Checkpoint files. They hold plain data, are written atomically, and are checked before anything is built from them.

The layout is rsl-rl's (actor_state_dict, critic_state_dict, optimizer_state_dict, iter, infos). The entries that this package
adds are in `infos`.
"""

import hashlib
import inspect
import io
import math
import pickle
import textwrap
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from legged.config import TaskConfig, has_robot
from legged.config.networks import NETWORKS, groups_in, groups_of
from legged.envs import BaseTask
from legged.errors import ConfigError
from legged.learning.run_folder import FROM_LEGGED_GYM, checkpoints
from legged.process.paths import relative, write_bytes
from legged.robots.robot import load_robot

FORMAT = 2
"""Version of `infos`."""
NEEDED = ("format", "observations", "histories", "networks", "optimizer")
"""Entries of `infos` that every checkpoint has."""
Saved = dict[str, Any]


def write_checkpoint(path: Path, saved: Saved) -> None:
    """Write a checkpoint atomically."""
    buffer = io.BytesIO()  # if the disk is full, torch.save to a file hides the cause
    torch.save(saved, buffer)
    write_bytes(path, buffer.getbuffer())


def load_plain(path: Path, device: str = "cpu") -> Any:
    """Return the content of a torch file that holds only plain data: numbers, text, tensors, lists, dictionaries. No code in
    it runs.

    Raises:
        ConfigError: the file can't be read, is not a torch file, or holds more than plain data.
    """
    name = relative(path)
    try:
        path.open("rb").close()
    except OSError as error:
        raise ConfigError(f"{name}: cannot be read ({error.strerror or error})") from error
    _check_sums(path)
    try:
        return torch.load(path, weights_only=True, map_location=device)
    except pickle.UnpicklingError as error:
        if "weights_only" in str(error):
            raise ConfigError(f"{name}: not a checkpoint (it holds more than plain data, so it could run code)") from error
        raise ConfigError(f"{name}: not a checkpoint ({_first_line(error)})") from error
    except Exception as error:  # torch raises half a dozen types of errors for a foreign file
        raise ConfigError(f"{name}: not a checkpoint ({_first_line(error)})") from error


def _check_sums(path: Path) -> None:
    """Compare the parts of a torch file with their checksums, which torch.load ignores.

    Raises:
        ConfigError: the file is damaged. The message names the newest other checkpoint before it in its folder.
    """
    if not zipfile.is_zipfile(path):
        return  # torch.load tells what the file is
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except Exception as error:  # zipfile raises half a dozen types of errors for a damaged archive
        damaged = _first_line(error)
    if damaged is None:
        return
    saved = checkpoints(path.parent)
    iteration = next((number for number, other in saved.items() if other == path), math.inf)
    older = max((number for number in saved if number < iteration), default=None)
    hint = "" if older is None else f"; use an older one: --checkpoint {older} ({saved[older].name})"
    raise ConfigError(f"{relative(path)}: not a checkpoint any more: the file is damaged (wrong checksum: {damaged}){hint}")


def _first_line(error: Exception) -> str:
    lines = str(error).splitlines()
    return lines[0][:200] if lines else type(error).__name__


def read_checkpoint(path: Path, device: str = "cpu") -> Saved:
    """Return the content of a checkpoint. Check the types of its entries, and that all weights are finite.

    Raises:
        ConfigError: the file is missing, is not a checkpoint of this package, has a newer format, or is damaged.
    """
    saved = load_plain(path, device)
    name = relative(path)
    if isinstance(saved, dict) and "model_state_dict" in saved:
        raise ConfigError(f"{name}: a checkpoint of rsl-rl before 5.0; {FROM_LEGGED_GYM}")
    if not isinstance(saved, dict) or not {"actor_state_dict", "iter"} <= saved.keys():
        raise ConfigError(f"{name}: not a checkpoint of rsl-rl (it lacks actor_state_dict or iter)")
    infos = {} if saved.get("infos") is None else saved["infos"]
    _check_kind(f"{name}: not a checkpoint: its", saved, PARTS)
    _check_kind(f"{name}: not a checkpoint: its infos.", infos, INFOS)
    if saved["iter"] < 0:
        raise ConfigError(f"{name}: not a checkpoint: its iteration is {saved['iter']}")
    if (version := infos.get("format", FORMAT)) > FORMAT:
        raise ConfigError(f"{name}: written in format {version} by a newer legged; this one reads formats up to {FORMAT}")
    if missing := [entry for entry in NEEDED if entry not in infos]:
        raise ConfigError(f"{name}: not a checkpoint of this version of legged (its infos lack {', '.join(missing)})")
    for network in networks_in(saved):
        check_weights(saved[f"{network}_state_dict"], f"{name}: its {network}")
    return {**saved, "infos": infos}


def networks_in(saved: Mapping[str, Any]) -> list[str]:
    """Return the names of the networks in a checkpoint: actor and critic, or the actor alone."""
    return [network for network in NETWORKS if f"{network}_state_dict" in saved]


Kind = type | tuple[type, ...] | dict[Any, Any]
PLAIN = (bool, int, float, str, type(None))
PARTS: dict[str, Kind] = {
    "iter": int,
    "infos": (dict, type(None)),
    **{f"{network}_state_dict": dict for network in (*NETWORKS, "teacher")},
    "optimizer_state_dict": {str: (dict, list)},
}
INFOS: dict[str, Kind] = {
    "format": int,
    "id": str,
    "task": str,
    "task_state": {str: {str: Tensor}},
    "observations": {str: {str: int}},
    "histories": {str: int},
    "networks": {str: {str: (*PLAIN, list)}},
    "optimizer": str,
    "robot": {str: (str, list)},
    "transferred_from": {str: (str, int)},
    "teacher": {str: (str, int)},
    "learning_rate": float,
    "wall_s": float,
    "evaluation": {str: float},
    "terms": {str: str},
}
"""Entry -> allowed type: one type, a tuple of types, or {type of the keys: type of the values}."""


def _check_kind(where: str, found: Mapping[str, Any], kinds: Mapping[str, Kind]) -> None:
    """Raise ConfigError if an entry of `found` has the wrong type. Missing entries are allowed, because the code that reads
    an entry checks that it exists.
    """
    for key, kind in kinds.items():
        if key not in found:
            continue
        value, wanted = found[key], dict if isinstance(kind, dict) else kind
        if not is_kind(value, wanted):
            names = " or ".join(t.__name__ for t in wanted) if isinstance(wanted, tuple) else wanted.__name__
            raise ConfigError(f"{where}{'' if where.endswith('.') else ' '}{key} is {type(value).__name__}, not {names}")
        if not is_kind(value, kind):
            raise ConfigError(f"{where}{'' if where.endswith('.') else ' '}{key} is damaged")


def is_kind(value: Any, kind: Kind) -> bool:
    """Return True if a value has the type `kind`. Numbers must be finite. Lists may hold plain values and dictionaries."""
    if isinstance(kind, dict):
        ((of_keys, of_values),) = kind.items()
        return isinstance(value, dict) and all(is_kind(k, of_keys) and is_kind(v, of_values) for k, v in value.items())
    if isinstance(kind, tuple):
        return any(is_kind(value, one) for one in kind)
    if kind is list:
        return isinstance(value, list) and all(isinstance(item, (*PLAIN, dict)) for item in value)
    if kind in (int, float):
        numbers = int if kind is int else (int, float)
        return isinstance(value, numbers) and not isinstance(value, bool) and abs(value) < math.inf
    return isinstance(value, kind)  # type: ignore[arg-type]


def check_weights(state: dict[str, Any], where: str) -> None:
    """Raise ConfigError, with a text that begins with `where`, if a network's state is not made of finite tensors."""
    for name, tensor in state.items():
        if not isinstance(name, str) or not isinstance(tensor, Tensor):
            raise ConfigError(f"{where} is damaged ({name!r} is not a tensor)")
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise ConfigError(f"{where} is damaged ({name} holds NaN or infinite numbers)")


def fit_optimizer(saved: Any, optimizer: torch.optim.Optimizer, where: str, waiting: int = 0) -> dict[str, Any]:
    """Check an optimiser's state `saved`. Return it with its own learning rates and with all other settings of `optimizer`.
    Either all parameters must have moments, or none. As an exception, the first `waiting` parameters may all lack moments.

    Raises:
        ConfigError: the state does not fit the parameters of `optimizer`; the text begins with `where`.
    """
    groups = optimizer.state_dict()["param_groups"]
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    rates = [group.get("lr") for group in saved["param_groups"]] if is_kind(saved.get("param_groups"), list) else []
    state = saved.get("state")
    fits = len(rates) == len(groups) and all(is_kind(rate, float) and rate > 0.0 for rate in rates)
    if not fits or not is_kind(state, {int: {str: Tensor}}) or not {*state} <= {*range(len(parameters))}:
        raise ConfigError(f"{where} is damaged")
    for i, tensors in state.items():
        for name, tensor in tensors.items():
            shape = () if name == "step" else parameters[i].shape
            if tensor.shape != shape or not bool(torch.isfinite(tensor).all()):
                raise ConfigError(f"{where} is damaged ({name} of parameter {i})")
    waiting = waiting if state.keys().isdisjoint(range(waiting)) else 0
    names = [{*state.get(i, {})} for i in range(waiting, len(parameters))]
    if any(each != names[0] for each in names):
        raise ConfigError(f"{where} is damaged (the moments of some parameters are missing)")
    return {"state": state, "param_groups": [{**group, "lr": rate} for group, rate in zip(groups, rates, strict=True)]}


def describe(task: BaseTask) -> dict[str, Any]:
    """Return the constant entries of a checkpoint's `infos`, such as task, robot, observations and networks."""
    robot = getattr(task, "robot", None)
    return {
        "format": FORMAT,
        "task": task.cfg.task,
        "observations": observation_layout(task),
        "histories": {name: group.history for name, group in task.observation_groups.items()},
        "networks": networks(task.cfg),
        "optimizer": task.cfg.train.algorithm.optimizer,
        "terms": digests(type(task), task.cfg),
        **({} if robot is None else {"robot": {"name": robot.name, "joints": list(robot.joint_names)}}),
    }


def digests(kind: type[BaseTask], cfg: TaskConfig) -> dict[str, str]:
    """Return method -> SHA-256 of its source, for the terms that `cfg` names. Sources that can't be read are left out."""
    named = {
        "_reward_": cfg.rewards.scales,
        "_terminate_": (*cfg.terminations.failures, *cfg.terminations.time_outs),
        "_obs_": [term for group in groups_in(cfg).values() for term in group.terms],
    }
    found = {}
    for method in sorted(prefix + name for prefix, names in named.items() for name in names):
        with suppress(AttributeError, OSError, TypeError):  # e.g. the class was typed into an interpreter
            source = textwrap.dedent(inspect.getsource(getattr(kind, method)))
            found[method] = hashlib.sha256(source.encode()).hexdigest()
    return found


def observation_layout(task: BaseTask) -> dict[str, dict[str, int]]:
    """Return the layout of the observations: group -> term -> width."""
    return {
        name: {term.name: term.columns.stop - term.columns.start for term in group.terms}
        for name, group in task.observation_groups.items()
    }


def networks(cfg: TaskConfig) -> dict[str, dict[str, Any]]:
    """Return network -> setting -> value for the settings of `train.policy` that decide a network's layers and outputs."""
    policy = cfg.train.policy
    recurrent = policy.rnn_type != "none"
    shared = {
        "activation": policy.activation,
        "obs_normalization": policy.obs_normalization,
        "rnn_type": policy.rnn_type,
        "rnn_hidden_dim": policy.rnn_hidden_dim if recurrent else 0,
        "rnn_num_layers": policy.rnn_num_layers if recurrent else 0,
    }
    std = {"noise_std_type": policy.noise_std_type, "state_dependent_std": policy.state_dependent_std}
    estimator = policy.estimator
    estimating: dict[str, Any] = {"estimator.hidden_dims": list(estimator.hidden_dims) if estimator.targets else []}
    if estimator.targets:
        estimating |= {"estimator.targets": list(estimator.targets), "estimator.latent": estimator.latent}
    described = {}
    for name in NETWORKS:
        own = {"hidden_dims": list(getattr(policy, f"{name}_hidden_dims")), "observations": list(groups_of(cfg, name))}
        described[name] = {**own, **shared, **({**std, **estimating} if name == "actor" else {})}
    return described


def check_fits(path: Path, saved: Saved, cfg: TaskConfig) -> None:
    """Compare a checkpoint with a configuration, before the task is built.

    Raises:
        ConfigError: the checkpoint was made for another robot, other observations, or other networks.
    """
    name, infos = relative(path), saved["infos"]
    check_joints(name, infos.get("robot", {}), cfg)
    layout, steps = infos["observations"], infos["histories"]
    for network in NETWORKS:
        for group, wanted in ((group, cfg.observations.groups[group]) for group in groups_of(cfg, network)):
            if group in layout and tuple(layout[group]) != wanted.terms:
                known = {term: width for widths in layout.values() for term, width in widths.items()}
                size = sum(known[term] for term in wanted.terms) if set(wanted.terms) <= set(known) else "others"
                raise ConfigError(
                    f"{name}: made for other observations: its group {group} has {sum(layout[group].values())} numbers"
                    f" ({', '.join(layout[group])}), but '{cfg.task}' gives {size} ({', '.join(wanted.terms)})"
                )
            if steps.get(group, wanted.history) != wanted.history:
                given = f"observations.groups.{group}.history {wanted.history}"
                raise ConfigError(f"{name}: its {network} has history {steps[group]}, the configuration has {given}")
    check_networks_fit(name, saved, cfg)


def check_joints(name: str, made_for: Mapping[str, Any], cfg: TaskConfig) -> None:
    """Compare the robot of a checkpoint (`name` and `joints` in `made_for`) with the robot of a configuration.

    Raises:
        ConfigError: the joints of the two robots differ in name or order.
    """
    joints = made_for.get("joints")
    if joints is None or not has_robot(cfg):
        return
    robot = load_robot(cfg.robot, cfg.origins.where("robot"))
    if list(robot.joint_names) != joints:
        theirs = f"'{made_for.get('name')}' with {len(joints)} joints {joints}"
        raise ConfigError(
            f"{name}: made for another robot: {theirs}; '{robot.name}' has {robot.num_dof} joints with other names or order"
        )


def check_networks_fit(name: str, saved: Saved, cfg: TaskConfig) -> None:
    """Compare the networks of a checkpoint with those of a configuration.

    Raises:
        ConfigError: a network's layers, its other settings or its observation groups differ.
    """
    for network in networks_in(saved):
        found = saved["infos"]["networks"].get(network, {})
        for key, value in networks(cfg)[network].items():
            if found.get(key) != value:
                own = key in ("hidden_dims", "observations")
                field = f"train.policy.{network}_{key}" if own else f"train.policy.{key}"
                what = {"hidden_dims": "hidden layers", "observations": "the observations"}.get(key, key)
                raise ConfigError(f"{name}: its {network} has {what} {found.get(key)}, the configuration has {field} {value}")


def check_optimizer(path: Path, saved: Saved, cfg: TaskConfig) -> None:
    """Check that the optimiser of a checkpoint is the configured one.

    Raises:
        ConfigError: the two optimisers differ.
    """
    found, wanted = saved["infos"]["optimizer"], cfg.train.algorithm.optimizer
    if found != wanted:
        where = f"the configuration has train.algorithm.optimizer {wanted}"
        raise ConfigError(f"{relative(path)}: its optimiser is {found}, {where}")


def describe_mismatch(path: Path, saved: Saved, wanted: dict[str, Any], task: str) -> str:
    """Return an error text: the first difference in shape between a checkpoint's policy and the state `wanted`."""
    found = saved["actor_state_dict"]
    text = f"{relative(path)}: made for another task than '{task}'"
    for name in dict.fromkeys([*wanted, *found]):
        here, there = (tuple(state[name].shape) if name in state else None for state in (wanted, found))
        if here != there:
            return f"{text}: its policy's {name} has the shape {there}, the task's policy has {here}"
    return f"{text}: its critic or its optimiser has other shapes"
