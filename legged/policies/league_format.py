"""Exports as an entry of the G1 walking league: a class in C++, and an ONNX file that contains everything else.

The class copies the league's arrays into one, and joint targets back. The network scales, sorts and clips the observation.
Last actions and histories are a state that the class passes from step to step, zeros at the start.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import onnxruntime
import torch
from torch import Tensor, nn

from legged.config import RobotConfig
from legged.deploy import other_formats
from legged.deploy.contract import Contract, Group
from legged.policies.export import CHECKED_SEQUENCE, LARGEST_DIFFERENCE, ExportError, onnx_of
from legged.process.paths import make_folder, write_bytes, write_text

MOTORS, OWNED = 29, 15
"""Number of the robot's joints, and of those that an entry moves: legs and waist, the first in the order of the motors."""
LEAGUE_DT = 0.02
"""Control step of the league [s]."""
ARRAYS = {
    "base_ang_vel": ("gyro", 3),
    "projected_gravity": ("gravity", 3),
    "commands": ("cmd", 3),
    "dof_pos": ("motor_q", MOTORS),
    "dof_vel": ("motor_dq", MOTORS),
    "held_targets": ("arm_pose", MOTORS),
    "base_lin_vel": ("base_lin_vel", 3),
}
"""Observation term -> array of the league that it is made from, and the array's width."""
JOINTS = other_formats.sdk_names(MOTORS) or ()
TEMPLATE = Path(__file__).with_name("league_policy.cpp")


class Entry(nn.Module):
    """A network with the league's arrays as observation, and targets of the OWNED joints [rad] as actions. A joint without an
    action stays at its default angle.

    The state (1, batch, S) holds a 1 after the first step, the last actions, the last observation and hidden states.
    """

    input_names, output_names = ("obs", "state_in"), ("actions", "state_out")

    def __init__(self, network: nn.Module, contract: Contract) -> None:
        """Convert `network`, observations (batch, width) and hidden states -> actions (batch, A) and hidden states."""
        super().__init__()
        self.network, self.contract = network, contract
        self.name = re.sub(r"\W", "_", contract.task, flags=re.ASCII)
        """Name of the entry: its folder, and its namespace in C++."""
        self.columns: dict[str, int] = {}
        """Array of the league that the observation is made from -> its first column."""
        self.inputs = 0
        """Number of columns of all arrays."""
        for name, (array, width) in ARRAYS.items():
            if name in {term.name for term in contract.terms}:
                self.columns[array] = self.inputs
                self.inputs += width
        hidden = (layers * width for layers, _, width in contract.states.values())
        self._parts = [1, len(contract.acted), contract.width, *hidden]
        self.state = sum(self._parts)
        """Number of columns of the state."""
        motor = np.array([JOINTS.index(name) for name in contract.joint_names])
        self._groups = [(group, *self._sources(group, motor)) for group in contract.groups]
        owned, number = np.argsort(motor)[:OWNED], {int(joint): i for i, joint in enumerate(contract.acted)}
        self._action = torch.tensor([number.get(joint, 0) for joint in owned])
        scale = np.array([contract.action_scale[number[joint]] if joint in number else 0.0 for joint in owned])
        self._scale, self._default = (torch.tensor(x, dtype=torch.float32) for x in (scale, contract.default[owned]))

    def _sources(self, group: Group, motor: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """Return column, factor and offset of each number of an observation. The last actions are behind the arrays."""
        source, factor, offset = np.zeros(group.size, int), np.zeros(group.size), np.zeros(group.size)
        for term in group.terms:
            own = np.arange(term.start, term.start + term.size) - group.start
            array, width = ARRAYS.get(term.name, ("", 0))
            place, factor[own] = np.arange(term.size), term.scale
            if width == MOTORS:
                every = np.arange(MOTORS) if term.joints is None else term.joints
                joints = np.setdiff1d(every, self.contract.acted) if term.name == "held_targets" else every
                place = motor[joints]
                if term.name == "held_targets":  # held joints of legs and waist stay at their default angles
                    factor[own] *= place >= OWNED
                if term.name != "dof_vel":
                    offset[own] = -factor[own] * self.contract.default[joints]
            source[own] = self.columns.get(array, self.inputs) + place
        return torch.tensor(source), torch.tensor(factor, dtype=torch.float32), torch.tensor(offset, dtype=torch.float32)

    def forward(self, obs: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the joint targets (batch, OWNED) and the next state for the league's arrays side by side (batch, inputs)."""
        clip, limit = self.contract.action_clip, self.contract.observation_clip
        later, last, past, *hidden = state[0].split(self._parts, dim=1)
        values, rows = torch.cat([obs, last], dim=1), []
        for group, source, factor, offset in self._groups:
            frame = (values[:, source] * factor + offset).clip(-limit, limit)
            older = past[:, group.start + group.size : group.start + group.size * group.history]
            rows.append(torch.where(later > 0.5, torch.cat([older, frame], dim=1), torch.cat([frame] * group.history, dim=1)))
        seen, shapes = torch.cat(rows, dim=1), self.contract.states.values()
        memory = [x.reshape(-1, layers, width).transpose(0, 1) for x, (layers, _, width) in zip(hidden, shapes, strict=True)]
        given = self.network(seen, *memory)
        actions, *memory = given if memory else (given,)
        actions = actions.clip(-clip, clip)
        kept = [later.clip(min=1.0), actions, seen, *(x.transpose(0, 1).flatten(1) for x in memory if x is not None)]
        return self._default + self._scale * actions[:, self._action], torch.cat(kept, dim=1).unsqueeze(0)

    def as_onnx(self, verbose: bool = False) -> "Entry":
        """Return the network itself, as networks of rsl-rl return a copy for ONNX files."""
        return self

    def get_dummy_inputs(self) -> tuple[Tensor, Tensor]:
        """Return an observation and a state of zeros."""
        return torch.zeros(1, self.inputs), torch.zeros(1, 1, self.state)


def check_entry(cfg: RobotConfig, described: Mapping[str, Any]) -> None:
    """Check that the league has a described policy's robot, control step and observations.

    Raises:
        ConfigError: it has not; the error names the setting.
    """
    wrong, known = cfg.origins.error, (*ARRAYS, "actions")
    if set(described["joint_names"]) != set(JOINTS):
        raise wrong("robot", f"--format league is for a g1 with {MOTORS} joints, got '{cfg.robot}'")
    if not np.isclose(dt := described["control_dt"], LEAGUE_DT):
        raise wrong("control.decimation", f"--format league has control steps of {LEAGUE_DT} s, got {dt:g} s")
    for term in described["observation"]:
        if term["name"] not in known:
            text = f"--format league cannot express '{term['name']}' of {term['size']} numbers (known: {', '.join(known)})"
            raise wrong(f"observations.groups.{term['group']}", text)


def write_entry(policy: Any, contract: Contract, folder: Path, run: str) -> float:
    """Write model.onnx and policy.cpp of `policy`, rsl-rl's actor network on the CPU, to policies/<task>/ in `folder`. Return
    the largest difference of the file's targets from the policy's. `run` is the path of the run.

    Raises:
        ExportError: the file gives other targets than the policy.
        RunError: a file cannot be written.
    """
    entry = Entry(policy.as_onnx(verbose=False).eval(), contract)
    content = onnx_of(entry, {"run_path": run or "none"})
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    steps, robots = CHECKED_SEQUENCE
    state, difference = torch.zeros(1, robots, entry.state), 0.0
    for values in torch.randn(steps, robots, entry.inputs):
        (given, _) = session.run(None, {"obs": values.numpy(), "state_in": state.numpy()})
        targets, state = entry(values, state)
        difference = max(difference, float(np.abs(given - targets.numpy()).max() / max(1.0, float(targets.abs().max()))))
    if not difference <= LARGEST_DIFFERENCE:
        raise ExportError(f"model.onnx: differs from the policy by {difference:.1e} (allowed: {LARGEST_DIFFERENCE})")
    into = folder / "policies" / entry.name
    make_folder(into)
    write_bytes(into / "model.onnx", content)
    write_text(into / "policy.cpp", policy_cpp(entry))
    return difference


def policy_cpp(entry: Entry) -> str:
    """Return the file policy.cpp of an entry."""
    contract, widths = entry.contract, dict(ARRAYS.values())
    low, high = contract.command_ranges.T
    by_motor = [contract.joint_names.index(joint) for joint in JOINTS]
    numbers = {
        "kp": contract.stiffness[by_motor],
        "kd": contract.damping[by_motor],
        "limits": np.array([low[0], high[0], *np.minimum(-low, high).clip(0.0)[1:]]),
    }
    values: dict[str, Any] = {key: ", ".join(str(np.float32(x)) for x in row) for key, row in numbers.items()}
    pastes = (
        f"paste<<<blocks, THREADS>>>(c.{array}, {widths[array]}, inputs_, INPUTS, {column}, robots_);"
        for array, column in entry.columns.items()
    )
    values |= {"name": entry.name, "inputs": entry.inputs, "state": entry.state, "owned": OWNED}
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(values, pastes="\n    ".join(pastes))
