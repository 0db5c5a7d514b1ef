"""Physics of a task with randomised properties, which can be drawn anew during a step."""

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
    """Mixin of BaseTask: physics whose properties differ from environment to environment."""

    cfg: TaskConfig
    num_envs: int
    device: device
    physics: Physics
    randomization: Randomization
    QUANTITIES: ClassVar[tuple[str, ...]]
    _stream_1: Branch
    _stream_2: Branch
    field_rows: dict[str, int]
    """Field that can be randomised -> number of joints, bodies or shapes that have it."""

    def make_randomization(self) -> Randomization:
        """Return the randomised properties, drawn for every environment."""
        return Randomization(self.cfg.domain_rand.ranges, self.num_envs, self.device)

    def pushed_by_forces(self) -> bool:
        """Return True if external forces act on bodies (`physics.forces`)."""
        return False

    def _build_physics(self, scene: Scene) -> None:
        """Build the physics of a scene, and apply the randomised properties.

        Raises:
            ConfigError: the engine or the model lacks a randomised property, or `each` is set for a property of which a robot
                has only one value.
        """
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
                raise ConfigError(f"{path}: a robot has only one value of this property; remove the setting `each`")
        self.randomization.widen(self.field_rows)
        self.randomization.apply(self.physics)

    def apply_randomization(self) -> None:
        """Apply the randomised properties again, after a saved state was loaded."""
        self.randomization.apply(self.physics)

    @contextmanager
    def redrawing(self, mask: Tensor) -> Iterator[None]:
        """Run `redraw` on another stream, in parallel with the body of the `with` statement. `mask` (N,) is True where an
        episode begins.
        """
        if not self.randomization.redrawn:
            yield
            return
        with self._stream_1.fork():
            self.redraw(mask)
        yield
        self._stream_1.join()
        self._stream_2.join()

    def redraw(self, mask: Tensor) -> None:
        """Hook: give new values to randomised properties, at resets (where `mask` (N,) is True) and when an interval has
        elapsed. The hook is called only if a property has `when: reset` or `interval`. It runs at the same time as `forget`.
        """
        self.randomization.redraw(mask)
        with self._stream_2.fork():
            self.randomization.rewrite(self.physics)
