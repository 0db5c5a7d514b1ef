"""What robots live in: batch and physics."""

from dataclasses import dataclass, field
from typing import Literal

from legged.config.bounds import LONGEST_S, between, positive, quantity

NewtonSolver = Literal["mujoco", "steel", "kamino", "featherstone", "xpbd", "semi_implicit"]


@dataclass(frozen=True)
class EnvConfig:
    """Size and length of the simulated batch."""

    num_envs: int = field(default=4096, metadata=between(1, 2**20))
    """Robots simulated side by side, on each GPU."""
    episode_length_s: float = field(default=20.0, metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Time-out of an episode [s]."""
    seed: int = field(default=1, metadata=between(0, 2**62))
    """Seed of torch's generators, and of the terrain; physics itself draws no random numbers. With several GPUs the robots of
    each have their own, seed + rank."""


@dataclass(frozen=True)
class SimConfig:
    """Physics time step, engine and contact solver."""

    physics: Literal["auto", "mujoco_warp", "mujoco", "newton"] = "auto"
    """Engine: `mujoco_warp` (GPU, or all CPU cores), `mujoco` (C engine, all CPU cores), `newton` (GPU, or one core), or
    `auto`: mujoco_warp on a GPU, and without one for 256 robots or more that its fused step takes; else the C engine."""
    solver: NewtonSolver = "mujoco"
    """Solver of `newton`; the other engines have their own. Each comes with settings under which a quadruped stands:
    legged/physics/newton/solvers.py."""
    dt: float = field(default=0.005, metadata=quantity("s", positive(0.1, low=1e-5)))
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
    step: Literal["auto", "fused", "library"] = "auto"
    """How mujoco_warp makes a step: `library`, by its own launches, dozens of them; `fused`, by one launch for all that comes
    before contacts, one for contacts, one for their forces and one for integration, or there is an error that says what of
    the model keeps it off; `auto`, `fused` where the model fits, else contact forces alone where they fit (60 degrees of
    freedom)."""
    nconmax: int = field(default=24, metadata=between(1, 10_000))
    """Contacts for which each robot has room in mujoco_warp and newton. Where their own launches find contacts, robots share
    that room, and pairs of shapes that might touch take of it too."""
    njmax: int = field(default=96, metadata=between(1, 10_000))
    """Constraint rows allocated per robot in mujoco_warp and in Newton's MuJoCo solver: 4 a contact in the pyramidal cone, 1
    a joint limit."""
    self_collisions: bool = False
    """Let the robot's shapes touch each other, except those of neighbouring bodies."""
    terrain_collider: Literal["cells", "convex"] = "cells"
    """How mujoco_warp and Newton's MuJoCo solver meet a height map: `cells`, our own kernel with vertical faces; `convex`,
    the general collider on one height field, ten times slower and with ramps for steps, for shapes unknown to `cells`."""
    threads: int = field(default=0, metadata=between(0, 1024))
    """Threads of the C engine, and of mujoco_warp's fused step on a CPU; 0 takes all cores."""
