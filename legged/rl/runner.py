"""rsl-rl's OnPolicyRunner with what it leaves out: task state in checkpoints, safe files, a clean stop."""

import contextlib
import io
import time
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.utils.logger import Logger
from torch.utils.tensorboard import SummaryWriter

from legged.config import TaskConfig
from legged.envs import BaseTask, LeggedRobot
from legged.errors import ConfigError
from legged.ranks import Ranks
from legged.rl.checkpoint import describe_mismatch, observation_layout, read_checkpoint, write_checkpoint
from legged.rl.display import Display, Progress
from legged.rl.distributed import RankLost, any_rank, join, leave
from legged.rl.symmetry import MirrorImages, augment
from legged.startup import STARTED_S


class Interrupted(Exception):
    """Training was asked to stop; raised at the end of an iteration, when networks and optimiser agree."""


def runner_config(cfg: TaskConfig, algorithm_class: str) -> dict[str, Any]:
    """The dictionary rsl-rl wants."""
    policy, runner = cfg.train.policy, cfg.train.runner
    settings = dict(vars(cfg.train.algorithm))
    if settings.pop("symmetry"):
        settings["symmetry_cfg"] = {"data_augmentation_func": augment, "use_data_augmentation": True}
    shared = {
        "class_name": "MLPModel",
        "activation": policy.activation,
        "obs_normalization": policy.obs_normalization,
    }
    if policy.rnn_type != "none":
        shared["class_name"] = "RNNModel"
        shared |= {name: getattr(policy, name) for name in ("rnn_type", "rnn_hidden_dim", "rnn_num_layers")}
    return {
        "num_steps_per_env": runner.num_steps_per_env,
        "save_interval": runner.save_interval,
        "run_name": runner.run_name,
        "logger": "tensorboard",
        "check_for_nan": False,  # it would wait for the GPU at every step; the task terminates and counts such robots
        "obs_groups": {"actor": ["actor"], "critic": ["critic"]},
        "actor": {
            **shared,
            "hidden_dims": list(policy.actor_hidden_dims),
            "distribution_cfg": {
                "class_name": "GaussianDistribution",
                "init_std": policy.init_noise_std,
                "std_type": "scalar",
            },
        },
        "critic": {**shared, "hidden_dims": list(policy.critic_hidden_dims)},
        "algorithm": {"class_name": algorithm_class, **settings},
    }


class QuietLogger(Logger):
    """rsl-rl's logger, writing to TensorBoard as ever but handing the console to our display."""

    def __init__(self, *args: Any, display: Display | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.display = display
        self.stop_requested = False
        self.loop_s = 0.0
        """Time spent in iterations so far, this process [s]."""
        self.latest: dict[str, float] = {}
        """The last value of everything the task logs; an iteration in which no episode ended has no episode means."""

    @property
    def steps_per_iteration(self) -> int:
        """Steps of all robots, on all GPUs."""
        return self.cfg["num_steps_per_env"] * self.num_envs * self.gpu_world_size

    def _store_code_state(self) -> list[str]:
        """Nothing: the run folder holds the state of this code already, see runs.code_state."""
        return []

    def stop_logging_writer(self) -> None:
        """Also end TensorBoard's writer and its thread, which rsl-rl leaves open."""
        super().stop_logging_writer()
        if isinstance(self.writer, SummaryWriter):
            self.writer.close()

    def log(self, it: int, start_it: int, total_it: int, collect_time: float, learn_time: float, **kwargs: Any) -> None:
        """Write one iteration, show it, and stop if that was asked for, of any process."""
        # An episode mean has no value (NaN) in a rollout in which none ended; leave it out rather than write NaN.
        values: dict[str, float] = {}
        for entry in self.ep_extras:
            stacked = torch.stack([value.reshape(()) for value in entry.values()]).tolist()  # one transfer, not twenty
            values.update({key: value for key, value in zip(entry, stacked, strict=True) if value == value})
        self.ep_extras[:] = [dict(values)] if values else []  # a copy: rsl-rl puts tensors in
        with contextlib.redirect_stdout(io.StringIO()):
            super().log(it, start_it, total_it, collect_time, learn_time, **kwargs)
        self.latest.update(values)
        self.loop_s += collect_time + learn_time
        if self.display is not None:
            self.display.show(
                Progress(
                    iteration=it + 1,
                    total=total_it,
                    elapsed_s=self.loop_s,
                    eta_s=self.loop_s / (it + 1 - start_it) * (total_it - it - 1),
                    steps_per_s=self.steps_per_iteration / (collect_time + learn_time),
                    collect_s=collect_time,
                    learn_s=learn_time,
                    reward=sum(self.rewbuffer) / len(self.rewbuffer) if self.rewbuffer else float("nan"),
                    action_std=float(kwargs["action_std"].detach().mean()),
                    values=dict(self.latest),
                )
            )
        if any_rank(self.stop_requested, torch.device(self.device)) and it + 1 < total_it:
            raise Interrupted


class Runner(OnPolicyRunner):
    """Trains a task with rsl-rl's PPO."""

    env: BaseTask
    ALGORITHM = "PPO"
    """Class of the learner, by rsl-rl's names or as module:class."""

    def __init__(
        self, env: BaseTask, log_dir: Path | None = None, device: str = "cpu", display: Display | None = None
    ) -> None:
        """`log_dir` is where checkpoints and TensorBoard files go; without one nothing is written."""
        config = runner_config(env.cfg, self.ALGORITHM)
        torch.backends.cuda.matmul.allow_tf32 = env.cfg.train.runner.matmul == "tf32"  # of this process
        if env.cfg.train.algorithm.symmetry and isinstance(env, LeggedRobot):
            env.mirror_images = MirrorImages(env)  # type: ignore[attr-defined]  # where `augment` finds them
        with contextlib.redirect_stdout(io.StringIO()):
            super().__init__(env, config, str(log_dir) if log_dir else None, device)
        self.logger = QuietLogger(
            log_dir=str(log_dir) if log_dir else None,
            cfg=self.cfg,
            env_cfg=env.cfg,
            num_envs=env.num_envs,
            is_distributed=self.is_distributed,
            gpu_world_size=self.gpu_world_size,
            gpu_global_rank=self.gpu_global_rank,
            device=device,
            display=display,
        )

    def stop(self) -> None:
        """Ask `learn` to stop after the iteration that is going on."""
        self.logger.stop_requested = True

    def train(self, until_iteration: int) -> bool:
        """Learn up to iteration `until_iteration`; false if stopped before. Leaves a checkpoint either way, and the other
        processes, if there are any.

        Raises:
            RankLost: one of those has died.
        """
        finished = True
        try:
            self.learn(until_iteration - self.current_learning_iteration, init_at_random_ep_len=True)
        except Interrupted:
            finished = False
            if self.logger.writer is not None:
                self.save(str(Path(self.logger.log_dir) / f"model_{self.current_learning_iteration}.pt"))
                self.logger.stop_logging_writer()
        except RuntimeError as error:
            if self.is_distributed and "by peer" in str(error):  # gloo notices; with NCCL torchrun ends who waits
                raise RankLost(f"rank {self.gpu_global_rank}: another process has ended; torchrun says which") from error
            raise
        leave()
        return finished

    def _configure_multi_gpu(self) -> None:
        """As rsl-rl, and on the CPU too: each process of torchrun has the device it was given, and meets the others."""
        ranks = Ranks.now()
        self.is_distributed = ranks.several
        self.gpu_world_size, self.gpu_global_rank, self.gpu_local_rank = ranks.count, ranks.rank, ranks.local_rank
        self.cfg["multi_gpu"] = None
        if ranks.several:
            self.cfg["multi_gpu"] = {
                "global_rank": ranks.rank,
                "local_rank": ranks.local_rank,
                "world_size": ranks.count,
            }
            join(ranks, torch.device(self.device))

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        """Write a checkpoint with the task's state."""
        saved = self.alg.save()
        saved["iter"] = self.current_learning_iteration
        saved["infos"] = {
            **(infos or {}),
            "task": self.env.cfg.task,
            "task_state": self.env.state_dict(),
            "observations": observation_layout(self.env),
            "learning_rate": self.alg.learning_rate,
            "wall_s": time.perf_counter() - STARTED_S,  # since this process began
        }
        write_checkpoint(Path(path), saved)
        self.logger.save_model(path, self.current_learning_iteration)

    def load(self, path: str, load_cfg: dict | None = None, strict: bool = True, map_location: str | None = None) -> dict:
        """Restore networks, optimiser (if the checkpoint holds it; shipped ones do not), iteration count and the task's
        state from a checkpoint.

        Raises:
            ConfigError: the file is no checkpoint, or of a network of another size.
        """
        saved = read_checkpoint(Path(path), map_location or self.device)
        parts = load_cfg or dict.fromkeys(("actor", "critic", "iteration"), True)
        parts = {"optimizer": "optimizer_state_dict" in saved, **parts}
        try:
            self.alg.load(saved, parts, strict)
        except (RuntimeError, ValueError) as error:
            policy = self.alg.get_policy().state_dict()
            raise ConfigError(describe_mismatch(Path(path), saved, policy, self.env.cfg.task)) from error
        infos = saved.get("infos") or {}
        # rsl-rl saves the index of the last finished iteration; going on from it would repeat that one.
        self.current_learning_iteration = saved["iter"] + 1
        self.alg.learning_rate = infos.get("learning_rate", self.alg.learning_rate)
        if "task_state" in infos:
            self.env.load_state_dict(infos["task_state"])
        return infos
