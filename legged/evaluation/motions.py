"""Evaluation of policies that track motions: success and errors of each motion, with intervals."""

import time
from collections.abc import Iterable
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from legged.envs.motion_tracking import ERRORS, MotionTracking
from legged.errors import ConfigError
from legged.evaluation.intervals import wilson
from legged.evaluation.measurement import Overflows, Setting, warn_of_overflows
from legged.evaluation.result_file import write_result
from legged.motion.readers import motion_files
from legged.policies.episodes import Policy
from legged.policies.restore import restore, undisturbed
from legged.process.paths import relative
from legged.tables import screen_table

SUCCESS_S = 10.0
"""An episode succeeds if no failure ends it within this time [s]. At the end of its motion, a robot begins anew."""


ENDLESS_S = 1e4
"""Length of episodes that no motion reaches, so that only failures and the ends of motions end them [s]."""


def motions_name(physics: str) -> str:
    """Return the name of the file with the result in an engine."""
    return f"motions_{physics}.json"


def evaluate_motions(setting: Setting, episodes: int) -> int:
    """Measure each motion of a task: `episodes` robots begin in frames drawn uniformly, then in the first frame.
    Nothing is random besides these frames. Print a table, write motions_<physics>.json, and return the exit code.

    Raises:
        ConfigError: a motion can't be read, or two have one name.
        RunError: the file can't be written.
    """
    start, cfg = time.perf_counter(), setting.cfg
    head = {**setting.head, **setting.changes}
    measured, lost = {}, 0
    where = cfg.origins.where("motion.files")
    files = motion_files(cfg.motion.files, where)
    for name in {file.stem for file in files}:
        if sum(file.stem == name for file in files) > 1:
            raise ConfigError(f"{where}: two motions are named '{name}'; evaluate them one after the other")
    for file in files:
        changes = [
            *undisturbed(setting.policy.cfg, episodes, ENDLESS_S),
            *on_the_motion(),
            *setting.asked,
            ("motion.files", [str(file)]),
        ]
        task, act = restore(setting.policy, changes, setting.device, setting.graph)
        overflows = Overflows()
        measured[file.stem] = measure_motion(task, act, overflows)
        lost += overflows.total(task)
    result = {**head, "wall_s": time.perf_counter() - start, "success_s": SUCCESS_S, "motions": measured}
    title = (
        f"{result['task']} ({result['checkpoint']}) in {result['physics']}: {episodes} episodes of {SUCCESS_S:g} s a motion"
    )
    Console(width=140).print(motions_table(title, measured.items()))
    path = setting.folder / motions_name(result["physics"])
    write_result(path, result)
    print(f"written: {relative(path)}")
    warn_of_overflows("motions", lost)
    return 0


def on_the_motion() -> list[tuple[str, Any]]:
    """Return overrides with which episodes begin exactly on the motion, in frames that are all equally likely."""
    nowhere = [(f"motion.{name}_noise", [0.0] * 6) for name in ("pose", "velocity")]
    return [("motion.memory", 0.0), *nowhere, ("motion.joint_noise", [0.0, 0.0])]


def measure_motion(task: MotionTracking, act: Policy, overflows: Overflows) -> dict[str, Any]:
    """Return success and mean errors of robots that begin in random frames, and whether one tracks the whole motion."""
    return {**_from_anywhere(task, act, overflows), "whole": _from_the_beginning(task, act)}


@torch.inference_mode()
def _from_anywhere(task: MotionTracking, act: Policy, overflows: Overflows) -> dict[str, Any]:
    """Return success and mean errors of robots that begin in random frames, success by the second of the beginning, and mean
    errors by the second of the motion.
    """
    task.reset_curricula()
    observations = task.reset()
    begun = task.motion.drawn.clone()
    running = torch.ones_like(task.reset_buf)
    errors, steps = torch.zeros_like(task.errors), torch.zeros_like(task.rew_buf)
    sums = torch.zeros(len(task.motion.table.rows), len(ERRORS) + 1, device=task.device)  # of errors, and of steps, by frame
    for _ in range(round(SUCCESS_S / task.dt)):
        frame = task.motion.frame.clone()
        observations, _, _, extras = task.step(act(observations))
        overflows.add(extras)
        seen = running & task.valid
        now = torch.where(seen.unsqueeze(1), task.errors, 0.0)
        sums.index_add_(0, frame, torch.cat([now, seen.unsqueeze(1)], dim=1))
        errors += now
        steps += seen
        running &= ~task.terminated_buf
    count, successes = task.num_envs, int(running.sum())
    low, high = wilson(successes, count)
    means = (errors / steps.clamp(min=1.0).unsqueeze(1)).mean(dim=0).tolist()
    seconds = (begun * task.dt).long()
    return {
        "seconds": (len(task.motion.table.rows) - 1) * task.dt,
        "episodes": count,
        "successes": successes,
        "share": successes / count,
        "low": low,
        "high": high,
        **dict(zip(ERRORS, means, strict=True)),
        "by_second": [
            {"second": second, "episodes": int(there.sum()), "successes": int((there & running).sum())}
            for second in range(int(seconds.max()) + 1)
            if (there := seconds == second).any()
        ],
        "errors_by_second": [
            dict(zip(("second", *ERRORS), (second, *(total[:-1] / total[-1]).tolist()), strict=True))
            for second, part in enumerate(sums.split(round(1.0 / task.dt)))
            if (total := part.sum(dim=0))[-1] > 0.0
        ],
    }


@torch.inference_mode()
def _from_the_beginning(task: MotionTracking, act: Policy) -> dict[str, Any]:
    """Return whether a robot that begins in the first frame reaches the last one, and how long it lasts [s]."""
    observations, last = task.start_at(torch.zeros_like(task.motion.frame)), len(task.motion.table.rows) - 1
    for step in range(1, last + 1):
        observations, *_ = task.step(act(observations))
        if bool(task.terminated_buf[0]):
            return {"success": False, "lasted_s": step * task.dt}
    return {"success": True, "lasted_s": last * task.dt}


def motions_table(title: str, measured: Iterable[tuple[str, dict[str, Any]]]) -> Table:
    """Return a table of the results of `measure_motion`, each with the name of its motion or file."""
    heads = ("motion", "length [s]", "success [%] (95 % interval)", "whole motion", "body error [m]", "in the world [m]")
    rows = []
    for name, found in measured:
        whole = found["whole"]
        share, low, high = (100.0 * found[key] for key in ("share", "low", "high"))
        errors = (f"{found[key]:.3f}" for key in ("body_error", "world_error", "joint_error"))
        worst = max(found["errors_by_second"], key=lambda part: part["largest_error"])
        lasted = "tracked" if whole["success"] else f"falls at {whole['lasted_s']:.1f} s"
        rows.append([name, f"{found['seconds']:.1f}", f"{share:.1f} ({low:.1f} to {high:.1f})", lasted, *errors])
        rows[-1].append(f"{worst['largest_error']:.3f} at {worst['second']} s")
    return screen_table(title, [*heads, "joints [rad]", "largest, worst second [m]"], rows)
