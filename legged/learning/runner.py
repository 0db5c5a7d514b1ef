"""Runner that extends rsl-rl's OnPolicyRunner by a clean stop, and by atomic checkpoints that hold the task's progress."""

import contextlib
import io
import math
import time
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

import torch
from rsl_rl.runners import OnPolicyRunner
from torch import Tensor

from legged.config.learning import RunnerConfig
from legged.envs import BaseTask
from legged.errors import ConfigError, RunError
from legged.learning.checkpoint import (
    check_weights,
    describe,
    describe_mismatch,
    fit_optimizer,
    read_checkpoint,
    write_checkpoint,
)
from legged.learning.display import Display
from legged.learning.distributed import RankLost, join, leave
from legged.learning.divergence import Diverged
from legged.learning.evaluations import Ended, Evaluations
from legged.learning.gradient_guard import GradientGuard
from legged.learning.kl_meter import KLMeter
from legged.learning.logger import Interrupted, QuietLogger
from legged.learning.networks import keep_std_in_bounds, network_settings, reset_std, use_matmul
from legged.learning.recurrent import hidden_states, keep_shape_of_one_robot
from legged.learning.run_folder import BEST_MODEL, CONFIG_FILE, run_config
from legged.learning.run_state import (
    check_same_world,
    generators,
    read_run_state,
    remove_older,
    set_generators,
    write_run_state,
)
from legged.learning.symmetry import augment, images_of
from legged.learning.transfer import check_built, transfer_summary, transferable_parts
from legged.process.paths import relative
from legged.process.ranks import Ranks
from legged.process.startup import STARTED_S
from legged.state import StateError, take


def runner_config(task: BaseTask, algorithm_class: str) -> dict[str, Any]:
    """Return rsl-rl's configuration dictionary.

    Raises:
        ConfigError: the configuration asks for mirror images, but the task has none.
    """
    cfg, runner = task.cfg, task.cfg.train.runner
    settings = {name: value for name, value in vars(cfg.train.algorithm).items() if name != "class_name"}
    ours = settings.pop("reward_scale") != 1.0, settings.pop("critic_warmup_iterations") > 0
    if any(ours) and algorithm_class == "PPO":
        algorithm_class = "legged.learning.critic_warmup:CriticWarmup"
    symmetry, mirror_loss = settings.pop("symmetry"), settings.pop("mirror_loss_coeff")
    if symmetry:
        settings["symmetry_cfg"] = {
            "data_augmentation_func": partial(augment, images_of(task)),
            "use_data_augmentation": True,
            "use_mirror_loss": mirror_loss > 0.0,
            "mirror_loss_coeff": mirror_loss,
        }
    return {
        **loop_settings(runner),
        **network_settings(cfg),
        "algorithm": {"class_name": algorithm_class, **settings},
    }


def loop_settings(runner: RunnerConfig) -> dict[str, Any]:
    """Return rsl-rl's settings of the training loop."""
    return {
        "num_steps_per_env": runner.num_steps_per_env,
        "save_interval": runner.save_interval,
        "run_name": runner.run_name,
        "logger": runner.logger,
        "check_for_nan": False,  # the check waits for the GPU at every step; the task itself resets robots with NaN
    }


class Runner(OnPolicyRunner):
    """Runner that trains a task with rsl-rl's PPO."""

    env: BaseTask
    ALGORITHM = "PPO"
    """Class of the learner: one of rsl-rl's names, or module:class."""

    def __init__(
        self, env: BaseTask, log_dir: Path | None = None, device: str = "cpu", display: Display | None = None
    ) -> None:
        """Write checkpoints and TensorBoard files to the folder `log_dir`, or write nothing if it is None."""
        config = self._configuration(env)
        use_matmul(env.cfg)
        with contextlib.redirect_stdout(io.StringIO()):
            super().__init__(env, config, str(log_dir) if log_dir else None, device)
        self.alg.reward_scale = env.cfg.train.algorithm.reward_scale
        self._state: dict[str, Any] | None = None
        self._transferred_from: dict[str, Any] | None = None
        self._last_saved = ""
        self._description = describe(env)  # the sources of the terms may be edited during the training
        self.evaluations: Evaluations | None = None
        """Evaluations of the policy during training. With several processes, only the first has them."""
        keep_std_in_bounds(self.alg.get_policy(), self.alg.optimizer)
        if self.alg.get_policy().is_recurrent:
            keep_shape_of_one_robot(self.alg.get_policy())
        self._guard = None if hasattr(self.alg.optimizer, "found_inf") else GradientGuard(self.alg.optimizer)
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
            left_out=self._left_out,
        )
        self.logger.kl_meter = KLMeter(self.alg.actor)

    def _configuration(self, env: BaseTask) -> dict[str, Any]:
        """Return rsl-rl's configuration dictionary for a task."""
        return runner_config(env, self.ALGORITHM)

    def _networks(self) -> dict[str, Any]:
        """Return the networks by their names in a checkpoint."""
        return {"actor": self.alg.actor, "critic": self.alg.critic}

    def _left_out(self) -> float:
        """Return the share of the last update's mini-batches that were skipped for NaN or infinite gradients."""
        return self.alg.left_out if self._guard is None else self._guard.flush()

    def stop(self) -> None:
        """Ask `learn` to stop after the current iteration."""
        self.logger.stop_requested = True

    def evaluate_with(self, evaluations: Evaluations | None) -> None:
        """Set the evaluations of the policy during training. With several processes, only the first passes evaluations, and
        the others pass None.
        """
        self.evaluations = evaluations
        self.logger.why_end = lambda: "" if evaluations is None else evaluations.why_end
        if evaluations is not None:
            self.logger.evaluate = self._evaluate

    def _evaluate(self, iterations: int, total: int) -> dict[str, float]:
        """Evaluate the policy if an evaluation is due, save the policy if it is the best so far, and return the figures."""
        evaluations, logger = self.evaluations, self.logger
        assert evaluations is not None
        if not evaluations.due(iterations, total, logger.loop_s):
            return {}
        steps = logger.tot_timesteps + logger.steps_per_iteration
        best = evaluations.evaluate(self.alg.get_policy(), iterations, logger.loop_s, steps)
        figures = evaluations.history[-1].figures
        found = {name: value for name, value in figures.items() if math.isfinite(value)}  # checkpoints can't hold NaN
        if best and logger.writer is not None:
            path = Path(logger.log_dir) / BEST_MODEL
            write_checkpoint(path, self._content(path, {"evaluation": found}))
            logger.save_model(str(path), iterations - 1)
        return found

    def train(self, until_iteration: int) -> bool:
        """Train up to iteration `until_iteration`, or until evaluations reach the target `stop_at`, and save a checkpoint.
        Return False if the training was stopped earlier. At the end, leave the process group.

        Raises:
            RankLost: another process has died.
            Diverged: numbers were NaN or infinite for too long. The last checkpoint is not affected.
        """
        finished = True
        try:
            self.learn(until_iteration - self.current_learning_iteration, init_at_random_ep_len=True)
        except (Interrupted, Ended) as end:
            # Only the first process has evaluations, but the logger raises Ended in all processes. With several processes,
            # Ended always means that the target is reached.
            finished = isinstance(end, Ended) and (self.evaluations is None or self.evaluations.reached)
            if self.logger.writer is not None:
                self.save(str(Path(self.logger.log_dir) / f"model_{self.current_learning_iteration}.pt"))
                self.logger.stop_logging_writer()
        except Diverged as error:
            if self.logger.writer is not None:
                self.logger.stop_logging_writer()
            leave()
            good = f"; the last checkpoint is {self._last_saved}" if self._last_saved else ""
            raise Diverged(f"stopped after iteration {self.current_learning_iteration + 1}: {error}{good}") from error
        except RuntimeError as error:
            if self.is_distributed and "by peer" in str(error):  # gloo's error; with NCCL, torchrun reports a lost process
                raise RankLost(f"rank {self.gpu_global_rank}: another process has ended; torchrun says which") from error
            raise
        leave()
        return finished

    def _configure_multi_gpu(self) -> None:
        """Join the process group on GPUs or on the CPU. rsl-rl's own method supports only GPUs."""
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

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train for a number of iterations. Robots that continue from a saved state keep their episodes."""
        warmup = self.env.cfg.train.algorithm.critic_warmup_iterations
        self.alg.warmup_left = max(0, warmup - self.current_learning_iteration)
        goes_on = self._restore_state()
        super().learn(num_learning_iterations, init_at_random_ep_len and not goes_on)

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        """Write a checkpoint, and next to it the rest of the state (run_state.py). States of older checkpoints are removed.

        Raises:
            RunError: weights are NaN or infinite, or a file can't be written.
        """
        saved = self._content(Path(path), infos)
        if not self.is_distributed:  # with several processes, none has the states of all robots
            saved["infos"]["id"] = uuid4().hex
            state = {"generators": generators(), "task": self.env.state_dict(), "episodes": self._episodes()}
            state["memory"] = {name: tensor.clone() for name, tensor in self._memory().items()}
            write_run_state(Path(path), {"id": saved["infos"]["id"], **state})
        write_checkpoint(Path(path), saved)
        remove_older(Path(path))
        self._last_saved = path
        self.logger.save_model(path, self.current_learning_iteration)

    def _content(self, path: Path, infos: dict[str, Any] | None = None) -> dict[str, Any]:
        """Return the content of a checkpoint, with the entries of `infos` added.

        Raises:
            RunError: weights are NaN or infinite. The message says that `path` is not written.
        """
        saved = self.alg.save()
        try:
            for network in self._networks():
                check_weights(saved[f"{network}_state_dict"], f"{path}: is not written: the {network}")
        except ConfigError as error:
            raise RunError(str(error)) from error
        saved["iter"] = self.current_learning_iteration
        saved["infos"] = {
            **(infos or {}),
            **self._description,
            "task_state": self.env.progress(),
            "learning_rate": self.alg.learning_rate,
            "wall_s": time.perf_counter() - STARTED_S,  # since the start of this process
        }
        if self._transferred_from is not None:
            saved["infos"]["transferred_from"] = self._transferred_from
        return saved

    def load(self, path: str, load_cfg: dict | None = None, strict: bool = True, map_location: str | None = None) -> dict:
        """Restore networks, optimiser, iteration count and the progress of the curricula from a checkpoint. Shipped policies
        have no optimiser.

        Raises:
            ConfigError: the file is not a checkpoint, or its networks have other sizes.
        """
        saved = read_checkpoint(Path(path), map_location or self.device)
        infos = saved["infos"]
        self._load_learner(Path(path), saved, load_cfg, strict)
        self._transferred_from = infos.get("transferred_from")
        # rsl-rl saves the index of the last finished iteration. Training continues with the next index.
        self.current_learning_iteration = saved["iter"] + 1
        try:
            if "task_state" in infos:
                self.env.load_progress(infos["task_state"])
        except (RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ConfigError(f"{path}: the progress of its curricula is damaged ({error})") from error
        return infos

    def _load_learner(self, path: Path, saved: dict[str, Any], parts: dict | None = None, strict: bool = True) -> None:
        """Load networks, optimiser (if there is one) and learning rate from the content of a checkpoint. `parts` limits what
        is loaded.

        Raises:
            ConfigError: the content does not fit.
        """
        parts = parts or {"actor": True, "critic": "critic_state_dict" in saved, "iteration": True}
        parts = {"optimizer": "optimizer_state_dict" in saved, **parts}
        if parts["optimizer"]:
            wanted, where = saved["optimizer_state_dict"], f"{relative(path)}: its optimiser"
            waiting = len([*self.alg.get_policy().parameters()])  # they have no moments after a critic warm-up
            saved["optimizer_state_dict"] = fit_optimizer(wanted, self.alg.optimizer, where, waiting)
        try:
            self.alg.load(saved, parts, strict)
            self._set_rate(float(saved["infos"].get("learning_rate", self.alg.learning_rate)))
        except (RuntimeError, ValueError, KeyError, TypeError) as error:
            policy = self.alg.get_policy().state_dict()
            raise ConfigError(describe_mismatch(path, saved, policy, self.env.cfg.task)) from error

    def _set_rate(self, saved: float) -> None:
        """Set the learning rate: the `saved` one if the schedule is adaptive, the configuration's if it is fixed."""
        settings = self.env.cfg.train.algorithm
        self.alg.learning_rate = settings.learning_rate if settings.schedule == "fixed" else saved
        first = self.alg.optimizer.param_groups[0]  # the estimator's group, which comes next, keeps its own rate
        if not isinstance(first["lr"], Tensor):
            first["lr"] = self.alg.learning_rate

    def transfer(self, path: str) -> str:
        """Begin a training with networks, normaliser and optimiser of another task's checkpoint. Iterations, curricula and
        robots begin anew. Return a summary.

        Raises:
            ConfigError: the file is not a checkpoint, or its observations, actions or networks differ.
        """
        saved = transferable_parts(read_checkpoint(Path(path), self.device), self.env.cfg)
        check_built(Path(path), saved, self.env)
        settings = self.env.cfg.train.algorithm
        if saved["infos"]["optimizer"] != settings.optimizer:
            saved.pop("optimizer_state_dict", None)
        self._load_learner(Path(path), saved)
        if "critic_state_dict" not in saved:
            reset_std(self.alg.get_policy(), self.env.cfg)
        task = saved["infos"].get("task", "")
        self._transferred_from = {"file": relative(Path(path)), "task": task, "iteration": saved["iter"]}
        return transfer_summary(Path(path), saved, self.alg.get_policy(), self.env.cfg, self.alg.learning_rate)

    def resume(self, path: str) -> str:
        """Load a checkpoint, to continue its training. Return the reason why robots begin anew, or an empty text if they
        continue.

        Robots, random numbers and episodes continue if there is one process, the checkpoint has a state, and none of
        `STATE_SETTINGS` has changed. Otherwise all robots begin anew on the terrain levels that they had reached.
        """
        infos = self.load(path)
        if self.is_distributed:
            why = "there are several processes"
        else:
            try:
                state = read_run_state(Path(path), infos.get("id", ""))
                if (Path(path).parent / CONFIG_FILE).is_file():
                    check_same_world(run_config(Path(path).parent), self.env.cfg)
                self._take(state)
                self._state = state  # `learn` restores this again, because the capture of a CUDA graph makes trial steps
                return ""
            except StateError as error:
                why = str(error)
        self.load(path)
        self.env.reset()
        return why

    def _restore_state(self) -> bool:
        """Restore the state of the resumed run, once, when training begins. Return True if there was one."""
        if self._state is None:
            return False
        self._take(self._state)
        self._state = None
        return True

    def _take(self, state: dict[str, Any]) -> None:
        """Load a state into task, episodes and random generators. Raises StateError if it does not fit."""
        self.env.load_state_dict(state["task"])
        take(self._episodes(), state["episodes"], "episodes")
        take(self._memory(), state.get("memory", {}), "memory")
        set_generators(state["generators"])

    def _episodes(self) -> dict[str, Tensor]:
        """Return the sum of rewards and the length of each environment's episode so far, (N,) each, for the log."""
        return {"return": self.logger.cur_reward_sum, "length": self.logger.cur_episode_length}

    def _memory(self) -> dict[str, Tensor]:
        """Return the hidden states of recurrent networks, (layers, N, width) each; empty without such networks."""
        return hidden_states(self._networks(), self.env.num_envs)
