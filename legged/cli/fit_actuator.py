"""Fit a motor model to a log of a real motor: `legged fit-actuator log.npz --out fits/knee --joints KFE`.

The log has the arrays joint_names (D,), target, position, velocity and torque (T, D) in rad, rad/s and N m, and dt [s] or
time (T,). The arrays run (T,), stiffness, damping and torque_limit may be added if they are known. Sample at 200 Hz or more:
motion between two samples can't be learned.

Two models are fitted: a drive with known parts (gains, delay, torque-speed line, friction) and a network. Both are judged on
a fifth of the log that the fit has not seen. The folder gets actuator.yaml (a section control.actuator with the parts),
network.npz (for control.actuator.network), fit.json and fit.png.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from legged.commandline.command import command
from legged.config.yaml_files import dump
from legged.errors import ConfigError
from legged.fitting.judgement import Fit, actuator_section, draw, errors
from legged.fitting.log import ActuatorLog, check_alike, read_log
from legged.fitting.parametric import Drive, fit_drive
from legged.process.command_parser import CommandParser
from legged.process.paths import make_folder, ready_to_write, relative, write_text

UPDATES = {"mlp": 2000, "lstm": 3000}
"""Default number of updates of a network."""
HIDDEN = {"mlp": (32, 32, 32), "lstm": (8, 8)}


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged fit-actuator",
        __doc__,
        "legged fit-actuator log.npz --out fits/anymal_c",
        "legged fit-actuator log.npz --joints HFE,KFE --kind lstm --dt 0.005 --out fits/legs",
    )
    parser.add_argument("log", metavar="LOG", type=Path, help="the log, an .npz file")
    parser.add_argument("--out", type=Path, default=Path("actuator"), help="folder that is written")
    parser.add_argument("--joints", default="", help="parts of the names of the joints to fit; all by default")
    parser.add_argument("--kind", choices=("mlp", "lstm"), default="mlp", help="the network; mlp by default")
    parser.add_argument("--hidden", help="units of the network's layers; 32,32,32 by default, 8,8 for an lstm")
    parser.add_argument("--samples", type=int, default=3, help="moments that an mlp sees; 3 by default")
    parser.add_argument("--spacing", type=float, default=0.01, help="time between the moments of an mlp [s]; 0.01 by default")
    parser.add_argument("--dt", type=float, default=0.005, help="physics step of the task, sim.dt [s]; 0.005 by default")
    parser.add_argument("--updates", type=int, help="updates of the network; 2000 by default, 3000 for an lstm")
    parser.add_argument("--longest-delay", type=float, default=0.05, help="delays up to this are tried [s]; 0.05 by default")
    parser.add_argument("--seed", type=int, default=1, help="seed of the network's first weights")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_args(argv)
    hidden = _widths(args.hidden) if args.hidden else HIDDEN[args.kind]
    updates = UPDATES[args.kind] if args.updates is None else args.updates
    for flag, value, low, high in (
        ("samples", args.samples, 1, 100),
        ("updates", updates, 1, 10**7),
        ("dt", args.dt, 1e-5, 0.1),
        ("spacing", args.spacing, 1e-5, 1.0),
        ("longest-delay", args.longest_delay, 0.0, 1.0),
        *(("hidden", width, 1, 1024) for width in hidden),
    ):
        if not low <= value <= high:
            raise ConfigError(f"--{flag}: must be {low:g} to {high:g}, got {value:g}")
    spacing = round(args.spacing / args.dt)
    if spacing < 1 or abs(spacing * args.dt - args.spacing) > 1e-3 * args.dt:
        raise ConfigError(f"--spacing: must be a whole multiple of --dt, {args.dt:g} s, got {args.spacing:g}")
    log = read_log(args.log).only([part.strip() for part in args.joints.split(",") if part.strip()])
    check_alike(log, args.log)
    at_steps = log.resampled(args.dt)
    ready_to_write(args.out)
    _tell(log)
    drive = fit_drive(log, args.longest_delay)
    _tell_drive(drive, log)
    from legged.fitting.training import predict, train_network  # torch imports slowly; a wrong log fails before

    weights = train_network(at_steps, args.kind, hidden, args.samples, spacing, updates, args.seed)
    fits = [Fit("parametric", log, drive.predict(log)), Fit("network", at_steps, predict(weights, at_steps))]
    if log.stiffness is not None and log.damping is not None:
        limit = np.inf if log.torque_limit is None else log.torque_limit
        asked = log.stiffness * (log.target - log.position) - log.damping * log.velocity
        fits.insert(0, Fit("ideal PD", log, np.clip(asked, -limit, limit)))
    judged = {fit.name: errors(fit) for fit in fits}
    print("held out:")
    for name, of in judged.items():
        print(f"  {name:10}  RMSE {of['rmse']:.3g} N m, largest {of['largest']:.3g} N m, explained {of['explained']:.2%}")
    _write(args.out, at_steps, drive, judged)
    replace(weights, facts=judged["network"]).save(args.out / "network.npz")
    draw(args.out / "fit.png", log, fits, drive)
    print(f"written: {relative(args.out)}/ (actuator.yaml, network.npz, fit.json, fit.png)")
    return 0


def _widths(text: str) -> list[int]:
    """Return the units of the layers.

    Raises:
        ConfigError: the text is not a list of numbers.
    """
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in parts):
        raise ConfigError(f"--hidden: expected numbers like 32,32,32, got '{text}'")
    return [int(part) for part in parts]


def _tell(log: ActuatorLog) -> None:
    """Print the contents of the log."""
    seconds, held = len(log.run) * log.dt, float(log.held_out.mean())
    runs = len(np.unique(log.run))
    names = ", ".join(log.joint_names[:4]) + (", ..." if len(log.joint_names) > 4 else "")
    print(
        f"{seconds:.4g} s at {1.0 / log.dt:.4g} Hz in {runs} run{'s' if runs > 1 else ''}, {held:.0%} of it held out; {names}"
    )


def _tell_drive(drive: Drive, log: ActuatorLog) -> None:
    """Print the fitted parameters, and those that the log does not determine."""
    known = log.stiffness is not None and log.damping is not None
    print(f"gains: {drive.stiffness:.4g} N m/rad, {drive.damping:.4g} N m s/rad ({'given' if known else 'fitted'})")
    print(f"delay: {1e3 * drive.delay:.3g} ms")
    if np.isfinite(drive.stall_torque):
        print(f"motor: {drive.stall_torque:.4g} N m at rest, none at {drive.no_load_speed:.4g} rad/s")
    else:
        print("motor: its torque-speed line is not reached in the log; the effort limit stays")
    viscous = f"viscous {drive.viscous:.3g} N m s/rad" if known else "viscous friction is part of the damping"
    if drive.breakaway == drive.coulomb:
        dry = f"{drive.coulomb:.3g} N m (the log shows no more to break away)"
    else:
        dry = f"{drive.breakaway:.3g} N m to break away, {drive.coulomb:.3g} N m beyond {drive.stribeck_velocity:.2g} rad/s"
    print(f"friction: {dry}, {viscous}")


def _write(folder: Path, log: ActuatorLog, drive: Drive, judged: dict[str, dict[str, float]]) -> None:
    """Write the results.

    Raises:
        RunError: the files can't be written.
    """
    make_folder(folder)
    control: dict[str, Any] = {"actuator": actuator_section(log, drive, log.dt)}
    if log.stiffness is None or log.damping is None:  # gains that the log does not state are part of the fit
        gains = (("stiffness", drive.stiffness), ("damping", drive.damping))
        control |= {name: {joint: float(f"{gain:.4g}") for joint in log.joint_names} for name, gain in gains}
    told = "# Fitted by legged fit-actuator: copy it into the YAML of a task\n"
    write_text(
        folder / "actuator.yaml",
        told + dump({"control": control}, sort_keys=False, default_flow_style=None, width=120),
    )
    numbers = {name: value if np.isfinite(value) else None for name, value in vars(drive).items()}
    facts = {"joints": list(log.joint_names), "sim_dt": log.dt, "drive": numbers, "held_out": judged}
    write_text(folder / "fit.json", json.dumps(facts, indent=1))
