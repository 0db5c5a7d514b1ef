"""GPU times of the kernels of a control step, as the graph replays them."""

from dataclasses import dataclass

import torch

from legged.envs import BaseTask


@dataclass(frozen=True)
class KernelTime:
    """Times of a kernel in one control step."""

    name: str
    launches: float
    """Mean number of launches per control step; iterations of solvers vary."""
    total_us: float
    """GPU time of all launches in a control step [us]."""


def kernel_times(task: BaseTask, steps: int) -> list[KernelTime]:
    """Return the kernels of a control step, slowest first; means over `steps` steps with small random actions."""
    actions = 0.3 * torch.randn(task.num_envs, task.num_actions, device=torch.device(task.device))
    task.step(actions)
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        for _ in range(steps):
            task.step(actions)
        torch.cuda.synchronize()
    seen = [e for e in profile.key_averages() if e.device_type == torch.autograd.DeviceType.CUDA]
    times = [KernelTime(e.key, e.count / steps, e.device_time_total / steps) for e in seen]
    return sorted(times, key=lambda time: -time.total_us)


def table(times: list[KernelTime], longest: int) -> str:
    """Return the `longest` slowest kernels and the sum of all as lines of text."""
    lines = [f"{'us':>9} {'launches':>9}  kernel"]
    lines += [f"{time.total_us:9.1f} {time.launches:9.1f}  {time.name[:90]}" for time in times[:longest]]
    launches, total = sum(time.launches for time in times), sum(time.total_us for time in times)
    return "\n".join([*lines, f"{total:9.1f} {launches:9.1f}  all {len(times)} kernels of a control step"])
