"""The part of a task that gives what differs from environment to environment to those that it concerns."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

from torch import Tensor, device

from legged.config.schema import TaskConfig
from legged.errors import ConfigError
from legged.graph.step_graph import Branch
from legged.mdp.randomization import Randomization
from legged.physics import MODEL_FIELDS, Physics, Scene, check_ranges, make_physics, row_counts
from legged.process.startup import stage_ended


class RandomizedTask:
    """A third of a task: physics whose properties differ from environment to environment."""

    cfg: TaskConfig
    num_envs: int
    device: device
    physics: Physics
    randomization: Randomization
    QUANTITIES: ClassVar[tuple[str, ...]]
    _stream_1: Branch
    _stream_2: Branch
    field_rows: dict[str, int]
    """Field that can be randomised -> how many joints, bodies or shapes have it."""

    def make_randomization(self) -> Randomization:
        """Draw what differs from environment to environment."""
        return Randomization(self.cfg.domain_rand.ranges, self.num_envs, self.device)

    def pushed_by_forces(self) -> bool:
        """Return whether forces act on bodies from outside (`physics.forces`)."""
        return False

    def _build_physics(self, scene: Scene) -> None:
        """Build the physics of a scene, and give it what was drawn."""
        cfg, where = self.cfg, self.cfg.origins.where
        fields = [name for name in self.randomization.fields if name in MODEL_FIELDS]
        check_ranges(cfg.domain_rand.ranges, scene, cfg.sim, where)
        others = (self.QUANTITIES, where, self.pushed_by_forces())
        self.physics = make_physics(scene, cfg.sim, self.num_envs, self.device, fields, *others)
        stage_ended("physics built")
        self.field_rows = row_counts(scene, self.physics.model)
        for name, draw in self.randomization.draws.items():
            if draw.each and self.field_rows[name] < 2:
                path = where(f"domain_rand.ranges.{name}.each")
                raise ConfigError(f"{path}: there is only one number of it for each robot; leave each out")
        self.randomization.widen(self.field_rows)
        self.randomization.apply(self.physics)

    def apply_randomization(self) -> None:
        """Give what was drawn to all that it concerns, when a state was put back."""
        self.randomization.apply(self.physics)

    @contextmanager
    def redrawing(self, mask: Tensor) -> Iterator[None]:
        """Draw again, beside the block, what is due, where episodes begin in the environments of `mask` (N,)."""
        if not self.randomization.redrawn:
            yield
            return
        with self._stream_1.fork():
            self.redraw(mask)
        yield
        self._stream_1.join()
        self._stream_2.join()

    def redraw(self, mask: Tensor) -> None:
        """Draw again what is randomised and due, where episodes begin in the environments of `mask` (N,); only called where
        something is drawn more than once. Runs beside `forget`.
        """
        self.randomization.redraw(mask)
        with self._stream_2.fork():
            self.randomization.rewrite(self.physics)
