"""Settings of learning: networks, PPO, distillation, length of training."""

from dataclasses import dataclass, field
from typing import Literal

from legged.config.bounds import LONGEST_S, NAME, NAMES, TERMS, UNIT, between, items, positive, quantity

HIDDEN = items(64, between(1, 16384))


@dataclass(frozen=True)
class EstimatorConfig:
    """Estimator of quantities that only the simulator knows. It reads the policy's observations, and is trained by
    supervised learning in every iteration (Ji et al., arXiv 2202.05481). The policy reads the estimates in addition to its
    observations.
    """

    targets: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Observation terms to estimate. The targets are the scaled terms without noise. An empty list means no estimator."""
    hidden_dims: tuple[int, ...] = field(default=(256, 128), metadata=HIDDEN)
    """Widths of the estimator's hidden layers."""
    learning_rate: float = field(default=1e-3, metadata=positive(1, low=1e-12))
    """Constant learning rate of the estimator."""
    latent: int = field(default=0, metadata=between(0, 16384))
    """Number of outputs in addition to the estimates. These outputs have no targets; the policy's gradient trains them."""
    policy_gradient: bool = False
    """True: the targets and the policy's gradient train the estimates. False: only the targets train them."""


@dataclass(frozen=True)
class PolicyConfig:
    """Networks of actor and critic. Unless `rnn_type` is `none`, recurrent layers come before the hidden layers."""

    actor_observations: tuple[str, ...] = field(default=("actor",), metadata=NAMES)
    """Observation groups that the policy reads, concatenated in this order."""
    critic_observations: tuple[str, ...] = field(default=("critic",), metadata=NAMES)
    """Observation groups that the value function reads, concatenated in this order. They may be the policy's groups."""
    actor_hidden_dims: tuple[int, ...] = field(default=(512, 256, 128), metadata=HIDDEN)
    """Widths of the policy's hidden layers."""
    critic_hidden_dims: tuple[int, ...] = field(default=(512, 256, 128), metadata=HIDDEN)
    """Widths of the value function's hidden layers."""
    activation: Literal["elu", "selu", "relu", "lrelu", "tanh", "sigmoid", "softplus", "gelu", "swish", "mish"] = "elu"
    """Name of the activation function in rsl-rl."""
    init_noise_std: float = field(default=1.0, metadata=positive(1000, low=1e-6))
    """Standard deviation of the actions before training."""
    min_noise_std: float = field(default=1e-6, metadata=positive(1000, low=1e-6))
    """Smallest standard deviation of the actions. A larger value keeps the policy exploring until the end of training."""
    max_noise_std: float = field(default=1e6, metadata=positive(1e6, low=1e-6))
    """Largest standard deviation of the actions."""
    noise_std_type: Literal["scalar", "log"] = "scalar"
    """Parameter that training learns for the noise: the standard deviation (`scalar`) or its logarithm (`log`)."""
    state_dependent_std: bool = False
    """Let the policy compute the standard deviation from its observations. Otherwise each action has one learned value."""
    obs_normalization: bool = False
    """Normalise observations by their running mean and variance."""
    rnn_type: Literal["none", "lstm", "gru"] = "none"
    """Type of the recurrent layers; `none` for a policy without memory. Every episode begins with a zero hidden state."""
    rnn_hidden_dim: int = field(default=256, metadata=between(1, 16384))
    """Width of a recurrent layer."""
    rnn_num_layers: int = field(default=1, metadata=between(1, 64))
    """Number of recurrent layers."""
    estimator: EstimatorConfig = EstimatorConfig()
    """Estimator whose outputs the policy reads."""


@dataclass(frozen=True)
class AlgorithmConfig:
    """Settings of PPO, mostly with rsl-rl's names. The algorithm `Distillation` uses only `optimizer` and
    `use_mixed_precision` of them. The other settings of `Distillation` are in DistillationConfig.
    """

    class_name: Literal["PPO", "Distillation"] = "PPO"
    """Learning algorithm. `PPO` learns from rewards, `Distillation` learns from a teacher (train.distillation)."""
    value_loss_coef: float = field(default=1.0, metadata=between(0, 1000))
    """Weight of the value function's error in the loss."""
    use_clipped_value_loss: bool = True
    """In the loss of the value function, clip the change of the predicted values to +/- clip_param."""
    clip_param: float = field(default=0.2, metadata=positive(100, low=1e-6))
    """The ratio (new probability of an action / old probability) is clipped between 1 - clip_param and 1 + clip_param."""
    entropy_coef: float = field(default=0.01, metadata=between(0, 100))
    """Weight of the entropy in the loss. A larger weight increases exploration."""
    num_learning_epochs: int = field(default=5, metadata=between(1, 1000))
    """Number of passes over the samples of an iteration."""
    num_mini_batches: int = field(default=4, metadata=between(1, 1_000_000))
    """Number of mini-batches in a pass over the samples. Each mini-batch gives one gradient step."""
    optimizer: Literal["adam", "adamw", "sgd", "rmsprop"] = "adam"
    """Name of the optimiser in torch."""
    learning_rate: float = field(default=1e-3, metadata=positive(1, low=1e-12))
    """Learning rate; the initial one if `schedule` is `adaptive`."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """Schedule of the learning rate: `adaptive` changes the rate to keep the KL divergence near desired_kl, `fixed`
    keeps the rate constant."""
    gamma: float = field(default=0.99, metadata=UNIT)
    """Discount of rewards, per control step."""
    lam: float = field(default=0.95, metadata=UNIT)
    """Lambda of generalised advantage estimation."""
    desired_kl: float = field(default=0.01, metadata=positive(100))
    """Target of the `adaptive` schedule: KL divergence from the policy that acted to the policy after the update."""
    max_grad_norm: float = field(default=1.0, metadata=positive(1e9))
    """Norm at which gradients are clipped."""
    reward_scale: float = field(default=1.0, metadata=positive(1e6, low=1e-9))
    """Factor by which rewards are multiplied before the learner uses them. Logs and results show unscaled rewards."""
    normalize_advantage_per_mini_batch: bool = False
    """Normalise advantages over each mini-batch; otherwise over all samples of an iteration."""
    use_mixed_precision: bool = False
    """Compute networks in bfloat16 during an update. Weights, losses and the optimiser stay in float32."""
    symmetry: bool = False
    """Learn from every sample and from its mirror image, with left and right exchanged (Mittal et al., arXiv 2403.04359)."""
    mirror_loss_coeff: float = field(default=0.0, metadata=between(0, 1000))
    """Weight of the mirror loss; 0 switches the loss off. The loss needs `symmetry`. It is the squared difference between
    the actions for the mirrored observation and the mirrored actions for the original observation."""
    critic_warmup_iterations: int = field(default=0, metadata=between(0, 1_000_000_000))
    """Number of iterations at the start of training that change only the value function. In these iterations the policy, its
    standard deviation and its normaliser stay constant. With a number above 0, `--transfer` loads only the policy. The value
    function, the optimiser and the standard deviation then start anew."""


@dataclass(frozen=True)
class DistillationConfig:
    """Settings of distillation, mostly with rsl-rl's names. A student acts, and learns the actions that its teacher would
    have taken (Ross et al., arXiv 1011.0686).
    """

    teacher: str = ""
    """Teacher: a run folder, an experiment under logs/, a checkpoint, or a task with a shipped policy. `--teacher` sets
    it."""
    loss_type: Literal["mse", "huber"] = "mse"
    """Loss on the difference between the actions of student and teacher, both without exploration. `mse`: the squared
    difference. `huber`: squared for differences up to 1, linear for larger ones."""
    gradient_length: int = field(default=8, metadata=between(1, 100_000))
    """Number of successive control steps, of all robots, from which a gradient step is computed. In a recurrent student the
    gradient flows back through all these steps. The number must divide train.runner.num_steps_per_env."""
    num_learning_epochs: int = field(default=2, metadata=between(1, 1000))
    """Number of passes over the steps of an iteration."""
    learning_rate: float = field(default=1e-3, metadata=positive(1, low=1e-12))
    """Learning rate."""
    max_grad_norm: float = field(default=1.0, metadata=positive(1e9))
    """Norm at which gradients are clipped."""


@dataclass(frozen=True)
class RunnerConfig:
    """Settings of a training run: its length, the evaluations during training, and the files that the run writes."""

    num_steps_per_env: int = field(default=24, metadata=between(1, 100_000))
    """Control steps of each robot per iteration."""
    max_iterations: int = field(default=1500, metadata=between(1, 1_000_000_000))
    """Number of iterations of the whole training. A resumed run continues up to this number."""
    save_interval: int = field(default=50, metadata=between(1, 1_000_000_000))
    """Iterations between two checkpoints."""
    evaluate_interval: int = field(default=0, metadata=between(0, 1_000_000_000))
    """Iterations between two evaluations during training; 0 for no evaluations. An evaluation measures the policy without
    exploration, on separate robots without disturbances."""
    evaluate_share: float = field(default=0.03, metadata=UNIT)
    """Largest share of the iterations' time that evaluations during training may take. Evaluations that would exceed this
    share are skipped, except the first and the last one. With a share of 1, no evaluation is skipped."""
    evaluate_envs: int = field(default=256, metadata=between(1, 2**20))
    """Largest number of robots in an evaluation during training. In a task with commands, each robot follows one
    command of the task's grid (evaluation.vx, vy and yaw)."""
    evaluate_s: float = field(default=0.0, metadata=quantity("s", between(0, LONGEST_S)))
    """Simulated time of an evaluation during training [s]. 0 means 3 s or, in tasks without commands, a whole episode."""
    best_by: str = ""
    """Name of the evaluation result that selects model_best.pt. Empty means `lin_vel_rmse`, or, in tasks without commands,
    `return`."""
    stop_at: dict[str, float] = field(default_factory=dict, metadata=between(-1e12, 1e12))
    """Name of an evaluation result -> target of this result. Training ends when all targets are reached. `falls` and results
    whose names end in _rmse must be at most their targets; all other results must be at least their targets."""
    loop: Literal["stock", "captured"] = "captured"
    """Training loop. `stock`: rsl-rl's own loop. `captured`: the same arithmetic in a loop that runs as CUDA graphs on a GPU.
    If `captured` does not support the networks or the algorithm, a message says so, and `stock` runs."""
    matmul: Literal["float32", "tf32"] = "tf32"
    """Precision of matrix products during training. On a GPU `tf32` is faster, but keeps only 10 of the 23 mantissa bits of
    the factors. On a CPU `tf32` keeps all bits, and allows a faster library (oneDNN)."""
    experiment_name: str = field(default="", metadata=NAME)
    """Name of the folder under logs/. If it is empty, the folder has the task's name."""
    run_name: str = field(default="", metadata=NAME)
    """Text after the date and time in the name of the run folder."""
    report: bool = True
    """Write report.html and report.md into the run folder when a training ends, in another process."""
    film: bool = True
    """Record a film of the final policy for the report. The recording takes about ten seconds. There is no film if training
    was stopped early, or if the machine cannot render."""
    logger: str = "tensorboard"
    """Tracker that logs in addition to TensorBoard: `wandb`, `neptune`, or `module:Class`, a subclass of rsl-rl's LogWriter.
    `tensorboard` means no additional tracker."""
    logger_project: str = field(default="", metadata=NAME)
    """Name of the project in the tracker. If it is empty, the project has the name of the folder under logs/."""


@dataclass(frozen=True)
class TrainConfig:
    """Settings of the learner."""

    policy: PolicyConfig = PolicyConfig()
    """Networks of the policy and the value function."""
    algorithm: AlgorithmConfig = AlgorithmConfig()
    """Learning algorithm and settings of PPO."""
    distillation: DistillationConfig = DistillationConfig()
    """Settings of distillation."""
    runner: RunnerConfig = RunnerConfig()
    """Settings of the training run: length, evaluations, checkpoints and names of folders."""
