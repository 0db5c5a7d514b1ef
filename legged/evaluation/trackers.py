"""Replay of trackers of this and other projects: ONNX files with inputs `obs` and `time_step` that hold their motion."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from legged.config.tracking import tracks_motions
from legged.deploy.policy import listed, open_onnx
from legged.envs.motion_tracking import MotionTracking
from legged.errors import ConfigError, suggest
from legged.evaluation.measurement import Overflows, warn_of_overflows
from legged.evaluation.motions import ENDLESS_S, measure_motion, on_the_motion
from legged.policies.foreign import DAMPING, JOINTS, STIFFNESS, Layout
from legged.policies.restore import nominal, undisturbed
from legged.registry import make_task, task_config
from legged.robots.robot import load_robot

INPUTS, ACTIONS = ("obs", "time_step"), "actions"


class Tracker:
    """A tracker on the robots of a task, in C MuJoCo."""

    def __init__(self, path: Path, layout: Layout, episodes: int) -> None:
        """Load the ONNX file at `path`, and build the task that its layout names, with the file's motion and gains and with
        `episodes` robots.

        Raises:
            ConfigError: the file can't be read, or does not fit the task.
        """
        self._path, self._session = path, open_onnx(path)
        found = [entry.name for entry in self._session.get_inputs()]
        if sorted(found) != sorted(INPUTS):
            raise ConfigError(f"{path}: a tracker has the inputs {' and '.join(INPUTS)}, this file has {', '.join(found)}")
        if ACTIONS not in [entry.name for entry in self._session.get_outputs()]:
            raise ConfigError(f"{path}: has no output '{ACTIONS}'")
        said = dict(self._session.get_modelmeta().custom_metadata_map)
        names = listed(path, said, JOINTS)
        cfg = task_config(layout.task, [("sim.physics", "mujoco")], on_cpu=True)
        if not tracks_motions(cfg):
            raise ConfigError(f"layout: task: '{layout.task}' tracks no motions")
        gains = {"stiffness": listed(path, said, STIFFNESS), "damping": listed(path, said, DAMPING)}
        changes: list[tuple[str, Any]] = [
            *undisturbed(cfg, episodes, ENDLESS_S),
            *on_the_motion(),
            ("motion.files", [str(path)]),
            ("control.action_scale", layout.action_scale),
        ]
        if (contract := layout.contract) is not None:
            motion, steps = contract.entries["motion"], round(contract.control_dt / contract.sim_dt)
            changes += [(f"motion.{key}", motion.get(key)) for key in ("anchor", "bodies", "extremities")]
            changes += [("sim.dt", contract.sim_dt), ("control.decimation", steps)]
            changes.append(("control.clip_actions", layout.action_clip))
        own = load_robot(cfg.robot).joint_names
        for name in names or ():
            if name not in own:
                raise ConfigError(f"{path}: '{cfg.robot}' has no joint '{name}'{suggest(name, own)}")
        if (names is not None and len(names) != len(set(names))) or len(names or own) != len(own):
            raise ConfigError(f"{path}: names {len(set(names or ()))} joints, but '{cfg.robot}' has {len(own)}")
        for key, values in gains.items():
            if values is None:
                continue
            if len(values) != len(own) or not all(isinstance(value, int | float) for value in values):
                raise ConfigError(f"{path}: metadata of the {key}: expected {len(own)} numbers")
            changes.append((f"control.{key}", dict(zip(names or own, values, strict=True))))
        self.task: MotionTracking = make_task(nominal(cfg, changes))
        order = torch.tensor([own.index(name) for name in names] if names is not None else range(len(own)))
        self._back = order.argsort()
        self._columns = {name: order for name in ("dof_pos", "dof_vel", "actions")}
        self._columns["reference"] = torch.cat([order, order + len(own)])
        self._terms, self._clip = layout.observation, layout.observation_clip
        self._velocity_point = torch.tensor([layout.velocity_point])
        width = self._observe().shape[1]
        asked = next(entry.shape[1] for entry in self._session.get_inputs() if entry.name == "obs")
        if isinstance(asked, int) and asked != width:
            raise ConfigError(f"{path}: takes {asked} numbers, but the layout's observation has {width}")

    def _observe(self) -> Tensor:
        """Return the observations (N, width)."""
        parts = []
        for name, scale in self._terms.items():
            values = getattr(self.task, f"_obs_{name}")()
            if name == "base_lin_vel":
                values = values + torch.linalg.cross(self.task.base_ang_vel, self._velocity_point)
            parts.append(scale * (values[:, self._columns[name]] if name in self._columns else values))
        return torch.cat(parts, dim=1).clamp(-self._clip, self._clip)

    def measure(self) -> dict[str, Any]:
        """Let the robots track the motion, from random frames and from the first one (`measure_motion`)."""
        overflows = Overflows()
        found = {"file": str(self._path), **measure_motion(self.task, self._act, overflows)}
        warn_of_overflows("trackers", overflows.total(self.task))
        return found

    def _act(self, _: Any) -> Tensor:
        """Return the network's actions (N, A) for the robots' states. Files take one observation at a time.

        Raises:
            ConfigError: the network's actions are not finite, or of another number than the joints.
        """
        frames = self.task.motion.frame.float().numpy()
        actions = []
        for observation, frame in zip(self._observe().numpy(), frames, strict=True):
            given = {"obs": observation[None], "time_step": frame.reshape(1, 1)}
            actions.append(self._session.run([ACTIONS], given)[0])
            if actions[-1].shape != (1, len(self._back)) or not np.isfinite(actions[-1]).all():
                raise ConfigError(f"{self._path}: expected {len(self._back)} finite actions, got {actions[-1].shape}")
        return torch.from_numpy(np.concatenate(actions))[:, self._back]
