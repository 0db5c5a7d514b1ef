"""How long a training takes to a robot that walks: `python -m legged.tools.time_to_walk --task anymal_c_flat`.

Evaluates the checkpoints of a run on the grid of legged.tools.evaluate, in the order they were written, and says when the
first one walked: mean velocity RMSE below --rmse and falls below --falls. Seconds are wall time since the start of the
process that wrote the checkpoint, imports and all; train with a small train.runner.save_interval for a fine answer. Writes
time_to_walk.json into the run folder.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from legged.commandline.arguments import (
    add_run_arguments,
    add_task_arguments,
    import_and_check,
    pick_device,
    policy_overrides,
    settle_on,
)
from legged.commandline.command import run_main
from legged.errors import ConfigError
from legged.evaluation.tracking import ready_to_track, tell
from legged.evaluation.velocity_grid import Grid, measure
from legged.learning.checkpoint import read_checkpoint
from legged.learning.run_folder import checkpoints
from legged.physics import engine_name
from legged.policies.restore import find_policy
from legged.process.paths import make_folder, ready_to_write, relative, write_text

AXIS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Commands of the grid, in m/s and rad/s."""

MOST_A_CELL = 8192
"""Robots; on the grid of 125 cells a million."""


def main(argv: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    parser = argparse.ArgumentParser(prog="time_to_walk", description=__doc__)
    add_task_arguments(parser)
    add_run_arguments(parser)
    parser.add_argument("--robots", type=int, default=16, help="robots a cell")
    parser.add_argument("--rmse", type=float, default=0.15, help="a robot that walks has a smaller velocity RMSE [m/s]")
    parser.add_argument("--falls", type=float, default=0.01, help="and a smaller share of falls")
    args = parser.parse_intermixed_args(argv)
    import_and_check(args)
    for flag, value, most in (
        ("--robots", args.robots, MOST_A_CELL),
        ("--rmse", args.rmse, 100.0),
        ("--falls", args.falls, 1.0),
    ):
        if not value > 0:
            raise ConfigError(f"{flag}: must be above 0, got {value}")
        if value > most:
            raise ConfigError(f"{flag}: must be at most {most:,}, got {value}")
    if args.num_envs is not None:
        raise ConfigError("--num_envs: the grid says how many robots there are; --robots sets those of a cell")
    device = pick_device(args.sim_device)
    settle_on(device)
    policy = find_policy(args)
    folder = policy.output("evaluate")
    ready_to_write(folder)
    there = {path: _written_at(path) for path in checkpoints(policy.folder).values()}  # all of them, before minutes of work
    grid = Grid(AXIS, AXIS, AXIS, args.robots)
    asked = [("sim.physics", "auto"), *policy_overrides(args)]
    task, runner = ready_to_track(policy, grid, asked, device, graph=not args.no_graph)
    act = runner.get_inference_policy(str(device))
    rows: list[dict[str, Any]] = []
    tell(f"{'iteration':>9} {'seconds':>8} {'velocity RMSE [m/s]':>20} {'yaw rate RMSE [rad/s]':>22} {'falls [%]':>10}")
    for path, seconds in there.items():
        runner.load(str(path))
        figures = measure(task, act, grid)
        row = {
            "iteration": runner.current_learning_iteration,
            "wall_s": seconds,
            "rmse_lin": figures["rmse_lin"]["mean"],
            "rmse_ang": figures["rmse_ang"]["mean"],
            "falls": figures["falls"],
        }
        rows.append(row)
        errors = [float("nan") if row[name] is None else row[name] for name in ("rmse_lin", "rmse_ang")]
        tell(f"{row['iteration']:9} {seconds:8.1f} {errors[0]:20.3f} {errors[1]:22.3f} {100 * row['falls']:10.2f}")
    first = next((row for row in rows if walks(row, args.rmse, args.falls)), None)
    limits = f"velocity RMSE < {args.rmse:g} m/s, falls < {100 * args.falls:g} %"
    tell(f"{limits}: " + (f"after {first['wall_s']:.1f} s, {first['iteration']} iterations" if first else "never"))
    make_folder(folder)
    path = folder / "time_to_walk.json"
    engine = engine_name(task.cfg.sim, device)
    result = {"task": task.cfg.task, "physics": engine, "rmse": args.rmse, "share_of_falls": args.falls, "first": first}
    write_text(path, json.dumps({**result, "checkpoints": rows}, indent=1))
    print(f"written: {relative(path)}")
    return 0


def _written_at(path: Path) -> float:
    """When a checkpoint was written, since its process began [s].

    Raises:
        ConfigError: it does not say.
    """
    seconds = (read_checkpoint(path).get("infos") or {}).get("wall_s")
    if not isinstance(seconds, int | float):
        raise ConfigError(f"{relative(path)}: says nothing of the time it was written at")
    return float(seconds)


def walks(row: dict[str, Any], rmse: float, falls: float) -> bool:
    """Whether a checkpoint is good enough; one whose robots all fell has no error."""
    return row["rmse_lin"] is not None and row["rmse_lin"] < rmse and row["falls"] < falls


if __name__ == "__main__":
    sys.exit(main())
