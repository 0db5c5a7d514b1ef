"""Newton's solvers, each with settings under which a quadruped of 50 kg stands and walks at steps of 5 ms."""

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

from legged.config.schema import SimConfig


@dataclass(frozen=True)
class SolverSetup:
    """How one of Newton's solvers is built and stepped."""

    make: Callable[[newton.Model, SimConfig], SolverBase]
    substeps: int = 1
    """Steps of the solver in one physics step, under the same torques."""
    gap: float = 0.0
    """Distance at which shapes become candidates for contact [m]."""
    springs: tuple[float, float, float] | None = None
    """Stiffness [N/m], damping [N s/m] and slope of friction [N s/m] of contacts, for a solver that makes them of springs,
    as they are and not scaled by masses as in MuJoCo. Such a solver does not report forces: they are computed here."""
    own_contacts: bool = False
    """It finds contacts itself, in place of Newton's collision pipeline."""
    pipeline: dict[str, Any] = field(default_factory=dict)
    """Options of the collision pipeline."""
    maximal: bool = False
    """It moves bodies only; joint angles are computed from them after a step."""
    register: Callable[[newton.ModelBuilder], None] | None = None
    """Adds the solver's own attributes to a builder."""

    @property
    def averages_friction(self) -> bool:
        """It takes the mean of the two shapes' friction, where MuJoCo takes the robot's, which has priority."""
        return not self.own_contacts

    @property
    def friction_factor(self) -> float:
        """What the robot's friction is multiplied by, the ground's being 0, so that their mean is the robot's own. Where
        its shapes touch each other, that doubles it.
        """
        return 2.0 if self.averages_friction else 1.0


def _mujoco(model: newton.Model, sim: SimConfig) -> SolverMuJoCo:
    """The options that scene.py gives C MuJoCo. Memory, the caps of the solver, and the cone are the task's."""
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
        kinematic_switchable_roots=False,  # else every robot carries a weld that is never used
    )
    solver.mjw_model.opt.warn_overflow = 0  # counted in refresh instead of printed by each thread
    return solver


def _steel(model: newton.Model, sim: SimConfig) -> SolverSteel:
    return SolverSteel(
        model,
        enable_joint_limits=True,
        joint_limit_activation_gap=0.1,  # [rad]; by default every limit of every joint takes a row in every step
        articulation_constraint_max=sim.njmax,
        warn_constraint_overflow=False,  # counted in refresh
    )


def _kamino(model: newton.Model, sim: SimConfig) -> SolverKamino:
    config = SolverKamino.Config(use_collision_detector=False)
    # A hundred times as fine, as by default, takes twice as long and changes the standing height by a micrometre.
    config.padmm.primal_tolerance = config.padmm.dual_tolerance = config.padmm.compl_tolerance = 1e-4
    return SolverKamino(model, config)


SPRINGS = (4e4, 500.0, 2000.0)
"""A loaded foot of ANYmal C sinks in by 3 mm, and creeps outward by 2 cm/s: friction acts on sliding only."""
FEATHERSTONE_SUBSTEPS = 32

SOLVERS = {
    "mujoco": SolverSetup(_mujoco, own_contacts=True),
    "steel": SolverSetup(_steel, gap=0.01, register=SolverSteel.register_custom_attributes),
    "kamino": SolverSetup(_kamino, gap=0.01, register=SolverKamino.register_custom_attributes),
    # With 4 or 8 substeps the feet chatter and slide apart, and the robot lies down within two seconds. The mass matrix is
    # that of the physics step: built in every substep it takes nine tenths of the time.
    "featherstone": SolverSetup(
        lambda model, sim: SolverFeatherstone(model, angular_damping=0.0, update_mass_matrix_interval=FEATHERSTONE_SUBSTEPS),
        substeps=FEATHERSTONE_SUBSTEPS,
        springs=SPRINGS,
    ),
    # Bodies hang together by springs too: at the default of 1e4 N/m the robot sags in them by centimetres, and with 20
    # substeps it sinks to 0.41 m within a second.
    "semi_implicit": SolverSetup(
        lambda model, sim: SolverSemiImplicit(model, angular_damping=0.0, joint_attach_ke=1e5, joint_attach_kd=400.0),
        substeps=50,
        springs=SPRINGS,
        maximal=True,
    ),
    # Friction acts against slip within a substep only: without contacts that remember where they began ("sticky") the robot
    # does the splits within a second, whatever the substeps and iterations. With one substep it blows up; with 4 x 8 instead
    # of 8 x 4 what is pushed out of the ground leaves it with a hop, and walking takes six times the power.
    "xpbd": SolverSetup(
        lambda model, sim: SolverXPBD(model, iterations=4),
        substeps=8,
        gap=0.01,
        pipeline={"contact_matching": "sticky", "contact_matching_pos_threshold": 0.005},
        maximal=True,
    ),
}
"""`sim.solver` -> its setup. Contacts begin a little before touching where a solver can use that (gap)."""
