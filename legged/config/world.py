"""Settings of the simulated world: robots, episodes and physics."""

from dataclasses import dataclass, field
from typing import Literal

from legged.config.bounds import LONGEST_S, between, positive, quantity
from legged.config.section import Section

NewtonSolver = Literal["mujoco", "steel", "kamino", "featherstone", "xpbd", "semi_implicit"]


@dataclass(frozen=True)
class EnvConfig(Section):
    """Number of robots, length of episodes, and seed."""

    num_envs: int = field(default=4096, metadata=between(1, 2**20))
    """Number of robots simulated in parallel on each GPU."""
    episode_length_s: float = field(default=20.0, metadata=quantity("s", positive(LONGEST_S, low=1e-5)))
    """Time-out of an episode [s]."""
    seed: int = field(default=1, metadata=between(0, 2**62))
    """Seed of the terrain and of the random numbers of torch, Python and NumPy. Physics uses none. With several GPUs, each
    process adds its rank to the seed of random numbers; the terrain is the same in all processes."""


@dataclass(frozen=True)
class SimConfig(Section):
    """Physics time step, engine and contact solver."""

    physics: Literal["auto", "mujoco_warp", "mujoco", "newton"] = "auto"
    """Physics engine: `mujoco_warp` (GPU or all CPU cores), `mujoco` (C engine, all CPU cores), `newton` (GPU or one core),
    or `auto`. On a GPU, `auto` means mujoco_warp. On a CPU, `auto` means mujoco_warp for 256 robots or more if the fused step
    supports the model, and `mujoco` in all other cases."""
    solver: NewtonSolver = "mujoco"
    """Solver of the engine `newton`; all other engines ignore this setting. The options of each solver are in
    legged/physics/newton/solvers.py; with these options a quadruped stands."""
    dt: float = field(default=0.005, metadata=quantity("s", positive(0.1, low=1e-5)))
    """Physics step [s]; the control step is `dt * control.decimation`."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """Type of friction cone. With the pyramidal cone and impratio 10, a standing ANYmal C sinks by 1 cm between 2 s and
    5 s of simulated time. The elliptic cone needs twice the computing time."""
    impratio: float = field(default=10.0, metadata=positive(1e5, low=1e-3))
    """Stiffness of a contact along the surface (friction), divided by its stiffness along the normal. With 1, loaded feet
    creep outward. With 100, the solver needs 50 or more `iterations`."""
    iterations: int = field(default=10, metadata=between(1, 10_000))
    """Largest number of iterations of the contact solver (Newton's method) per physics step."""
    ls_iterations: int = field(default=20, metadata=between(1, 10_000))
    """Largest number of line-search iterations per solver iteration."""
    step: Literal["auto", "fused", "library"] = "auto"
    """Implementation of a physics step in mujoco_warp. `library`: mujoco-warp's own code, with dozens of kernel launches.
    `fused`: four kernel launches (dynamics without contacts, contacts, contact forces, integration). Models that `fused` does
    not support are refused. `auto`: `fused` if it supports the model. Otherwise `auto` is mujoco-warp's code. For
    models with at most 60 degrees of freedom, one fused kernel computes the contact forces in this code."""
    nconmax: int = field(default=24, metadata=between(1, 10_000))
    """Number of contacts per robot for which mujoco_warp and newton allocate memory. In the collision code of mujoco-warp
    and Newton, all robots share this memory, and pairs of shapes that are close but do not touch take a part of it."""
    njmax: int = field(default=96, metadata=between(1, 10_000))
    """Number of constraint rows per robot for which mujoco_warp and Newton's solvers `mujoco` and `steel` allocate memory. In
    MuJoCo, a contact with a pyramidal friction cone takes 4 rows, and an active joint limit takes 1."""
    self_collisions: bool = False
    """Let shapes of the same robot collide, except those of neighbouring bodies."""
    terrain_collider: Literal["cells", "convex"] = "cells"
    """Collider of height maps in mujoco_warp and in Newton's MuJoCo solver. `cells`: this package's kernel; steps of
    the terrain have vertical faces. `convex`: the library's collider, for shapes that `cells` does not support, such as
    meshes. It is ten times slower, and it turns steps into ramps."""
    threads: int = field(default=0, metadata=between(0, 1024))
    """Threads of the C engine, and of mujoco_warp's fused step on a CPU; 0 for all cores."""
