"""Trains a task of mjlab as its authors set it up, and writes the layout that `legged evaluate onnx` judges it by.

    python docs/peers/train_mjlab.py Mjlab-Velocity-Flat-Unitree-Go1 --out peers/mjlab_go1 --iterations 500 --every 25
    python docs/peers/train_mjlab.py Mjlab-Tracking-Flat-Unitree-G1 --motion walk.npz --out peers/mjlab_walk --seconds 600

Runs in an environment with mjlab 1.6, not with this package. Writes into --out: an ONNX file every so many iterations, whose
metadata have `wall_s`, the seconds since this process began less those spent on such files, and `iterations`; layout.yaml,
how the policy sees and drives the robot; robot.xml, its model with actuators; and training.json with steps per second. The
ONNX files of a tracking task hold the motion; for them, the layout is `mjlab_tracker` of this package.
`--resume` goes on from the newest checkpoint in --out, with its `wall_s`: building the task a second time is not counted.
"""

import time

STARTED_S = time.perf_counter()

import argparse  # noqa: E402  imports are part of what a training takes
import json  # noqa: E402
import os  # noqa: E402
from contextlib import suppress  # noqa: E402
from dataclasses import asdict  # noqa: E402
from importlib.metadata import version  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

os.environ.setdefault("WANDB_MODE", "disabled")
os.environ["MUJOCO_GL"] = "disable"  # nothing is rendered, and stand-ins can't render

from stand_ins import stand_in  # noqa: E402

STOOD_IN = stand_in()

import mjlab.tasks  # noqa: E402, F401  fills the registry
import mujoco  # noqa: E402
import onnx  # noqa: E402
import torch  # noqa: E402
import yaml  # noqa: E402
from mjlab.entity import Entity  # noqa: E402
from mjlab.envs import ManagerBasedRlEnv  # noqa: E402
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper  # noqa: E402
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls  # noqa: E402
from mjlab.utils.torch import configure_torch_backends  # noqa: E402

TERMS = {
    "base_lin_vel": ["base_lin_vel"],
    "base_ang_vel": ["base_ang_vel"],
    "projected_gravity": ["projected_gravity"],
    "joint_pos": ["dof_pos"],
    "joint_vel": ["dof_vel"],
    "actions": ["actions"],
    "command": ["command_xy", "command_yaw"],
}
"""mjlab's name of a term of the observation -> those of a layout, column by column."""
UNLIMITED = 1e6
"""Largest action where mjlab clips none."""


class TimeIsUp(Exception):
    """The training has had its time."""


class Timed(MjlabOnPolicyRunner):
    """Part of a runner of mjlab; each checkpoint is an ONNX file too, that says when it was written."""

    folder: Path
    seconds: float
    began_s = STARTED_S
    """The time from which `wall_s` is counted [s]."""
    exporting_s = 0.0
    """Time spent on ONNX files so far [s]."""
    written: list[dict[str, Any]]

    def save(self, path: str, infos: Any = None) -> None:
        """Write a checkpoint, then its ONNX file.

        Raises:
            TimeIsUp: the training has had its time.
        """
        if self.device != "cpu":
            torch.cuda.synchronize()
        before = time.perf_counter()
        wall_s = before - self.began_s - self.exporting_s
        written = self.folder / f"{self.folder.name}.onnx"  # by runners of tracking tasks, with its metadata
        written.unlink(missing_ok=True)  # if the runner can't write it, it only warns
        super().save(path, infos)
        done = self.current_learning_iteration + 1
        name = f"policy_{done:05d}.onnx"
        if not written.is_file():
            self.export_policy_to_onnx(str(self.folder), name)
            written = self.folder / name
        model = onnx.load(written)
        for key, value in {"wall_s": repr(wall_s), "iterations": str(done)}.items():
            model.metadata_props.add(key=key, value=value)
        onnx.save(model, self.folder / name)
        if not self.written or self.written[-1]["iterations"] != done:  # the last one is written twice
            self.written.append({"file": name, "iterations": done, "wall_s": wall_s})
            print(f"iteration {done}: {wall_s:.1f} s", flush=True)
        self.exporting_s += time.perf_counter() - before
        if wall_s >= self.seconds:
            raise TimeIsUp

    def resume(self) -> None:
        """Go on from the newest checkpoint that has an ONNX file, at its iteration and its time."""
        for path in sorted(self.folder.glob("policy_*.onnx")):
            noted = {entry.key: entry.value for entry in onnx.load(path).metadata_props}
            done, wall_s = int(noted["iterations"]), float(noted["wall_s"])
            self.written.append({"file": path.name, "iterations": done, "wall_s": wall_s})
        if not self.written:
            raise SystemExit(f"--resume: there is no policy_*.onnx in {self.folder}")
        newest = self.written[-1]
        self.load(str(self.folder / f"model_{newest['iterations'] - 1}.pt"))
        self.current_learning_iteration = newest["iterations"]  # rsl-rl would do the last one again
        self.began_s = time.perf_counter() - newest["wall_s"]


def main() -> None:
    """Train, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--motion", type=Path, help="npz file in mjlab's format; for a tracking task")
    parser.add_argument("--iterations", type=int, help="mjlab's own number by default")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end at the first checkpoint after this time")
    parser.add_argument("--resume", action="store_true", help="go on from the newest checkpoint in --out")
    parser.add_argument("--every", type=int, default=25, help="iterations from ONNX file to ONNX file")
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--device", default="cuda:0" if torch.cuda.is_available() else "cpu")
    args = parser.parse_args()
    args.out = args.out.resolve()
    args.out.mkdir(parents=True, exist_ok=True)
    configure_torch_backends()
    cfg, learning = load_env_cfg(args.task), load_rl_cfg(args.task)
    cfg.scene.num_envs = args.num_envs
    cfg.seed = learning.seed = args.seed
    learning.logger, learning.upload_model, learning.save_interval = "tensorboard", False, args.every
    if args.motion is not None:
        cfg.commands["motion"].motion_file = str(args.motion)
    write_model(Entity(cfg.scene.entities["robot"]).spec, args.out / "robot.xml")
    task = ManagerBasedRlEnv(cfg=cfg, device=args.device)
    if args.motion is None:
        layout = layout_of(task, cfg, learning.clip_actions)
        (args.out / "layout.yaml").write_text(yaml.safe_dump(layout, sort_keys=False))
    env = RslRlVecEnvWrapper(task, clip_actions=learning.clip_actions)
    own = load_runner_cls(args.task) or MjlabOnPolicyRunner
    runner = type("TimedRunner", (Timed, own), {})(env, asdict(learning), str(args.out), args.device)
    runner.folder, runner.seconds, runner.written = args.out, args.seconds, []
    if args.resume:
        runner.resume()
    with suppress(TimeIsUp):
        runner.learn(args.iterations or learning.max_iterations, init_at_random_ep_len=True)
    result = {
        "task": args.task,
        "num_envs": args.num_envs,
        "device": torch.cuda.get_device_name() if args.device.startswith("cuda") else "cpu",
        "versions": {name: version(name) for name in ("mjlab", "mujoco", "mujoco-warp", "warp-lang", "rsl-rl-lib", "torch")},
        "stood_in_for": STOOD_IN,
        "steps_per_s": speed(runner.written, args.num_envs * learning.num_steps_per_env),
        "checkpoints": runner.written,
    }
    (args.out / "training.json").write_text(json.dumps(result, indent=1))
    print(f"training steps/s: {result['steps_per_s']}")


def speed(written: list[dict[str, Any]], steps: int) -> float | None:
    """Return training steps per second from the first to the last checkpoint, each iteration having so many `steps`; None if
    there is one only. The first comes after one iteration, so building and warming up are not in it.
    """
    first, last = written[0], written[-1]
    if first is last:
        return None
    return round(steps * (last["iterations"] - first["iterations"]) / (last["wall_s"] - first["wall_s"]), 1)


def write_model(spec: mujoco.MjSpec, path: Path) -> None:
    """Write a robot's model without what is only seen; its mass must stay what it was."""
    mass = float(sum(spec.compile().body_mass))
    for geom in list(spec.geoms):
        if geom.contype == 0 and geom.conaffinity == 0 and geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            spec.delete(geom)
    meshes = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if mesh.name not in meshes:
            spec.delete(mesh)
    left = float(sum(spec.compile().body_mass))
    assert abs(left - mass) < 1e-6 * mass, f"{path}: {left} kg without its visuals, {mass} kg with them"
    path.write_text(spec.to_xml())


def layout_of(task: ManagerBasedRlEnv, cfg: Any, clip_actions: float | None) -> dict[str, Any]:
    """Return the layout of the policy, from mjlab's own configuration and model."""
    robot, model = task.scene["robot"], task.sim.mj_model
    terms = task.observation_manager.active_terms["actor"]
    observation = {}
    for name in terms:
        term = task.observation_manager.get_term_cfg("actor", name)
        assert term.history_length == 0, f"{name}: has a history"
        assert term.clip is None, f"{name}: is clipped"
        scale = 1.0 if term.scale is None else float(term.scale)
        observation |= {part: scale for part in TERMS[name]}
    action = task.action_manager.get_term("joint_pos")
    acted = list(action.target_names)
    scales = action.scale[0].tolist() if isinstance(action.scale, torch.Tensor) else [action.scale] * len(acted)
    names = list(robot.joint_names)
    motors = {model.actuator(i).name.split("/")[-1]: i for i in range(model.nu)}
    joints = {model.joint(model.actuator_trnid[i, 0]).name.split("/")[-1]: i for i in motors.values()}
    point = model.site(model.sensor("robot/imu_lin_vel").objid[0])
    assert abs(point.quat[0]) > 1.0 - 1e-9, "the IMU is turned"
    assert model.body(point.bodyid[0]).name.split("/")[-1] == robot.body_names[0], "the IMU is not at the base"
    return {
        "observation": observation,
        "velocity_point": point.pos.tolist(),
        "joints": names,
        "action_joints": acted,
        "action_scale": dict(zip(acted, scales, strict=True)),
        "action_clip": UNLIMITED if clip_actions is None else float(clip_actions),
        "default_joint_angles": dict(zip(names, robot.data.default_joint_pos[0].tolist(), strict=True)),
        "stiffness": {name: float(model.actuator_gainprm[i, 0]) for name, i in joints.items()},
        "damping": {name: float(-model.actuator_biasprm[i, 2]) for name, i in joints.items()},
        "torque_limits": {name: float(model.actuator_forcerange[i, 1]) for name, i in joints.items()},
        "implicit_gains": cfg.sim.mujoco.integrator == "implicitfast",
        "control_dt": float(task.step_dt),
        "sim_dt": float(task.physics_dt),
    }


if __name__ == "__main__":
    main()
