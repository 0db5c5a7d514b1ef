"""rsl-rl's PPO whose policy stands still at first, while a new value function learns what that policy is worth."""

from collections.abc import Iterator
from contextlib import contextmanager

from legged.learning.scaled_rewards import ScaledRewards


class CriticWarmup(ScaledRewards):
    """PPO that leaves the policy, its standard deviation, its normaliser and the learning rate as they are for the next
    `warmup_left` updates. Advantages of a value function that knows nothing yet would spoil a policy that is good already.
    """

    schedule: str
    warmup_left = 0
    """Updates that change the value function alone, from now on."""

    def warming_up(self) -> bool:
        """Return whether the update that begins changes the value function alone, and count it."""
        warming = self.warmup_left > 0
        self.warmup_left -= warming
        return warming

    def update(self) -> dict[str, float]:
        """Learn from the stored rollout; returns the mean losses."""
        if not self.warming_up():
            return super().update()
        with self._policy_kept():
            return super().update()

    @contextmanager
    def _policy_kept(self) -> Iterator[None]:
        """Let rsl-rl's update in the block change the value function alone."""
        actor, schedule = self._raw_actor, self.schedule
        learned = [parameter for parameter in actor.parameters() if parameter.requires_grad]
        normalized, actor.obs_normalization = actor.obs_normalization, False  # it says whether the normaliser is updated
        self.schedule = "fixed"  # a divergence of 0, but for rounding, would raise the rate at every mini-batch
        for parameter in learned:
            parameter.requires_grad_(False)
            parameter.grad = None
        try:
            yield
        finally:
            actor.obs_normalization, self.schedule = normalized, schedule
            for parameter in learned:
                parameter.requires_grad_(True)
