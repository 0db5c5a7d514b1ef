"""Training loop that makes two calls per iteration: one for the rollout, one for the update. On a GPU each call replays one
CUDA graph.
"""

import math
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from legged.config.networks import ESTIMATED
from legged.envs import BaseTask
from legged.graph.step_graph import StepGraph
from legged.learning.async_readback import AsyncReadback
from legged.learning.display import Display
from legged.learning.divergence import Diverged
from legged.learning.estimator import EstimatingModel, EstimationErrors
from legged.learning.evaluations import Ended
from legged.learning.logger import Interrupted
from legged.learning.ppo import DevicePPO
from legged.learning.rollout import Rollout, Steps
from legged.learning.row_threads import RowThreads
from legged.learning.runner import Runner
from legged.process.cores import available_cores
from legged.process.ranks import Ranks
from legged.process.startup import stage_ended

ROLLOUTS_TO_WARM_UP = 1
"""Number of warm-up rollouts before capture. One is enough, because the task warmed up its step when it was built."""
LOGGED = "log/"
"""Prefix of the task's log entries in an AsyncReadback."""


class CapturedRunner(Runner):
    """Runner whose loop only launches work on the device, and reads the logged numbers once per iteration.

    On a GPU the loop launches the next iteration before it logs the previous one, so the device never waits for the log.
    Checkpoints, configuration and logs are those of Runner. If a feature needs rsl-rl's own loop, `why_stock` names the
    feature and `learn` runs that loop.
    """

    alg: DevicePPO
    ALGORITHM = "legged.learning.ppo:DevicePPO"

    def __init__(
        self, env: BaseTask, log_dir: Path | None = None, device: str = "cpu", display: Display | None = None
    ) -> None:
        super().__init__(env, log_dir, device, display)
        self._rollout: Steps | None = None
        if isinstance(self.alg.actor, EstimatingModel):
            errors = EstimationErrors(env.observation_groups[ESTIMATED])
            self.alg.learn_to_estimate(errors, env.cfg.train.policy.estimator.learning_rate)
        if torch.device(device).type == "cpu":
            self.alg.threads = RowThreads(env.cfg.sim.threads or available_cores() // Ranks.now().local_count)
        self.why_stock = self.alg.why_stock
        """Reason why training uses rsl-rl's own loop; empty if it does not."""
        if torch.device(device) != torch.device(env.device):  # type: ignore[arg-type]
            self.why_stock = f"the task is on {env.device}, the networks are on {device}"

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train for a number of iterations."""
        if self.why_stock:
            print(f"this run uses rsl-rl's own training loop: {self.why_stock}", flush=True)
            super().learn(num_learning_iterations, init_at_random_ep_len)
            return
        self.alg.train_mode()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        self._rollout = rollout = self._steps()
        stage_ended("learner built")
        warmup = self.env.cfg.train.algorithm.critic_warmup_iterations
        collect, update, update_critic = self._capture(rollout, self.current_learning_iteration < warmup)
        stage_ended("training captured")
        if not self._restore_state() and init_at_random_ep_len:
            length = self.env.episode_length_buf
            self.env.episode_length_buf = torch.randint_like(length, high=int(self.env.max_episode_length))
        self.logger.init_logging_writer()
        first = self.current_learning_iteration
        total = first + num_learning_iterations
        clock: Clock | None = None
        unlogged: LaunchedIteration | None = None
        for iteration in range(first, total):
            clock = Clock(torch.device(self.device), clock)
            collect()
            clock.lap()
            (update_critic if iteration < warmup else update)()
            clock.lap()
            self.current_learning_iteration = iteration
            launched = LaunchedIteration(iteration, first, total, self._read(rollout), clock)
            if unlogged is not None:
                self._log_before(unlogged, launched)
            unlogged = launched
            due = iteration % self.cfg["save_interval"] == 0
            evaluates = self.evaluations is not None and self.evaluations.may_be_due(iteration + 1, total)
            # The second-last iteration is logged at once, so that a request to stop takes effect before the last one starts.
            if not self._runs_ahead or due or evaluates or iteration == first or iteration + 2 >= total:
                self._log(launched)
                unlogged = None
            if iteration == first:
                stage_ended("first iteration")
            if due and self.logger.writer is not None:
                self.save(str(Path(self.logger.log_dir) / f"model_{iteration}.pt"))
            if due or evaluates:
                clock = None  # the next clock starts anew, to leave out the time of saving and evaluation
        if self.logger.writer is not None:
            self.save(str(Path(self.logger.log_dir) / f"model_{self.current_learning_iteration}.pt"))
            self.logger.stop_logging_writer()

    def compile_kernels(self) -> None:
        """Make a trial rollout and a trial update, so that their kernels are compiled and cached."""
        if not self.why_stock:
            self.alg.train_mode()
            self._capture(self._steps(), False)

    @property
    def _runs_ahead(self) -> bool:
        """True if the next iteration is launched before the previous one is logged. All processes must do so at the same
        iterations, because they agree on stopping when they log. Only the first one knows when an evaluation is due.
        """
        alike = not self.is_distributed or not self.env.cfg.train.runner.evaluate_interval
        return torch.device(self.device).type == "cuda" and alike

    def _steps(self) -> Steps:
        """Return the object that collects the rollouts."""
        return Rollout(self.env, self.alg)

    def _capture(self, rollout: Steps, warms_up: bool) -> tuple[Callable[[], None], Callable[[], None], Callable[[], None]]:
        """Return three functions: the rollout, the update, and the update of the value function alone.

        They replay CUDA graphs if the task's step is captured. The third differs from the second only if training begins with
        updates of the value function (`warms_up`). A capture needs trial steps. Afterwards the networks have their weights
        from before the trial steps, and the task is reset.
        """
        device = torch.device(self.device)
        enabled = self.env.captured
        progress = self.env.progress()
        collect = StepGraph(rollout.collect, device, enabled, ROLLOUTS_TO_WARM_UP, lambda: rollout.collect(1))
        if warms_up:
            self.alg.fill_moments()
        before = list(zip(self.alg.tensors(), copies(self.alg.tensors()), strict=True))
        fits = enabled and self.alg.fits_graph
        update = update_critic = StepGraph(self.alg.learn, device, fits, rehearse=lambda: self.alg.learn(1))
        if warms_up:
            update_critic = StepGraph(self.alg.learn_critic, device, enabled, rehearse=lambda: self.alg.learn_critic(1))
        with torch.no_grad():
            for tensor, value in before:
                tensor.copy_(value)
            known = {id(tensor) for tensor, _ in before}
            for state in self.alg.optimizer.state.values():
                for tensor in state.values():
                    if id(tensor) not in known:  # this tensor did not exist before the trial steps
                        tensor.zero_()
        if enabled:
            rollout.forget()
            self.env.reset_curricula()
            self.env.load_progress(progress)
            self.env.reset()
        return collect, update, update_critic

    def _episodes(self) -> dict[str, Tensor]:
        return super()._episodes() if self._rollout is None else self._rollout.episodes

    def _read(self, rollout: Steps) -> AsyncReadback:
        """Begin to read the logged numbers of the iteration that was just launched."""
        logged = self.env.log_rollout() if self.logger.writer is not None else {}
        named = {LOGGED + name: value for name, value in logged.items()}
        return AsyncReadback({"ended": rollout.ended, **self.alg.outcome(), **named})

    def _log_before(self, launched: "LaunchedIteration", following: "LaunchedIteration") -> None:
        """Log the iteration `launched` while the device computes `following`. If training was asked to stop, log `following`
        too, because the networks have learned from it.

        Raises:
            Interrupted: the training was asked to stop.
            Diverged: numbers have been NaN or infinite for too long.
        """
        try:
            self._log(launched)
        except Interrupted:
            with suppress(Interrupted, Ended):
                self._log(following)
            raise
        except Diverged:
            self.current_learning_iteration = launched.iteration
            raise

    def _log(self, launched: "LaunchedIteration") -> None:
        """Wait for an iteration to end and log it."""
        logger, numbers = self.logger, launched.readback.numbers()
        ended, returns, lengths, squares = numbers.pop("ended")
        if ended:
            logger.return_std = math.sqrt(squares / ended)
            logger.rewbuffer.clear()
            logger.rewbuffer.append(returns / ended)
            logger.lenbuffer.clear()
            logger.lenbuffer.append(lengths / ended)
        losses, std = self.alg.losses(numbers.pop("losses")), torch.tensor(numbers.pop("std"))
        rate = numbers.pop("rate")[0] if "rate" in numbers else self.alg.learning_rate
        if numbers:
            logger.ep_extras.append({name.removeprefix(LOGGED): torch.tensor(value) for name, (value,) in numbers.items()})
        collect_s, learn_s = launched.clock.seconds()
        logger.log(
            it=launched.iteration,
            start_it=launched.first,
            total_it=launched.total,
            collect_time=collect_s,
            learn_time=learn_s,
            loss_dict=losses,
            learning_rate=rate,
            action_std=std,
            rnd_weight=None,
        )


@torch.no_grad()
def copies(tensors: Iterable[Tensor]) -> list[Tensor]:
    """Copy tensors outside autograd.

    If autograd recorded the copy of a parameter, the node that accumulates this parameter's gradient would stay bound to the
    stream of the copy. A later capture on another stream would have to wait for that stream, and CUDA forbids this.
    """
    return [tensor.clone() for tensor in tensors]


class Clock:
    """Stopwatch for consecutive laps. On a GPU, CUDA events measure the times, so that the host need not wait."""

    def __init__(self, device: torch.device, before: "Clock | None" = None) -> None:
        """Start now. With a clock `before`, start at its end, so the first lap includes the work between the two clocks."""
        self._cuda = device.type == "cuda"
        self._marks: list[Any] = [] if before is None else before._marks[-1:]
        if before is None:
            self.lap()

    def lap(self) -> None:
        """End the current lap."""
        if self._cuda:
            mark = torch.cuda.Event(enable_timing=True)
            mark.record()
            self._marks.append(mark)
        else:
            self._marks.append(time.perf_counter())

    def seconds(self) -> list[float]:
        """Wait for the last lap to end and return the time of each lap [s]."""
        pairs = list(zip(self._marks, self._marks[1:], strict=False))
        if not self._cuda:
            return [end - start for start, end in pairs]
        self._marks[-1].synchronize()
        return [1e-3 * start.elapsed_time(end) for start, end in pairs]


@dataclass(frozen=True)
class LaunchedIteration:
    """An iteration that was launched, with the numbers to log for it."""

    iteration: int
    first: int
    """Number of the first iteration since training was started or resumed."""
    total: int
    """Number of iterations of the whole training, including those before it was resumed."""
    readback: AsyncReadback
    clock: Clock
    """Clock with the times of the rollout and of the update."""
