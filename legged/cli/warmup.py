"""`legged warmup`: compilation of kernels before a training."""

import argparse
import time

from legged.commandline.arguments import TASK, overrides, pick_device, register_given, settle_on
from legged.commandline.command import sub_command
from legged.config.networks import learns_from_teacher
from legged.physics import kernel_cache, resolve_physics
from legged.registry import make_task, task_config


@sub_command("legged warmup anymal_c", "legged warmup go2_flat --num-envs 8192", arguments=TASK)
def warmup(args: argparse.Namespace) -> int:
    """Compile and cache the kernels of a task: `legged warmup anymal_c`.

    The task is built as `legged train` builds it with the same arguments, and on a GPU the networks are updated once. The
    caches of Warp and Triton then hold all kernels of the task for this device, and the next training starts without
    compiling. C MuJoCo compiles no kernels.
    """
    register_given(args, "task")
    device = pick_device(args.sim_device)
    cfg = task_config(args.task, overrides(args), on_cpu=device.type == "cpu")
    if resolve_physics(cfg.sim.physics, device, num_envs=cfg.env.num_envs) == "mujoco":
        print(f"{cfg.task}: nothing to do, because C MuJoCo compiles no kernels")
        return 0
    settle_on(device)
    task = make_task(cfg, device, graph=not args.no_graph)
    if task.captured and cfg.train.runner.loop == "captured" and not learns_from_teacher(cfg):
        from legged.learning.captured import CapturedRunner  # imported late; a CPU needs no learner here

        CapturedRunner(task, None, str(device)).compile_kernels()
    print(f"{cfg.task}: ready in {time.perf_counter() - args.start_s:.1f} s; its kernels are in {kernel_cache()}")
    return 0
