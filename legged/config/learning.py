"""How a policy is trained: networks, PPO, length of training."""

from dataclasses import dataclass, field
from typing import Literal

from legged.config.bounds import LONGEST_S, NAME, NAMES, TERMS, UNIT, between, items, positive, quantity

HIDDEN = items(64, between(1, 16384))


@dataclass(frozen=True)
class EstimatorConfig:
    """First part of a policy: it estimates what only the simulator knows from what the policy observes, and is trained by
    supervision in every iteration (Ji et al., arXiv 2202.05481). The policy is given the estimates beside its observations.
    """

    targets: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Observation terms that are estimated, scaled and without noise; without any there is no estimator."""
    hidden_dims: tuple[int, ...] = field(default=(256, 128), metadata=HIDDEN)
    """Widths of the estimator's hidden layers."""
    learning_rate: float = field(default=1e-3, metadata=positive(1, low=1e-12))
    """Step size of the optimiser for the estimator; it stays as it is."""
    latent: int = field(default=0, metadata=between(0, 16384))
    """Outputs beside the estimates, which no target trains: the policy's gradient does, and the hidden layers with them."""
    policy_gradient: bool = False
    """The policy's gradient trains the estimates too; otherwise the targets alone do."""


@dataclass(frozen=True)
class PolicyConfig:
    """Networks of actor and critic: layers, before them `rnn_num_layers` recurrent ones if `rnn_type` says which kind."""

    actor_observations: tuple[str, ...] = field(default=("actor",), metadata=NAMES)
    """Observation groups that the policy reads, side by side in this order."""
    critic_observations: tuple[str, ...] = field(default=("critic",), metadata=NAMES)
    """Observation groups that the value function reads; those of the policy, if both are to see the same."""
    actor_hidden_dims: tuple[int, ...] = field(default=(512, 256, 128), metadata=HIDDEN)
    """Widths of the policy's hidden layers."""
    critic_hidden_dims: tuple[int, ...] = field(default=(512, 256, 128), metadata=HIDDEN)
    """Widths of the value function's hidden layers."""
    activation: Literal["elu", "selu", "relu", "lrelu", "tanh", "sigmoid", "softplus", "gelu", "swish", "mish"] = "elu"
    """Activation function, by rsl-rl's names."""
    init_noise_std: float = field(default=1.0, metadata=positive(1000, low=1e-6))
    """Standard deviation of the actions before training."""
    min_noise_std: float = field(default=1e-6, metadata=positive(1000, low=1e-6))
    """Least standard deviation of the actions; it keeps exploration up where the entropy would collapse."""
    max_noise_std: float = field(default=1e6, metadata=positive(1e6, low=1e-6))
    """Largest standard deviation of the actions."""
    noise_std_type: Literal["scalar", "log"] = "scalar"
    """What is learned: the standard deviation itself, or its logarithm."""
    state_dependent_std: bool = False
    """The policy gives the standard deviation with the actions, for each state; otherwise it is one number an action."""
    obs_normalization: bool = False
    """Normalise observations by running mean and variance."""
    rnn_type: Literal["none", "lstm", "gru"] = "none"
    """Kind of recurrent layers, whose memory lasts an episode; `none` for a policy that sees the present only."""
    rnn_hidden_dim: int = field(default=256, metadata=between(1, 16384))
    """Width of a recurrent layer."""
    rnn_num_layers: int = field(default=1, metadata=between(1, 64))
    """Recurrent layers, one on top of the other."""
    estimator: EstimatorConfig = EstimatorConfig()
    """What the policy estimates before it acts."""


@dataclass(frozen=True)
class AlgorithmConfig:
    """PPO, by rsl-rl's names. Distillation has a section of its own, and of this one `optimizer`, `use_mixed_precision`."""

    class_name: Literal["PPO", "Distillation"] = "PPO"
    """`PPO` learns from rewards; `Distillation` learns to act as a teacher would: train.distillation."""
    value_loss_coef: float = field(default=1.0, metadata=between(0, 1000))
    """Weight of the value function's error in the loss."""
    use_clipped_value_loss: bool = True
    """Clip the change of the value function by clip_param, as that of the policy."""
    clip_param: float = field(default=0.2, metadata=positive(100, low=1e-6))
    """How far the ratio of new to old probability may leave 1 before it is clipped."""
    entropy_coef: float = field(default=0.01, metadata=between(0, 100))
    """Weight of the entropy in the loss: a larger one keeps exploration up."""
    num_learning_epochs: int = field(default=5, metadata=between(1, 1000))
    """Passes over the samples of an iteration."""
    num_mini_batches: int = field(default=4, metadata=between(1, 1_000_000))
    """Parts into which the samples are split; each gives one step of the optimiser."""
    optimizer: Literal["adam", "adamw", "sgd", "rmsprop"] = "adam"
    """Rule by which gradients change the weights, by torch's names."""
    learning_rate: float = field(default=1e-3, metadata=positive(1, low=1e-12))
    """Step size of the optimiser; where `adaptive` starts from."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """`adaptive` changes the learning rate so that the policy changes by desired_kl; `fixed` leaves it."""
    gamma: float = field(default=0.99, metadata=UNIT)
    """Discount of rewards, per control step."""
    lam: float = field(default=0.95, metadata=UNIT)
    """Lambda of generalised advantage estimation."""
    desired_kl: float = field(default=0.01, metadata=positive(100))
    """KL divergence between two policies in a row that `adaptive` aims at."""
    max_grad_norm: float = field(default=1.0, metadata=positive(1e9))
    """Norm at which gradients are clipped."""
    reward_scale: float = field(default=1.0, metadata=positive(1e6, low=1e-9))
    """Factor on rewards before they are learned from; it is the learner's alone, and shows in no log or result."""
    normalize_advantage_per_mini_batch: bool = False
    """Normalise advantages over each mini-batch; otherwise over all samples of an iteration."""
    use_mixed_precision: bool = False
    """Networks compute in bfloat16 while they learn; weights, losses and the optimiser stay float32."""
    symmetry: bool = False
    """Learn from every sample also as its mirror image, left for right (Mittal et al., arXiv 2403.04359)."""
    mirror_loss_coeff: float = field(default=0.0, metadata=between(0, 1000))
    """Weight, with symmetry, of a loss for actions that differ from the mirrored ones of the mirror image; 0 for none."""
    critic_warmup_iterations: int = field(default=0, metadata=between(0, 1_000_000_000))
    """Iterations at the start in which the value function learns alone: the policy stays as it is, with its std and its
    normaliser. `--transfer` takes the policy alone then; value function, optimiser and std are new."""


@dataclass(frozen=True)
class DistillationConfig:
    """How a student learns from a teacher, by rsl-rl's names: the student acts, and learns what the teacher would have done
    (Ross et al., arXiv 1011.0686).
    """

    teacher: str = ""
    """Run folder, experiment under logs/, checkpoint, or task whose shipped policy is the teacher; `--teacher` sets it."""
    loss_type: Literal["mse", "huber"] = "mse"
    """Loss of the difference between the student's mean action and the teacher's: squared, or beyond 1 linear."""
    gradient_length: int = field(default=8, metadata=between(1, 100_000))
    """Control steps of all robots from which one step of the optimiser is made, and through which the gradient of a recurrent
    student goes back; a divisor of train.runner.num_steps_per_env."""
    num_learning_epochs: int = field(default=2, metadata=between(1, 1000))
    """Passes over the steps of an iteration."""
    learning_rate: float = field(default=1e-3, metadata=positive(1, low=1e-12))
    """Step size of the optimiser."""
    max_grad_norm: float = field(default=1.0, metadata=positive(1e9))
    """Norm at which gradients are clipped."""


@dataclass(frozen=True)
class RunnerConfig:
    """Length of training and what it writes."""

    num_steps_per_env: int = field(default=24, metadata=between(1, 100_000))
    """Control steps per robot and iteration."""
    max_iterations: int = field(default=1500, metadata=between(1, 1_000_000_000))
    """Iterations of the whole training; a resumed run goes on up to this number."""
    save_interval: int = field(default=50, metadata=between(1, 1_000_000_000))
    """Iterations between two checkpoints."""
    evaluate_interval: int = field(default=0, metadata=between(0, 1_000_000_000))
    """Iterations between two evaluations during training: of the policy without its exploration, on robots of their own,
    which nothing disturbs; 0 for none."""
    evaluate_share: float = field(default=0.03, metadata=UNIT)
    """Most of the time in iterations that these evaluations may take: one that would exceed it is left out. The first and the
    last never are; 1 leaves out none."""
    evaluate_envs: int = field(default=256, metadata=between(1, 2**20))
    """Robots of an evaluation during training, at most; the commands of the task's grid are shared out among them."""
    evaluate_s: float = field(default=0.0, metadata=quantity("s", between(0, LONGEST_S)))
    """Simulated time of an evaluation during training [s]; 0 takes 3 s, and a whole episode of tasks without commands."""
    best_by: str = ""
    """Figure of the evaluations during training by which model_best.pt is kept; lin_vel_rmse when empty, and the return of
    tasks without commands."""
    stop_at: dict[str, float] = field(default_factory=dict, metadata=between(-1e12, 1e12))
    """Figure of the evaluations during training -> value; training ends as soon as all are reached. Those that end in _rmse,
    and falls, must come down to it, others up."""
    loop: Literal["stock", "captured"] = "captured"
    """`captured`: rsl-rl's arithmetic without the host in between, on a GPU as CUDA graphs; it falls back to `stock` where
    networks or algorithm need that, and says why. `stock`: rsl-rl's own training loop."""
    matmul: Literal["float32", "tf32"] = "tf32"
    """Matrix products of the networks while training. On a GPU `tf32` keeps 10 of the factors' 23 bits, which is faster; on a
    CPU it takes the fastest library that keeps them all."""
    experiment_name: str = field(default="", metadata=NAME)
    """Folder under logs/; the task's name when empty."""
    run_name: str = field(default="", metadata=NAME)
    """Appended to the run folder's date and time."""
    report: bool = True
    """Write report.html and report.md into the run folder when a training ends."""
    film: bool = True
    """Film the last policy for the report of a training that came to its end, if pictures can be drawn: some ten seconds."""
    logger: str = "tensorboard"
    """Where training is logged beside TensorBoard: `tensorboard` for nowhere, `wandb`, `neptune`, or module:Class of a writer
    that extends rsl-rl's LogWriter."""
    logger_project: str = field(default="", metadata=NAME)
    """Project there; the folder under logs/ when empty."""


@dataclass(frozen=True)
class TrainConfig:
    """Everything the learner needs."""

    policy: PolicyConfig = PolicyConfig()
    """Networks."""
    algorithm: AlgorithmConfig = AlgorithmConfig()
    """Settings of PPO, and which algorithm it is."""
    distillation: DistillationConfig = DistillationConfig()
    """Settings of distillation."""
    runner: RunnerConfig = RunnerConfig()
    """Length of training, checkpoints and names."""
