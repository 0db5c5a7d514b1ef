"""What a recurrent policy asks of the rest of a configuration."""

from legged.config.schema import TaskConfig
from legged.errors import ConfigError


def check_recurrent(cfg: TaskConfig) -> None:
    """Compare a recurrent policy with the learner's settings.

    Raises:
        ConfigError: it can't learn from mirror images, nor from fewer robots than mini-batches.
    """
    kind, algorithm, origins = cfg.train.policy.rnn_type, cfg.train.algorithm, cfg.origins
    if kind == "none":
        return
    recurrent = f"a recurrent policy (train.policy.rnn_type={kind}, {origins.of('train.policy.rnn_type')})"
    if algorithm.symmetry:
        where = origins.where("train.algorithm.symmetry")
        raise ConfigError(f"{where}: {recurrent} can't learn from mirror images; train.algorithm.symmetry=false")
    if algorithm.num_mini_batches > cfg.env.num_envs:
        where, given = origins.where("train.algorithm.num_mini_batches"), algorithm.num_mini_batches
        raise ConfigError(
            f"{where}: {recurrent} learns from whole robots: must be at most env.num_envs={cfg.env.num_envs}, got {given}"
        )
