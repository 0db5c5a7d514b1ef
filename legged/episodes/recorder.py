"""Whole episodes of many robots, recorded on the device and fetched in chunks."""

import copy
from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from legged.envs import BaseTask, LeggedRobot
from legged.envs.final_observation import watch_steps
from legged.episodes.quantities import FLAGS, quantities_of
from legged.episodes.stored import Episodes
from legged.evaluation.measurement import Overflows

CHUNK_MB = 64.0
"""Size of a chunk of steps on the device [MiB]; a chunk is fetched in one transfer."""
LONGEST_CHUNK = 100
"""Most steps of a chunk; after each chunk the recorder checks whether all robots have finished."""


class StepRecord:
    """A row for each robot with all recorded quantities of a step, written within the captured step."""

    def __init__(self, task: BaseTask) -> None:
        self.quantities = quantities_of(task)
        values = [quantity.read() for quantity in self.quantities]
        self.shapes = [tuple(value.shape[1:]) for value in values]
        self.widths = [int(np.prod(shape)) for shape in self.shapes]
        self.row = torch.zeros(task.num_envs, sum(self.widths), device=task.device)
        """(N, W) last step of every robot, from before resets."""

    def take(self) -> None:
        """Write the row."""
        rows = len(self.row)
        values = [quantity.read().reshape(rows, width) for quantity, width in zip(self.quantities, self.widths, strict=True)]
        torch.cat([value.float() for value in values], dim=1, out=self.row)

    def split(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return name -> (T, ...) values of every quantity, from rows (T, W)."""
        parts = np.split(rows, np.cumsum(self.widths)[:-1], axis=1)
        return {
            quantity.name: part.reshape(len(rows), *shape)
            for quantity, part, shape in zip(self.quantities, parts, self.shapes, strict=True)
        }


def shares_of(episodes: int, robots: int) -> np.ndarray:
    """Return (N,) numbers of episodes of each robot. They are fixed beforehand, so that they do not depend on the lengths of
    episodes.
    """
    return episodes // robots + (np.arange(robots) < episodes % robots)


def record_episodes(
    task: BaseTask,
    act: Callable[[TensorDict], Tensor],
    episodes: int,
    command: tuple[float, float, float] | None = None,
    place: Callable[[], None] | None = None,
    graph: bool = True,
) -> tuple[Episodes, int]:
    """Run the first episodes of every robot, `episodes` in all, each from a reset to its end; return them, and how often a
    robot lost contacts in a step for want of memory.

    Robot i contributes its first `shares_of(...)[i]` episodes. So no episode is cut off, and short episodes are not more
    frequent than they should be, as they are among the episodes that end first. All robots hold `command`, vx, vy [m/s] and
    yaw rate [rad/s], if it is given. `place` is called before the first reset to place robots. With `graph` the step is
    captured on a GPU.

    Raises:
        TermError: the step cannot be captured.
    """
    progress = copy.deepcopy(task.progress())
    record = watch_steps(task, StepRecord(task), graph)
    task.load_progress(progress)  # curricula went back to their start with the new step
    if place is not None:
        place()
    gathered, lost = _run(task, act, record, shares_of(episodes, task.num_envs), command)
    return gathered.episodes(record), lost


@torch.inference_mode()
def _run(
    task: BaseTask,
    act: Callable[[TensorDict], Tensor],
    record: StepRecord,
    shares: np.ndarray,
    command: tuple[float, float, float] | None,
) -> tuple["_Gathered", int]:
    """Step until every robot has finished its episodes."""
    n, width, device = task.num_envs, record.row.shape[1], torch.device(task.device)
    first_states = task.physics.qpos.shape[1] + task.physics.qvel.shape[1]
    longest = int(CHUNK_MB * 2**20 / (4 * n * (width + first_states)))
    length = max(1, min(LONGEST_CHUNK, longest, task.max_episode_length))
    buffer = torch.zeros(length, n, width + first_states, device=device)
    observations, overflows = task.reset(), Overflows()
    if command is not None and isinstance(task, LeggedRobot):
        observations = task.hold_commands(torch.tensor(command, device=device))
    gathered = _Gathered(shares, _state(task).cpu().numpy(), width, width - record.widths[-1])
    while not gathered.complete:
        for step in range(length):
            observations, _, _, extras = task.step(act(observations))
            overflows.add(extras)
            buffer[step, :, :width].copy_(record.row)
            buffer[step, :, width:].copy_(_state(task))
        gathered.add(buffer.cpu().numpy())
    return gathered, overflows.total(task)


def _state(task: BaseTask) -> Tensor:
    """Return (N, nq + nv) generalised positions and velocities."""
    return torch.cat([task.physics.qpos, task.physics.qvel], dim=1)


class _Gathered:
    """Episodes of N robots, assembled on the host from chunks of steps."""

    def __init__(self, shares: np.ndarray, first_states: np.ndarray, width: int, ended: int) -> None:
        """Collect `shares` (N,) episodes, which begin in `first_states` (N, S). Rows are `width` wide; the flags of how an
        episode ended begin at the column `ended`.
        """
        self._shares, self._width, self._flags = shares, width, slice(ended, ended + len(FLAGS))
        self._begun: list[list[np.ndarray]] = [[] for _ in shares]
        self._first = first_states.copy()
        self._finished: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in shares]

    @property
    def complete(self) -> bool:
        """True if every robot has finished its episodes."""
        return all(len(own) == share for own, share in zip(self._finished, self._shares, strict=True))

    def add(self, chunk: np.ndarray) -> None:
        """Add steps (T, N, width + S): rows, and the states after them, which are those of new episodes after an end."""
        over = np.asarray(chunk[:, :, self._flags].any(axis=2))
        for robot, own in enumerate(self._finished):
            begin = 0
            for last in np.flatnonzero(over[:, robot]).tolist():
                if len(own) == self._shares[robot]:
                    break
                rows = np.concatenate([*self._begun[robot], chunk[begin : last + 1, robot, : self._width]])
                own.append((rows, self._first[robot].copy()))
                self._first[robot] = chunk[last, robot, self._width :]
                self._begun[robot], begin = [], last + 1
            if len(own) < self._shares[robot]:
                self._begun[robot].append(chunk[begin:, robot, : self._width].copy())

    def episodes(self, record: StepRecord) -> Episodes:
        """Return the episodes in order: the first of every robot, then the second."""
        numbered = sorted((k, robot) for robot, own in enumerate(self._finished) for k in range(len(own)))
        rows = [self._finished[robot][k][0] for k, robot in numbered]
        arrays = record.split(np.concatenate(rows))
        ends = np.cumsum([len(part) for part in rows])
        ended = arrays.pop("ended")[ends - 1].astype(bool)
        qpos_width = arrays["qpos"].shape[1]
        first = np.array([self._finished[robot][k][1] for k, robot in numbered])
        per_episode = {
            "episode_start": np.array([0, *ends]),
            "robot": np.array([robot for _, robot in numbered]),
            "failed": ended[:, 0],
            "timed_out": ended[:, 1],
            "ended_by": ended[:, len(FLAGS) :],
            "first_qpos": first[:, :qpos_width],
            "first_qvel": first[:, qpos_width:],
        }
        return Episodes({**arrays, **per_episode}, {})
