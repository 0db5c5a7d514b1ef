"""Which observations the networks read, and what they ask of the rest of a configuration."""

from legged.config.schema import TaskConfig
from legged.errors import ConfigError, suggest

NETWORKS = ("actor", "critic")


def groups_of(cfg: TaskConfig, network: str) -> tuple[str, ...]:
    """Return the names of the groups that `actor` or `critic` reads, in order."""
    return getattr(cfg.train.policy, f"{network}_observations")


def check_networks(cfg: TaskConfig) -> None:
    """Compare the networks with the observations, with each other's settings and with the learner.

    Raises:
        ConfigError: they read a group that there is not, the bounds of the standard deviation leave out its start, a mirror
            loss comes without symmetry, or a recurrent policy with what it can't learn from.
    """
    policy, algorithm, origins = cfg.train.policy, cfg.train.algorithm, cfg.origins
    known = cfg.observations.groups
    for network in NETWORKS:
        for name in groups_of(cfg, network):
            if name not in known:
                where = origins.where(f"train.policy.{network}_observations")
                raise ConfigError(f"{where}: there is no observation group '{name}'{suggest(name, known, 'groups')}")
    least, largest = policy.min_noise_std, policy.max_noise_std
    if not least <= policy.init_noise_std <= largest:
        bounds = " and ".join(
            f"train.policy.{name}={value:g} ({origins.of(f'train.policy.{name}')})"
            for name, value in (("min_noise_std", least), ("max_noise_std", largest))
        )
        where, given = origins.where("train.policy.init_noise_std"), policy.init_noise_std
        raise ConfigError(f"{where}: must lie between {bounds}, got {given:g}")
    if algorithm.mirror_loss_coeff > 0.0 and not algorithm.symmetry:
        where = origins.where("train.algorithm.mirror_loss_coeff")
        raise ConfigError(f"{where}: must be 0 without mirror images; train.algorithm.symmetry=true")
    if policy.rnn_type != "none":
        _check_recurrent(cfg)


def _check_recurrent(cfg: TaskConfig) -> None:
    """Compare a recurrent policy with the learner's settings.

    Raises:
        ConfigError: it can't learn from mirror images, nor from fewer robots than mini-batches.
    """
    kind, algorithm, origins = cfg.train.policy.rnn_type, cfg.train.algorithm, cfg.origins
    recurrent = f"a recurrent policy (train.policy.rnn_type={kind}, {origins.of('train.policy.rnn_type')})"
    if algorithm.symmetry:
        where = origins.where("train.algorithm.symmetry")
        raise ConfigError(f"{where}: {recurrent} can't learn from mirror images; train.algorithm.symmetry=false")
    if algorithm.num_mini_batches > cfg.env.num_envs:
        where, given = origins.where("train.algorithm.num_mini_batches"), algorithm.num_mini_batches
        raise ConfigError(
            f"{where}: {recurrent} learns from whole robots: must be at most env.num_envs={cfg.env.num_envs}, got {given}"
        )
