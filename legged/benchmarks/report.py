"""What a benchmark found, in words."""

from typing import Any

import torch

from legged.envs import BaseTask


def report(task: BaseTask, result: dict[str, Any]) -> str:
    """Say the result of a task in lines."""
    device = torch.device(task.device)
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    how = "one CUDA graph, no host synchronisation in the timed steps" if task.captured else "eager"
    lines = [
        f"{task.cfg.task}, {task.num_envs} robots, {where}, {how}",
        f"  control step  {result['control_step_ms']:.3f} ms  ({result['env_steps_per_s']:,.0f} robot steps/s)",
        *([f"  moved by {result['policy']}"] if "policy" in result else []),
        f"  physics alone {result['physics_ms']:.3f} ms  (control step = {result['ratio']:.3f} x physics)",
        *([f"  mujoco_warp.step alone {result['library_ms']:.3f} ms"] if "library_ms" in result else []),
        *([f"  mujoco-warp's own launches: {task.physics.why_library}"] if task.physics.why_library else []),
        f"  steps of a robot that lost contacts for want of memory: {result['overflows']:.0f}",
        f"  build, with kernel compilation where not cached: {result['build_s']:.1f} s",
    ]
    for loop, times in result.get("iterations", {}).items():
        beyond = times["iteration_ms"] - times["steps_per_iteration"] * result["physics_ms"]
        lines.append(
            f"  {loop} training: rollout {times['rollout_ms']:.1f} + update {times['update_ms']:.1f} ms = iteration"
            f" {times['iteration_ms']:.1f} ms, {beyond:.1f} ms beyond its physics ({times['robot_steps_per_s']:,.0f} robot"
            " steps/s)" + (f"; {times['note']}" if times["note"] else "")
        )
    if "gpu_memory_gib" in result:
        lines.append(f"  GPU memory in use: {result['gpu_memory_gib']:.1f} GiB")
    return "\n".join(lines)
