"""How good a policy is: `python -m legged.tools.evaluate --task anymal_c_flat [--physics mujoco]`.

How well it tracks commands, for tasks with terrain on rough ground; and there, how hard a terrain it still crosses. Prints
tables and writes evaluation_<physics>.json and .png and success_<physics>.png beside the checkpoint (or to --out). With
`--physics all`, the same commands in every engine and solver: crossing.json and .png.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from legged.commandline.arguments import (
    add_run_arguments,
    add_task_arguments,
    import_and_check,
    pick_device,
    policy_overrides,
    settle_on,
)
from legged.commandline.command import run_main
from legged.config import override
from legged.errors import ConfigError
from legged.evaluation.crossing import EVERYWHERE, cross
from legged.evaluation.success import chosen_types, sweep
from legged.evaluation.success_report import plot_success, print_success, with_other_engine
from legged.evaluation.tracking import ready_to_track, tell
from legged.evaluation.velocity_grid import Grid, measure
from legged.physics import engine_name
from legged.policies.restore import find_policy
from legged.process.paths import make_folder, ready_to_write, relative, replacing, write_text

MOST_ROBOTS = 2**20
"""More are not simulated at once."""
MOST_SIZES = 16
"""Sizes of a terrain type, at most, that are measured at once."""
MOST_VALUES = 10_000
"""Commands on an axis, at most."""
FASTEST = 20.0
"""A command, at most [m/s, rad/s]: the ground that fast robots need grows with the square of it."""


def main(argv: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    return run_main(_main, argv)


def _main(argv: list[str] | None) -> int:
    parser = argparse.ArgumentParser(prog="evaluate", description=__doc__)
    add_task_arguments(parser)
    add_run_arguments(parser)
    for axis, unit in (("vx", "m/s"), ("vy", "m/s"), ("yaw", "rad/s")):
        parser.add_argument(f"--{axis}", default="-1:1:0.5", help=f"low:high:step of the command grid [{unit}]")
    parser.add_argument("--robots", type=int, default=16, help="robots a cell")
    parser.add_argument("--types", help="terrain types to cross, e.g. stairs_up,pit; those of the training by default")
    parser.add_argument("--full", action="store_true", help="all sizes of a type, 256 robots each")
    parser.add_argument("--robots-per-point", type=int, help="robots for each size of a type; 32, or 256 with --full")
    parser.add_argument(
        "--out",
        type=Path,
        help="folder for JSON and PNG; by default beside the checkpoint, or logs/evaluate for a shipped one",
    )
    args = parser.parse_intermixed_args(argv)
    import_and_check(args)
    if args.robots < 1:
        raise ConfigError(f"--robots: must be at least 1, got {args.robots}")
    a_point = args.robots_per_point if args.robots_per_point is not None else (256 if args.full else 32)
    if a_point < 1:
        raise ConfigError(f"--robots-per-point: must be at least 1, got {a_point}")
    if args.num_envs is not None:
        raise ConfigError("--num_envs: the grid says how many robots there are; --robots sets those of a cell")
    grid = Grid(axis_values("--vx", args.vx), axis_values("--vy", args.vy), axis_values("--yaw", args.yaw), args.robots)
    check_number(grid)
    if a_point > MOST_ROBOTS // MOST_SIZES:
        raise ConfigError(f"--robots-per-point: at most {MOST_ROBOTS // MOST_SIZES:,}, got {a_point:,}")
    device = torch.device("cpu") if args.physics == "mujoco" and args.sim_device is None else pick_device(args.sim_device)
    settle_on(device)
    everywhere = args.physics == EVERYWHERE
    if everywhere:
        for flag in ("solver", "types", "robots_per_point"):
            if getattr(args, flag) is not None:
                raise ConfigError(f"--{flag.replace('_', '-')}: --physics {EVERYWHERE} tracks commands in every solver, only")
        args.physics = None
    policy = find_policy(args)
    folder = args.out or policy.output("evaluate")
    ready_to_write(folder)
    if everywhere:
        return cross(policy, grid, policy_overrides(args), device, not args.no_graph, folder)
    types = chosen_types(policy.cfg, args.types)
    # The engine is that of the device, not that of the training.
    asked = [("sim.physics", "auto"), *policy_overrides(args)]
    engine = engine_name(override(policy.cfg, asked).sim, device, "--physics" if args.physics else "sim.physics")
    start = time.perf_counter()
    task, runner = ready_to_track(policy, grid, asked, device, graph=not args.no_graph)
    figures = measure(task, runner.get_inference_policy(str(device)), grid)
    lost = figures.pop("contact_overflows")
    rough = policy.cfg.terrain.mesh_type != "plane"
    header = {
        "task": policy.cfg.task,
        "checkpoint": policy.checkpoint.name,
        "physics": engine,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
    }
    success = None
    if types:
        success = sweep(policy, types, a_point, args.full, asked, device, not args.no_graph, tell)
    result = {
        **header,
        "wall_s": time.perf_counter() - start,
        **({"rough": {"bumps": 0.05, **figures, "contact_overflows": lost}} if rough else figures),
        **({} if success is None else {"success": success}),
    }
    # First what is on the screen: no disk can take it away any more.
    tracking = {**header, **figures, "ground": "on rough ground, " if rough else ""}
    print_report(tracking)
    warn_of_overflows("tracking", lost)
    if success is not None:
        print_success(success)
        warn_of_overflows("success", success["contact_overflows"])
    make_folder(folder)
    path = folder / f"evaluation_{engine}.json"
    write_text(path, json.dumps(result, indent=1, allow_nan=False))
    written = [path, path.with_suffix(".png")]
    plot(tracking, written[1])
    if success is not None:
        written.append(folder / f"success_{engine}.png")
        plot_success(with_other_engine(result, path), written[2])
    print(f"written: {', '.join(relative(one) for one in written)}")
    return 0


def warn_of_overflows(what: str, lost: int) -> None:
    """Results with lost contacts are not to be trusted; say so."""
    if lost:
        print(
            f"warning: {what}: contacts were lost for want of memory, {lost} times (robots x steps); raise sim.nconmax and"
            " sim.njmax",
            file=sys.stderr,
        )


def axis_values(flag: str, text: str) -> list[float]:
    """'-1:1:0.5' -> [-1, -0.5, 0, 0.5, 1]; a single number is a single value.

    Raises:
        ConfigError: not of that form.
    """
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        parts = []
    finite = all(np.isfinite(part) for part in parts)
    if finite and any(abs(part) > FASTEST for part in parts[:2]):
        raise ConfigError(f"{flag}: '{text}' asks for more than {FASTEST:g}; commands are in m/s and rad/s")
    if len(parts) == 1 and finite:
        return parts
    if len(parts) != 3 or not finite or parts[2] <= 0 or parts[1] < parts[0]:
        raise ConfigError(f"{flag}: '{text}' is not of the form low:high:step, e.g. {flag}=-1:1:0.5")
    low, high, step = parts
    count = (high - low) / step + 1.0
    if count > MOST_VALUES:
        raise ConfigError(
            f"{flag}: '{text}' makes {count:,.0f} cells of this axis alone; at most {MOST_VALUES:,} are possible"
        )
    return [round(float(value), 6) for value in np.arange(low, high + 0.5 * step, step)]


def check_number(grid: Grid) -> None:
    """Check that the robots of a grid can be simulated at once.

    Raises:
        ConfigError: there are more than any machine holds.
    """
    cells = len(grid.vx) * len(grid.vy) * len(grid.yaw)
    if grid.num_envs > MOST_ROBOTS:
        raise ConfigError(
            f"--vx, --vy, --yaw, --robots: {cells:,} cells x {grid.robots:,} robots are {grid.num_envs:,} robots; at most"
            f" {MOST_ROBOTS:,} are possible"
        )


def print_report(result: dict[str, Any]) -> None:
    """The figures over the grid, and the gait at 0.5 m/s."""
    lin, ang, gait = result["rmse_lin"], result["rmse_ang"], result["gait"]
    title = f"{result['task']} ({result['checkpoint']}) in {result['physics']}"
    if result["ground"]:
        title += ", on level ground with bumps of up to 5 cm"
    table = Table(title=escape(title), title_justify="left")
    for name, justify in (("measure", "left"), ("value", "right"), ("where", "left")):
        table.add_column(name, justify=justify)  # type: ignore[arg-type]
    cells = f"{len(result['cells'])} cells x {result['robots_per_cell']} robots x {result['measured_s']:.0f} s"
    for name, unit, errors in (("velocity", "m/s", lin), ("yaw rate", "rad/s", ang)):
        if errors["mean"] is None:
            table.add_row(f"{name} RMSE", "none", "every robot fell before it was measured")
            continue
        table.add_row(f"{name} RMSE, mean", f"{errors['mean']:.3f} {unit}", cells)
        table.add_row(f"{name} RMSE, worst cell", f"{errors['worst']:.3f} {unit}", _command(errors["worst_cell"]))
    table.add_row("falls", f"{100 * result['falls']:.2f} %", "of the robots, within the hold")
    if result["cost_of_transport"] is not None:
        table.add_row("cost of transport", f"{result['cost_of_transport']:.2f}", "sum |torque * speed| / (weight * speed)")
    at = _command(gait["command"])
    table.add_row("duty factor", f"{gait['duty_factor']:.2f}", at)
    table.add_row("steps per second and foot", f"{gait['steps_per_s']:.2f}", at)
    table.add_row("base height", f"{gait['base_height']:.3f} m", at)
    table.add_row("thigh or shank contact", f"{100 * gait['thigh_contact']:.2f} % of steps", at)
    Console(width=110).print(table)


def _command(cell: list[float]) -> str:
    return f"at vx {cell[0]:g}, vy {cell[1]:g} m/s, yaw {cell[2]:g} rad/s"


def plot(result: dict[str, Any], path: Path) -> None:
    """Heat maps: for each (vx, vy) and each (vx, yaw), the mean over the third command."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    grid = result["grid"]
    shape = tuple(len(grid[axis]) for axis in ("vx", "vy", "yaw"))
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    panels = (("rmse_lin", 2, "vy", "velocity RMSE [m/s]"), ("rmse_ang", 1, "yaw", "yaw rate RMSE [rad/s]"))
    for axis, (name, over, other, label) in zip(axes, panels, strict=True):
        values = np.nanmean(np.array([cell[name] for cell in result["cells"]], dtype=float).reshape(shape), axis=over)
        image = axis.imshow(values.T, origin="lower", aspect="auto", cmap="viridis_r", vmin=0.0)
        axis.set_xticks(range(shape[0]), [f"{v:g}" for v in grid["vx"]])
        axis.set_yticks(range(len(grid[other])), [f"{v:g}" for v in grid[other]])
        axis.set_xlabel("commanded vx [m/s]")
        axis.set_ylabel(f"commanded {other} [{'m/s' if other == 'vy' else 'rad/s'}]")
        for (i, j), value in np.ndenumerate(values):
            dark = value > 0.6 * np.nanmax(values)
            axis.text(i, j, f"{value:.2f}", ha="center", va="center", color="white" if dark else "black")
        figure.colorbar(image, ax=axis, label=label)
    figure.suptitle(f"{result['task']} in {result['physics']}, {result['ground']}falls {100 * result['falls']:.1f} %")
    with replacing(path) as part:
        figure.savefig(part, dpi=110, format="png")
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
