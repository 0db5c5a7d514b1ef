"""Observation groups of the networks, and checks of the networks against the rest of a configuration."""

from legged.config.schema import ObservationGroupConfig, TaskConfig
from legged.errors import ConfigError, suggest

NETWORKS = ("actor", "critic")
ESTIMATED = "estimated"
"""Name of the observation group with an estimator's targets."""


def groups_of(cfg: TaskConfig, network: str) -> tuple[str, ...]:
    """Return the names of the groups that `actor` or `critic` reads, in order."""
    return getattr(cfg.train.policy, f"{network}_observations")


def groups_in(cfg: TaskConfig) -> dict[str, ObservationGroupConfig]:
    """Return all observation groups of a task: those that the configuration names, and the targets of an estimator."""
    targets = cfg.train.policy.estimator.targets
    return {**cfg.observations.groups, **({ESTIMATED: ObservationGroupConfig(targets)} if targets else {})}


def path_of_terms(cfg: TaskConfig, group: str) -> str:
    """Return the dotted path of the setting that lists the terms of an observation group."""
    is_targets = group == ESTIMATED and bool(cfg.train.policy.estimator.targets)
    return "train.policy.estimator.targets" if is_targets else f"observations.groups.{group}.terms"


def learns_from_teacher(cfg: TaskConfig) -> bool:
    """Return True if a policy is a student that learns from a teacher."""
    return cfg.train.algorithm.class_name == "Distillation"


def check_networks(cfg: TaskConfig) -> None:
    """Check that the networks fit the observations, each other and the learner.

    Raises:
        ConfigError: a network reads an unknown group; the initial standard deviation is out of bounds; a mirror loss is set
            without `symmetry`; or a setting does not work with a recurrent policy, an estimator or a student.
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
    if learns_from_teacher(cfg):
        _check_student(cfg)
        return
    if algorithm.mirror_loss_coeff > 0.0 and not algorithm.symmetry:
        where = origins.where("train.algorithm.mirror_loss_coeff")
        raise ConfigError(f"{where}: must be 0 without mirror images; train.algorithm.symmetry=true adds them")
    _check_estimator(cfg)
    if policy.rnn_type != "none":
        _check_recurrent(cfg)


def _check_estimator(cfg: TaskConfig) -> None:
    """Check an estimator against the other settings.

    Raises:
        ConfigError: the estimator has latent outputs but no targets; an observation group has the name that is reserved for
            the targets; or a setting needs rsl-rl's own update, which cannot train an estimator.
    """
    policy, algorithm, origins = cfg.train.policy, cfg.train.algorithm, cfg.origins
    path = "train.policy.estimator.targets"
    if not policy.estimator.targets:
        if policy.estimator.latent:
            where = origins.where("train.policy.estimator.latent")
            raise ConfigError(f"{where}: must be 0 without an estimator; {path}=[base_lin_vel] adds one")
        return
    if ESTIMATED in cfg.observations.groups:
        where = origins.where(f"observations.groups.{ESTIMATED}")
        raise ConfigError(f"{where}: '{ESTIMATED}' is the group of the estimator's targets ({path}); rename your group")
    for field, value, wanted in (
        ("train.policy.rnn_type", policy.rnn_type, "none"),
        ("train.policy.state_dependent_std", policy.state_dependent_std, False),
        ("train.algorithm.optimizer", algorithm.optimizer, "adam"),
        ("train.algorithm.mirror_loss_coeff", algorithm.mirror_loss_coeff, 0),
        ("train.runner.loop", cfg.train.runner.loop, "captured"),
    ):
        if value != wanted:
            given, needed = (str(each).lower() if isinstance(each, bool) else f"{each}" for each in (value, wanted))
            raise ConfigError(
                f"{origins.where(field)}: must be {needed} with an estimator ({path}, {origins.of(path)}), got {given}"
            )


def _check_student(cfg: TaskConfig) -> None:
    """Check a student against the settings of distillation.

    Raises:
        ConfigError: the student has a learned standard deviation or an estimator, or `gradient_length` does not divide the
            number of steps of an iteration.
    """
    policy, origins = cfg.train.policy, cfg.origins
    if policy.state_dependent_std:
        where = origins.where("train.policy.state_dependent_std")
        raise ConfigError(f"{where}: must be false, because a student learns only the mean of the actions")
    if policy.estimator.targets:
        where = origins.where("train.policy.estimator.targets")
        raise ConfigError(f"{where}: must be [], because a student can't train an estimator")
    length, steps = cfg.train.distillation.gradient_length, cfg.train.runner.num_steps_per_env
    if steps % length:
        where = origins.where("train.distillation.gradient_length")
        given = f"train.runner.num_steps_per_env={steps} ({origins.of('train.runner.num_steps_per_env')})"
        nearest = min((n for n in range(1, steps + 1) if steps % n == 0), key=lambda n: abs(n - length))
        raise ConfigError(f"{where}: must divide {given}, got {length} (nearest divisor: {nearest})")


def _check_recurrent(cfg: TaskConfig) -> None:
    """Check a recurrent policy against the settings of the learner.

    Raises:
        ConfigError: symmetry is on, or there are fewer robots than mini-batches.
    """
    kind, algorithm, origins = cfg.train.policy.rnn_type, cfg.train.algorithm, cfg.origins
    recurrent = f"a recurrent policy (train.policy.rnn_type={kind}, {origins.of('train.policy.rnn_type')})"
    if algorithm.symmetry:
        where = origins.where("train.algorithm.symmetry")
        raise ConfigError(f"{where}: {recurrent} can't learn from mirror images; set train.algorithm.symmetry=false")
    if algorithm.num_mini_batches > cfg.env.num_envs:
        where, given = origins.where("train.algorithm.num_mini_batches"), algorithm.num_mini_batches
        raise ConfigError(
            f"{where}: must be at most env.num_envs={cfg.env.num_envs}, because {recurrent} splits mini-batches by robot;"
            f" got {given}"
        )
