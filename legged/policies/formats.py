"""Exports in the formats of other programs: ONNX files with mjlab's metadata, Unitree's deploy.yaml, entries of a league.

The first two have unscaled observations, with the history of each term by itself, oldest first. The network in the ONNX file
begins with their conversion: columns are sorted, scaled and clipped. It also corrects what numbers of 3 decimals lose.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
import yaml
from torch import Tensor, nn

from legged.config import follows_velocities
from legged.config.tracking import tracks_motions
from legged.deploy.contract import Contract, contract_of
from legged.deploy.other_formats import DEPLOY, JOINT_TERMS, MJLAB_TERMS, RANGES, UNITREE_TERMS, sdk_names
from legged.deploy.unitree import KINDS
from legged.envs import BaseTask
from legged.policies.description import describe
from legged.policies.export import CHECKED_OBSERVATIONS, LARGEST_DIFFERENCE, ExportError, onnx_of
from legged.policies.league_format import check_entry, write_entry
from legged.process.paths import make_folder, write_bytes, write_text

FORMATS = ("legged", "mjlab", "unitree", "league")
DECIMALS = 3
"""Decimals of default angles, scales, gains and command ranges."""


class Converted(nn.Module):
    """A network with the observations and actions of another format. The format knows the A joints that have an action."""

    input_names, output_names = ("obs",), ("actions",)

    def __init__(self, network: nn.Module, contract: Contract, order: np.ndarray) -> None:
        """Convert `network`, observations (batch, width) -> actions (batch, A). `order` (A,) sorts our actions as theirs."""
        super().__init__()
        self.network, self.contract = network, contract
        self.joints = contract.acted[order]
        """(A,) index of each joint of the format among ours. Default angles and scales of actions [rad] have this order."""
        default, scale = contract.default[contract.acted], contract.action_scale
        near, rounded = default.round(DECIMALS), np.maximum(scale.round(DECIMALS), 10.0**-DECIMALS)
        self.default, self.scale = near[order], rounded[order]
        ratio, lost = scale / rounded, default - near
        columns = []
        factor, offset = np.ones(contract.width), np.zeros(contract.width)
        for group in contract.groups:
            for term in group.terms:
                for start in range(term.start, term.start + group.size * group.history, group.size):
                    own = np.arange(start, start + term.size)
                    columns.append(own[order] if term.name in JOINT_TERMS else own)
                    factor[own] = term.scale / ratio if term.name == "actions" else term.scale
                    if term.name in ("dof_pos", "actions"):
                        offset[own] = -term.scale * (lost if term.name == "dof_pos" else lost / scale)
        self._source, self._order = torch.tensor(np.argsort(np.concatenate(columns))), torch.tensor(order)
        self._factor, self._offset, self._ratio, self._shift = (
            torch.tensor(values, dtype=torch.float32) for values in (factor, offset, ratio, lost / rounded)
        )

    def forward(self, obs: Tensor) -> Tensor:
        """Return the actions (batch, A) for the format's observations (batch, width)."""
        clip, limit = self.contract.action_clip, self.contract.observation_clip
        seen = (obs[:, self._source] * self._factor + self._offset).clip(-limit, limit)
        actions: Tensor = self.network(seen).clip(-clip, clip)
        return (actions * self._ratio + self._shift)[:, self._order]

    def as_onnx(self, verbose: bool = False) -> "Converted":
        """Return the network itself, as networks of rsl-rl return a copy for ONNX files."""
        return self

    def get_dummy_inputs(self) -> tuple[Tensor]:
        """Return an observation of zeros."""
        return (torch.zeros(1, self.contract.width),)


@torch.inference_mode()
def export_as(task: BaseTask, policy: Any, folder: Path, form: str, run: str = "") -> float:
    """Write `policy`, rsl-rl's actor network on the CPU, to `folder` as policy.onnx, and for `form` "unitree" also as
    deploy.yaml. For `form` "league", write policies/<task>/ there instead. Return the largest difference of the file's
    actions from the policy's. `run` is the path of the run.

    Raises:
        ConfigError: the format cannot express the policy.
        ExportError: the file gives other actions than the policy.
        RunError: a file cannot be written.
    """
    contract = _expressible(task, form)
    if form == "league":
        return write_entry(policy, contract, folder, run)
    names = [contract.joint_names[i] for i in contract.acted]
    motors = sdk_names(len(contract.joint_names)) if form == "unitree" else None
    order = sorted(range(len(names)), key=lambda i: (motors or names).index(names[i]))
    network = Converted(policy.as_onnx(verbose=False).eval(), contract, np.array(order))
    content = onnx_of(network, mjlab_metadata(network, run), free=False)
    seen = torch.randn(CHECKED_OBSERVATIONS, contract.width)
    wanted = network(seen).numpy()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    given = np.concatenate([session.run(None, {"obs": row[None]})[0] for row in seen.numpy()])
    difference = float(np.abs(given - wanted).max() / max(1.0, np.abs(wanted).max()))
    if not difference <= LARGEST_DIFFERENCE:
        raise ExportError(f"policy.onnx: differs from the policy by {difference:.1e} (allowed: {LARGEST_DIFFERENCE})")
    make_folder(folder)
    write_bytes(folder / "policy.onnx", content)
    if form == "unitree":
        write_text(folder / DEPLOY, yaml.safe_dump(deploy_yaml(network), default_flow_style=None, sort_keys=False))
    return difference


def _expressible(task: BaseTask, form: str) -> Contract:
    """Return the contract of a task's policy.

    Raises:
        ConfigError: the format cannot express the policy; the error names the setting.
    """
    cfg, wrong = task.cfg, task.cfg.origins.error
    if not follows_velocities(cfg):
        hint = "; trackers policy_<motion>.onnx of `--format legged` have mjlab's metadata" if tracks_motions(cfg) else ""
        raise wrong("task", f"--format {form} is for policies that follow velocity commands, got '{cfg.task}'{hint}")
    if cfg.control.laws != {"P"}:
        raise wrong("control.control_type", f"--format {form} knows joint position targets only (P)")
    if form != "league" and cfg.train.policy.rnn_type != "none":
        raise wrong("train.policy.rnn_type", f"--format {form} has no hidden state, got '{cfg.train.policy.rnn_type}'")
    described = describe(task)
    if form == "league":
        check_entry(cfg, described)
        return contract_of(Path(cfg.task), described)
    joints, acted, seen = (
        described["joint_names"],
        described["action_joints"],
        [term["name"] for term in described["observation"]],
    )
    if form == "unitree" and set(joints) != set(sdk_names(len(joints)) or ()):
        raise wrong(
            "robot", f"--format unitree numbers the motors of Unitree's robots ({', '.join(KINDS)}), got '{cfg.robot}'"
        )
    known = MJLAB_TERMS if form == "mjlab" else UNITREE_TERMS
    for term in described["observation"]:
        name, size, of_joints = term["name"], term["size"], term["name"] in JOINT_TERMS
        if of_joints and (size != len(acted) or term.get("joints", acted) != acted):
            shown = (
                f"--format {form} knows only joints with an action, but '{name}' has {size} numbers for {len(acted)} actions"
            )
            raise wrong("control.held", shown)
        if name not in known.values() or size != (len(acted) if of_joints else 3) or seen.count(name) > 1:
            text = f"--format {form} cannot express '{name}' of {size} numbers (once each: {', '.join(known.values())})"
            raise wrong(f"observations.groups.{term['group']}", text)
    return contract_of(Path(cfg.task), described)


def mjlab_metadata(network: Converted, run: str) -> dict[str, str]:
    """Return mjlab's metadata as text. Besides, `fps` is the number of control steps per second, and `command_ranges` are the
    limits of vx, vy [m/s] and yaw rate [rad/s].
    """
    contract, joints = network.contract, network.joints
    theirs = {ours: name for name, ours in MJLAB_TERMS.items()}
    rows = [(theirs[term.name], group.history) for group in contract.groups for term in group.terms]
    return {
        "run_path": run or "none",
        "joint_names": ",".join(contract.joint_names[i] for i in joints),
        "joint_stiffness": _listing(contract.stiffness[joints]),
        "joint_damping": _listing(contract.damping[joints]),
        "default_joint_pos": _listing(network.default),
        "action_scale": _listing(network.scale),
        "command_names": "twist",
        "observation_names": ",".join(name for name, _ in rows),
        "observation_terms_scale": _listing([1.0] * len(rows)),
        "observation_terms_clip": ",".join(["-inf;inf"] * len(rows)),
        "observation_terms_history_length": _listing([steps if steps > 1 else 0.0 for _, steps in rows]),
        "observation_terms_flatten_history_dim": _listing([1.0] * len(rows)),
        "fps": f"{1.0 / contract.control_dt:g}",
        "command_ranges": ",".join(_listing(pair, ";") for pair in contract.command_ranges),
    }


def deploy_yaml(network: Converted) -> dict[str, Any]:
    """Return the contents of deploy.yaml. Joints are in the order of the motors."""
    contract, joints = network.contract, network.joints
    theirs = {ours: name for name, ours in UNITREE_TERMS.items()}
    motors = sdk_names(len(contract.joint_names)) or ()
    in_motor_order = [contract.joint_names.index(name) for name in motors]
    default = network.default.tolist()
    ranges = dict(zip(RANGES.values(), contract.command_ranges.round(DECIMALS).tolist(), strict=True))
    action = {"clip": None, "joint_names": [".*"], "scale": network.scale.tolist(), "offset": list(default)}
    return {
        "joint_ids_map": [motors.index(contract.joint_names[i]) for i in joints],
        "step_dt": contract.control_dt,
        "stiffness": contract.stiffness[in_motor_order].round(DECIMALS).tolist(),
        "damping": contract.damping[in_motor_order].round(DECIMALS).tolist(),
        "default_joint_pos": default,
        "commands": {"base_velocity": {"ranges": {**ranges, "heading": None}}},
        "actions": {"JointPositionAction": {**action, "joint_ids": None}},
        "observations": {
            theirs[term.name]: {
                "params": {"command_name": "base_velocity"} if term.name == "commands" else {},
                "clip": None,
                "scale": [1.0] * term.size,
                "history_length": group.history,
            }
            for group in contract.groups
            for term in group.terms
        },
    }


def _listing(values: Iterable[float], comma: str = ",") -> str:
    return comma.join(f"{value:.{DECIMALS}f}" for value in values)
