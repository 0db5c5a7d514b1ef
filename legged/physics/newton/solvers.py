"""Newton's solvers, each with settings under which a quadruped of 50 kg stands and walks with time steps of 5 ms."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import newton
from newton.solvers import (
    SolverBase,
    SolverFeatherstone,
    SolverKamino,
    SolverMuJoCo,
    SolverSemiImplicit,
    SolverSteel,
    SolverXPBD,
)

from legged.config.world import SimConfig


@dataclass(frozen=True)
class SolverSetup:
    """Settings for one of Newton's solvers: its construction and its steps."""

    make: Callable[[newton.Model, SimConfig], SolverBase]
    substeps: int = 1
    """Number of solver steps in one physics step, under the same torques."""
    gap: float = 0.0
    """Distance below which shapes become candidates for contact [m]."""
    springs: tuple[float, float, float] | None = None
    """Stiffness [N/m], damping [N s/m] and friction slope [N s/m] of contacts; None if the solver's contacts are not springs.
    Unlike in MuJoCo, these three numbers are not scaled by masses. Solvers with spring contacts do not report contact forces,
    so `springs.py` computes the forces."""
    own_contacts: bool = False
    """True if the solver finds contacts itself, instead of using Newton's collision pipeline."""
    pipeline: dict[str, Any] = field(default_factory=dict)
    """Options of the collision pipeline."""
    maximal: bool = False
    """True if the solver only moves bodies. Joint angles must then be computed from the poses of bodies after a step."""
    register: Callable[[newton.ModelBuilder], None] | None = None
    """Function that adds the solver's own attributes to a builder."""

    @property
    def averages_friction(self) -> bool:
        """True if the solver averages the friction of two shapes in contact. MuJoCo uses that of the robot's shape."""
        return not self.own_contacts

    @property
    def friction_factor(self) -> float:
        """Factor on the friction of the robot's shapes. It is 2 if the solver averages friction. The ground's friction is
        then 0, so the mean is the robot's own friction. As a side effect, friction between two shapes of the robot doubles.
        """
        return 2.0 if self.averages_friction else 1.0


def _mujoco(model: newton.Model, sim: SimConfig) -> SolverMuJoCo:
    """Return the MuJoCo solver with the options that scene.py sets for C MuJoCo. Memory, iteration limits and the cone come
    from the configuration.
    """
    solver = SolverMuJoCo(
        model,
        integrator="euler",
        solver="newton",
        cone=sim.cone,
        impratio=sim.impratio,
        iterations=sim.iterations,
        ls_iterations=sim.ls_iterations,
        nconmax=sim.nconmax,
        njmax=sim.njmax,
        kinematic_switchable_roots=False,  # otherwise every robot has a weld that is never used
    )
    solver.mjw_model.opt.warn_overflow = 0  # instead of a warning from each thread, `refresh` reports overflows
    return solver


def _steel(model: newton.Model, sim: SimConfig) -> SolverSteel:
    return SolverSteel(
        model,
        enable_joint_limits=True,
        joint_limit_activation_gap=0.1,  # [rad]; by default every joint limit takes a constraint row in every step
        articulation_constraint_max=sim.njmax,
        warn_constraint_overflow=False,  # `refresh` reports overflows
    )


def _kamino(model: newton.Model, sim: SimConfig) -> SolverKamino:
    config = SolverKamino.Config(use_collision_detector=False)
    # The default tolerances are a hundred times smaller. They double the computation time, but change the standing height
    # by only a micrometre.
    config.padmm.primal_tolerance = config.padmm.dual_tolerance = config.padmm.compl_tolerance = 1e-4
    return SolverKamino(model, config)


SPRINGS = (4e4, 500.0, 2000.0)
"""Stiffness, damping and friction slope. A loaded foot of ANYmal C sinks in by 3 mm, and creeps outward at 2 cm/s, since
friction depends on sliding speed."""
FEATHERSTONE_SUBSTEPS = 32

SOLVERS = {
    "mujoco": SolverSetup(_mujoco, own_contacts=True),
    "steel": SolverSetup(_steel, gap=0.01, register=SolverSteel.register_custom_attributes),
    "kamino": SolverSetup(_kamino, gap=0.01, register=SolverKamino.register_custom_attributes),
    # With 4 or 8 substeps the feet chatter and slide apart, and the robot collapses within two seconds. The mass matrix is
    # computed once per physics step, because its computation in every substep would take nine tenths of the time.
    "featherstone": SolverSetup(
        lambda model, sim: SolverFeatherstone(model, angular_damping=0.0, update_mass_matrix_interval=FEATHERSTONE_SUBSTEPS),
        substeps=FEATHERSTONE_SUBSTEPS,
        springs=SPRINGS,
    ),
    # In this solver joints are springs, too. With their default stiffness of 1e4 N/m they give way by centimetres. With 20
    # substeps, the robot sinks to 0.41 m within a second.
    "semi_implicit": SolverSetup(
        lambda model, sim: SolverSemiImplicit(model, angular_damping=0.0, joint_attach_ke=1e5, joint_attach_kd=400.0),
        substeps=50,
        springs=SPRINGS,
        maximal=True,
    ),
    # Friction opposes only the slip of the current substep. "Sticky" contacts remember where they began. Without them feet
    # slide apart within a second, for any number of substeps and iterations. With one substep the simulation diverges.
    # With 4 substeps of 8 iterations, instead of 8 substeps of 4 iterations, shapes that penetrate the ground bounce off it,
    # and walking takes six times the power.
    "xpbd": SolverSetup(
        lambda model, sim: SolverXPBD(model, iterations=4),
        substeps=8,
        gap=0.01,
        pipeline={"contact_matching": "sticky", "contact_matching_pos_threshold": 0.005},
        maximal=True,
    ),
}
"""`sim.solver` -> its setup. With a solver that supports `gap`, contacts begin slightly before shapes touch."""
