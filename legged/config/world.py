"""Settings of the simulated world: robots, episodes and physics."""

from dataclasses import dataclass, field
from typing import Literal

from legged.config.bounds import LONGEST_S, between, positive, quantity

NewtonSolver = Literal["mujoco", "steel", "kamino", "featherstone", "xpbd", "semi_implicit"]


@dataclass(frozen=True)
class EnvConfig:
    """Number of robots, length of episodes, and seed."""

    num_envs: int = field(default=4096, metadata=between(1, 2**20))
    """Number of robots simulated in parallel on each GPU."""
    episode_length_s: float = field(default=20.0, metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Time-out of an episode [s]."""
    seed: int = field(default=1, metadata=between(0, 2**62))
    """Seed of torch's generators and of the terrain. Physics uses no random numbers. With several GPUs, each
    process adds its rank to the seed of its robots."""


@dataclass(frozen=True)
class SimConfig:
    """Physics time step, engine and contact solver."""

    physics: Literal["auto", "mujoco_warp", "mujoco", "newton"] = "auto"
    """Physics engine: `mujoco_warp` (GPU or all CPU cores), `mujoco` (C engine, all CPU cores), `newton` (GPU or one core),
    or `auto`. `auto` takes mujoco_warp on a GPU, and on a CPU for 256 robots or more if its fused step supports the model;
    otherwise the C engine."""
    solver: NewtonSolver = "mujoco"
    """Solver of `newton`; other engines have their own. legged/physics/newton/solvers.py has, for each solver, settings with
    which a quadruped stands."""
    dt: float = field(default=0.005, metadata=quantity("s", positive(0.1, low=1e-5)))
    """Physics step [s]; the control step is `dt * control.decimation`."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """Type of friction cone. With the pyramidal cone and impratio 10, a standing ANYmal C sinks by 1 cm between 2 s and
    5 s of simulated time. The elliptic cone needs twice the computing time."""
    impratio: float = field(default=10.0, metadata=positive(1e5, low=1e-3))
    """Stiffness of friction relative to the normal direction. With 1, loaded feet creep outward; 100 needs 50 or more
    iterations."""
    iterations: int = field(default=10, metadata=between(1, 10_000))
    """Largest number of Newton solver iterations per physics step."""
    ls_iterations: int = field(default=20, metadata=between(1, 10_000))
    """Largest number of line-search iterations per solver iteration."""
    step: Literal["auto", "fused", "library"] = "auto"
    """Implementation of a physics step in mujoco_warp. `library`: mujoco-warp's own code, which has dozens of launches.
    `fused`: four launches, for the part before contacts, contacts, contact forces and integration; models that it does not
    support are refused. `auto`: `fused` for models that it supports, else only the contact forces are fused, for models of up
    to 60 degrees of freedom."""
    nconmax: int = field(default=24, metadata=between(1, 10_000))
    """Contacts allocated per robot in mujoco_warp and newton. The libraries' own collision launches share the contacts among
    all robots, and also use some for shapes that are close but do not touch."""
    njmax: int = field(default=96, metadata=between(1, 10_000))
    """Constraint rows allocated per robot in mujoco_warp and in Newton's MuJoCo solver: 4 per contact in the pyramidal cone,
    1 per joint limit."""
    self_collisions: bool = False
    """Let shapes of the same robot collide, except those of neighbouring bodies."""
    terrain_collider: Literal["cells", "convex"] = "cells"
    """Collider of height maps in mujoco_warp and in Newton's MuJoCo solver. `cells`: this package's kernel, with vertical
    faces. `convex`: the general collider on one height field, for shapes unknown to `cells`; ten times slower, and steps
    become ramps."""
    threads: int = field(default=0, metadata=between(0, 1024))
    """Threads of the C engine, and of mujoco_warp's fused step on a CPU; 0 for all cores."""
