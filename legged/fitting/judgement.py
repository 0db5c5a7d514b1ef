"""Errors of fitted actuators on held-out torques: numbers and a picture."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from legged.figures import figure
from legged.fitting.log import ActuatorLog
from legged.fitting.parametric import Drive

MEASURED = "#000000"
COLORS = {"ideal PD": "#E69F00", "parametric": "#0072B2", "network": "#D55E00"}
"""Colours of the fits, from the palette of Okabe and Ito."""
SHOWN_S = 2.0
"""Time range of the picture [s]."""
POINTS = 4000
"""Number of measurements in the plot of torque over speed."""


@dataclass(frozen=True)
class Fit:
    """Prediction of the torques of a log by one model."""

    name: str
    log: ActuatorLog
    """Log at the time step of the model."""
    torque: np.ndarray
    """(T, D) [N m]."""


def errors(fit: Fit) -> dict[str, float]:
    """Return the root mean squared error and the largest error on held-out samples [N m], and the explained share of their
    variance.
    """
    measured = fit.log.torque[fit.log.held_out]
    wrong = fit.torque[fit.log.held_out] - measured
    explained = 1.0 - float(np.mean(wrong**2) / max(np.var(measured), 1e-12))
    return {"rmse": float(np.sqrt(np.mean(wrong**2))), "largest": float(np.abs(wrong).max()), "explained": explained}


def control_section(log: ActuatorLog, drive: Drive) -> dict[str, Any]:
    """Return the section `control` of a fitted drive, for the joints of a log with the time step of the physics. Gains that
    the log does not state are part of it.
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
    """Write a picture: torques over time and errors of each fit on held-out samples, and torque over speed.

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
    """Return the indices of the first held-out samples of a log, all of one run."""
    held = log.held_out
    start = int(np.flatnonzero(held)[0])
    rows = np.arange(start, min(start + round(SHOWN_S / log.dt), len(held)))
    return rows[held[rows] & (log.run[rows] == log.run[start])]
