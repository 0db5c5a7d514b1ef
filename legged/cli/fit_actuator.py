"""`legged fit-actuator`: a motor model from a log of a real motor."""

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from legged.commandline.command import sub_command
from legged.config.yaml_files import dump
from legged.deploy.command_parser import argument
from legged.errors import ConfigError
from legged.figures import figure
from legged.fitting.log import ActuatorLog, check_alike, read_log
from legged.fitting.parametric import Drive, fit_drive
from legged.process.paths import make_folder, ready_to_write, relative, write_text

UPDATES = {"mlp": 2000, "lstm": 3000}
"""Kind of network -> default number of training updates."""
HIDDEN = {"mlp": (32, 32, 32), "lstm": (8, 8)}
MEASURED = "#000000"
COLORS = {"ideal PD": "#E69F00", "parametric": "#0072B2", "network": "#D55E00"}
"""Colours of the fits, from the palette of Okabe and Ito."""
SHOWN_S = 2.0
"""Length of the time axis in the picture [s]."""
POINTS = 4000
"""Largest number of measurements in the plot of torque over speed."""


@dataclass(frozen=True)
class Fit:
    """The torques that one model predicts for a log."""

    name: str
    log: ActuatorLog
    """The log, sampled at the time step of the model."""
    torque: np.ndarray
    """Predicted torques (T, D) [N m]."""


@sub_command(
    "legged fit-actuator log.npz --out fits/anymal_c",
    "legged fit-actuator log.npz --joints HFE,KFE --kind lstm --dt 0.005 --out fits/legs",
    arguments=(
        argument("log", metavar="LOG", type=Path, help="the log, an .npz file"),
        argument("--out", type=Path, default=Path("actuator"), help="folder for the files; actuator by default"),
        argument("--joints", default="", help="fit only joints whose names contain one of these texts, e.g. HFE,KFE"),
        argument("--kind", choices=("mlp", "lstm"), default="mlp", help="kind of network; mlp by default"),
        argument("--hidden", help="units of each hidden layer; by default 32,32,32 for an mlp, 8,8 for an lstm"),
        argument("--samples", type=int, default=3, help="number of samples in the input of an mlp; 3 by default"),
        argument("--spacing", type=float, default=0.01, help="time between samples in the input [s]; 0.01 by default"),
        argument("--dt", type=float, default=0.005, help="physics step of the task, sim.dt [s]; 0.005 by default"),
        argument("--updates", type=int, help="training updates; by default 2000 for an mlp, 3000 for an lstm"),
        argument("--longest-delay", type=float, default=0.05, help="longest delay that is tried [s]; 0.05 by default"),
        argument("--seed", type=int, default=1, help="seed of the network's training"),
    ),
)
def fit_actuator(args: argparse.Namespace) -> int:
    """Fit a motor model to a log of a real motor: `legged fit-actuator log.npz --out fits/knee --joints KFE`.

    The log has T samples of D joints. It must have the arrays joint_names (D,), target and position (T, D) [rad], velocity
    (T, D) [rad/s], torque (T, D) [N m], and either dt or time (T,) [s]. If it consists of several recordings, the array run
    (T,) gives the number of each sample's recording. The motors' stiffness, damping and torque_limit are optional. Sample at
    200 Hz or more, because motion between two samples can't be learned.

    Two models are fitted: a parametric drive (gains, delay, torque-speed line, friction) and a network. Both are tested on a
    fifth of the log that is not used for fitting. These files are written to the folder of --out: actuator.yaml (the drive as
    section `control` of a task), network.npz (for control.actuator.network), fit.json and fit.png.
    """
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
        raise ConfigError(f"--spacing: must be a whole multiple of --dt ({args.dt:g} s), got {args.spacing:g}")
    log = read_log(args.log).only([part.strip() for part in args.joints.split(",") if part.strip()])
    check_alike(log, args.log)
    at_steps = log.resampled(args.dt)
    ready_to_write(args.out)
    _tell(log)
    drive = fit_drive(log, args.longest_delay)
    _tell_drive(drive, log)
    from legged.fitting.training import predict, train_network  # The import is here because it takes long.

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
    make_folder(args.out)
    told = "# Fitted by `legged fit-actuator`. Copy this section into the YAML file of a task.\n"
    section = dump({"control": control_section(at_steps, drive)}, sort_keys=False, default_flow_style=None, width=120)
    write_text(args.out / "actuator.yaml", told + section)
    numbers = {name: value if np.isfinite(value) else None for name, value in vars(drive).items()}
    facts = {"joints": list(log.joint_names), "sim_dt": at_steps.dt, "drive": numbers, "held_out": judged}
    write_text(args.out / "fit.json", json.dumps(facts, indent=1))
    replace(weights, facts=judged["network"]).save(args.out / "network.npz")
    draw(args.out / "fit.png", log, fits, drive)
    print(f"written: {relative(args.out)}/ (actuator.yaml, network.npz, fit.json, fit.png)")
    return 0


def _widths(text: str) -> list[int]:
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in parts):
        raise ConfigError(f"--hidden: expected numbers like 32,32,32, got '{text}'")
    return [int(part) for part in parts]


def _tell(log: ActuatorLog) -> None:
    """Print the length, the sampling rate, the number of runs and the names of the joints of a log."""
    seconds, held, runs = len(log.run) * log.dt, float(log.held_out.mean()), len(np.unique(log.run))
    names = ", ".join(log.joint_names[:4]) + (", ..." if len(log.joint_names) > 4 else "")
    sampled = f"{seconds:.4g} s at {1.0 / log.dt:.4g} Hz in {runs} run{'s' if runs > 1 else ''}"
    print(f"{sampled}, {held:.0%} of it held out; {names}")


def _tell_drive(drive: Drive, log: ActuatorLog) -> None:
    """Print the fitted parameters, and say which parameters the log does not determine."""
    given = "given" if log.has_gains else "fitted"
    print(f"gains: {drive.stiffness:.4g} N m/rad, {drive.damping:.4g} N m s/rad ({given})")
    print(f"delay: {1e3 * drive.delay:.3g} ms")
    if np.isfinite(drive.stall_torque):
        print(f"motor: {drive.stall_torque:.4g} N m at rest, 0 N m at {drive.no_load_speed:.4g} rad/s")
    else:
        print("motor: the log never reaches a torque-speed limit, so the robot's torque limit stays in use")
    viscous = f"viscous {drive.viscous:.3g} N m s/rad" if log.has_gains else "viscous friction is part of the damping"
    if drive.breakaway == drive.coulomb:
        dry = f"{drive.coulomb:.3g} N m (the log shows no higher breakaway torque)"
    else:
        dry = f"{drive.breakaway:.3g} N m to break away, {drive.coulomb:.3g} N m beyond {drive.stribeck_velocity:.2g} rad/s"
    print(f"friction: {dry}, {viscous}")


def errors(fit: Fit) -> dict[str, float]:
    """Return errors of a fit on held-out samples. `rmse` is the root mean square error and `largest` the largest error [N m].
    `explained` is the share of the variance of the measured torques that the fit explains.
    """
    measured = fit.log.torque[fit.log.held_out]
    wrong = fit.torque[fit.log.held_out] - measured
    explained = 1.0 - float(np.mean(wrong**2) / max(np.var(measured), 1e-12))
    return {"rmse": float(np.sqrt(np.mean(wrong**2))), "largest": float(np.abs(wrong).max()), "explained": explained}


def control_section(log: ActuatorLog, drive: Drive) -> dict[str, Any]:
    """Return the section `control` of a task with a fitted drive. `log` has the names of the joints, and its `dt` is the
    physics step of the task. Gains are included only if they were fitted. If the log states them, they are not fitted.
    """

    def named(**values: float) -> dict[str, dict[str, float]]:
        return {key: {name: float(f"{value:.4g}") for name in log.joint_names} for key, value in values.items()}

    section: dict[str, Any] = {}
    if np.isfinite(drive.stall_torque):
        limits = named(stall_torque=drive.stall_torque, no_load_speed=drive.no_load_speed)
        section |= {"model": "dc_motor", "joints": list(log.joint_names), **limits}
    friction = {"coulomb_friction": drive.coulomb, "breakaway_friction": drive.breakaway, "viscous_friction": drive.viscous}
    section |= {**named(**friction), "stribeck_velocity": float(f"{drive.stribeck_velocity:.4g}")}
    steps = drive.delay / log.dt
    section["delay"] = [int(np.floor(steps + 0.05)), int(np.ceil(steps - 0.05))]
    return {"actuator": section} | ({} if log.has_gains else named(stiffness=drive.stiffness, damping=drive.damping))


def draw(path: Path, log: ActuatorLog, fits: list[Fit], drive: Drive) -> None:
    """Draw torques over time for held-out samples, torque over speed for all samples, and the RMSE of each fit.

    Raises:
        RunError: the file cannot be written.
    """
    joint = int(np.argmax(log.torque[log.held_out].std(axis=0)))
    with figure(path, (13.0, 4.6), 1, 3) as (_, axes):
        over_time, over_speed, bars = axes[0]
        rows = _shown(log)
        over_time.plot((rows - rows[0]) * log.dt, log.torque[rows, joint], color=MEASURED, lw=2.2, label="measured", zorder=0)
        for fit in fits:
            rows = _shown(fit.log)
            time = (rows - rows[0]) * fit.log.dt
            over_time.plot(time, fit.torque[rows, joint], color=COLORS[fit.name], lw=1.2, label=fit.name)
        over_time.set(title=f"{log.joint_names[joint]}, held out", xlabel="time [s]", ylabel="torque [N m]")
        over_time.legend(fontsize=8)
        speeds, torques = log.velocity.ravel(), log.torque.ravel()
        picked = np.linspace(0, len(speeds) - 1, min(POINTS, len(speeds))).astype(int)
        over_speed.scatter(speeds[picked], torques[picked], s=3, color="#999999", label="measured")
        line = np.linspace(speeds.min(), speeds.max(), 200)
        if np.isfinite(drive.stall_torque):
            for sign, label in ((1.0, "limits of the fitted motor"), (-1.0, None)):
                edge = drive.torques(np.full(200, sign * 1e6), line)
                over_speed.plot(line, edge, color=COLORS["parametric"], label=label)
        over_speed.plot(line, -drive.friction(line), color=COLORS["network"], linestyle="--", label="fitted friction")
        reach = 1.15 * np.abs(torques).max()
        over_speed.set(ylim=(-reach, reach), title="all samples", xlabel="velocity [rad/s]", ylabel="torque [N m]")
        over_speed.legend(fontsize=8)
        values = [errors(fit)["rmse"] for fit in fits]
        drawn = bars.bar([fit.name for fit in fits], values, color=[COLORS[fit.name] for fit in fits])
        bars.bar_label(drawn, [f"{value:.3g}" for value in values])
        bars.set(title="error on held-out samples", ylabel="RMSE [N m]")


def _shown(log: ActuatorLog) -> np.ndarray:
    """Return the indices of the first held-out sample, and of the held-out samples of the same run in the next SHOWN_S."""
    held = log.held_out
    start = int(np.flatnonzero(held)[0])
    rows = np.arange(start, min(start + round(SHOWN_S / log.dt), len(held)))
    return rows[held[rows] & (log.run[rows] == log.run[start])]
