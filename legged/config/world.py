"""What the robots live in: batch, physics and ground."""

from dataclasses import dataclass, field
from typing import Literal

from legged.config.bounds import LONGEST_S, UNIT, between, items, positive

NewtonSolver = Literal["mujoco", "steel", "kamino", "featherstone", "xpbd", "semi_implicit"]

MEASURED = items(500, between(-100, 100))


@dataclass(frozen=True)
class EnvConfig:
    """Size and length of the simulated batch."""

    num_envs: int = field(default=4096, metadata=between(1, 2**20))
    """Robots simulated side by side, on each GPU."""
    episode_length_s: float = field(default=20.0, metadata=positive(LONGEST_S, low=1e-5))
    """Time-out of an episode [s]."""
    seed: int = field(default=1, metadata=between(0, 2**62))
    """Seed of torch's generators, and of the terrain; physics itself draws no random numbers. With several GPUs the robots of
    each have their own, seed + rank."""


@dataclass(frozen=True)
class SimConfig:
    """Physics time step, engine and contact solver."""

    physics: Literal["auto", "mujoco_warp", "mujoco", "newton"] = "auto"
    """Engine: `mujoco_warp` (GPU, or Warp's CPU device), `mujoco` (C engine, all CPU cores), `newton` (GPU, or Warp's CPU
    device), `auto` by device."""
    solver: NewtonSolver = "mujoco"
    """Solver of `newton`; the other engines have their own. Each comes with settings under which a quadruped stands:
    legged/physics/newton/solvers.py."""
    dt: float = field(default=0.005, metadata=positive(0.1, low=1e-5))
    """Physics step [s]; the control step is `dt * control.decimation`."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """Friction cone. Pyramidal, impratio 10: a standing ANYmal C sinks 1 cm from 2 s to 5 s; elliptic costs twice as much."""
    impratio: float = field(default=10.0, metadata=positive(1e5, low=1e-3))
    """Stiffness of friction relative to the normal direction; 1 lets loaded feet creep outward, 100 needs 50 or more
    iterations."""
    iterations: int = field(default=10, metadata=between(1, 10_000))
    """Cap of Newton solver iterations per physics step."""
    ls_iterations: int = field(default=20, metadata=between(1, 10_000))
    """Cap of line-search iterations per solver iteration."""
    constraint_solver: Literal["auto", "fused", "rounds"] = "auto"
    """How mujoco_warp solves for contact forces: `rounds`, its own Newton solver, ten launches a round until the last world
    has converged; `fused`, the same iteration as one launch in which every world ends by itself; `auto`, `fused` for a model
    that it knows (pyramidal cones, 32 degrees of freedom)."""
    smooth_dynamics: Literal["auto", "fused", "stages"] = "auto"
    """How mujoco_warp computes what is not of contacts: `stages`, its own launches, dozens of them; `fused`, one for poses,
    inertias and bias forces, one for integration; `auto`, `fused` for a robot that torques alone move, where the constraint
    solver is fused too."""
    nconmax: int = field(default=24, metadata=between(1, 10_000))
    """Contacts (and candidate pairs) allocated per robot in mujoco_warp and newton, in a pool all robots share."""
    njmax: int = field(default=96, metadata=between(1, 10_000))
    """Constraint rows allocated per robot in mujoco_warp and in Newton's MuJoCo solver: 4 a contact in the pyramidal cone, 1
    a joint limit."""
    self_collisions: bool = False
    """Let the robot's shapes touch each other, except those of neighbouring bodies."""
    terrain_collider: Literal["cells", "convex"] = "cells"
    """How mujoco_warp and Newton's MuJoCo solver meet a height map: `cells`, our own kernel with vertical faces; `convex`,
    the general collider on one height field, ten times slower and with ramps for steps, for shapes unknown to `cells`."""
    threads: int = field(default=0, metadata=between(0, 1024))
    """Threads of the C engine; 0 takes all cores."""


@dataclass(frozen=True)
class TerrainConfig:
    """The ground: a plane, or tiles of several types in rows of growing difficulty."""

    mesh_type: Literal["plane", "height_map"] = "plane"
    """An infinite horizontal plane, or a height map of num_rows x num_cols tiles."""
    curriculum: bool = True
    """Robots move to harder rows while they succeed; otherwise all rows are hard, and robots stay where they are."""
    proportions: dict[str, float] = field(default_factory=dict, metadata=UNIT)
    """Terrain type -> share of the columns; sums to 1. Types: legged/terrain/generators.py, TERRAIN_TYPES."""
    num_rows: int = field(default=10, metadata=between(1, 1000))
    """Levels of difficulty: row / num_rows."""
    num_cols: int = field(default=20, metadata=between(1, 1000))
    """Columns, each of one type."""
    terrain_length: float = field(default=8.0, metadata=positive(1000, low=0.01))
    """Extent of a tile along x [m]."""
    terrain_width: float = field(default=8.0, metadata=positive(1000, low=0.01))
    """Extent of a tile along y [m]."""
    border_size: float = field(default=25.0, metadata=between(0, 1000))
    """Width of the level ground around all tiles [m]."""
    horizontal_scale: float = field(default=0.1, metadata=positive(10, low=1e-3))
    """Edge of a cell of the height map [m]."""
    slope_threshold: float = field(default=0.2, metadata=between(0, 1000))
    """On types made of steps, a difference between cells steeper than this (rise over run) is a vertical face."""
    max_init_terrain_level: int = field(default=5, metadata=between(0, 999))
    """Highest row in which robots start training."""
    spawn_range: float = field(default=1.0, metadata=between(0, 1000))
    """Robots start at most this far from the middle of their tile, in x and in y [m]."""
    measured_points_x: tuple[float, ...] = field(default=tuple(round(0.1 * i - 0.8, 1) for i in range(17)), metadata=MEASURED)
    """Where heights are measured, forward of the base [m]."""
    measured_points_y: tuple[float, ...] = field(default=tuple(round(0.1 * i - 0.5, 1) for i in range(11)), metadata=MEASURED)
    """And to its left [m]."""
