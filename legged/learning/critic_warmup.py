"""rsl-rl's PPO with a warm-up, during which the policy is frozen and a new value function learns the policy's returns."""

from collections.abc import Iterator
from contextlib import contextmanager

from legged.learning.scaled_rewards import ScaledRewards


class CriticWarmup(ScaledRewards):
    """PPO that freezes the policy, its standard deviation, its normaliser and the learning rate for the next `warmup_left`
    updates. Advantages computed with an untrained value function would spoil a policy that is already good.
    """

    schedule: str
    warmup_left = 0
    """Number of coming updates that change the value function alone."""

    def warming_up(self) -> bool:
        """Return True if the next update is a warm-up update, and reduce `warmup_left` by 1 in this case."""
        warming = self.warmup_left > 0
        self.warmup_left -= warming
        return warming

    def update(self) -> dict[str, float]:
        """Learn from the stored rollout and return the mean losses."""
        if not self.warming_up():
            return super().update()
        with self._policy_kept():
            return super().update()

    @contextmanager
    def _policy_kept(self) -> Iterator[None]:
        """Freeze the policy within a `with` block, so that rsl-rl's update changes the value function alone."""
        actor, schedule = self._raw_actor, self.schedule
        learned = [parameter for parameter in actor.parameters() if parameter.requires_grad]
        normalized, actor.obs_normalization = actor.obs_normalization, False  # with False, the normaliser stays as it is
        self.schedule = "fixed"  # the divergence is 0 up to rounding, so the adaptive rate would rise at every mini-batch
        for parameter in learned:
            parameter.requires_grad_(False)
            parameter.grad = None
        try:
            yield
        finally:
            actor.obs_normalization, self.schedule = normalized, schedule
            for parameter in learned:
                parameter.requires_grad_(True)
