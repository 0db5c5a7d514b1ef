"""Reference motions on the device: the frame that each robot should reach, and the frames in which episodes begin."""

from collections.abc import Sequence

import torch
from torch import Tensor

from legged.math import masked_set_
from legged.mdp.random_pool import RandomPool
from legged.motion.clip import Clip
from legged.motion.kinematics import Skeleton


class Frames:
    """Rows of a table of frames, as tensors that share the memory of `rows` (M, W). D joints, B bodies, world frame."""

    def __init__(self, rows: Tensor, joints: int, bodies: int) -> None:
        self.rows, m = rows, len(rows)
        widths = [joints, joints, 3, 4, 3, 3, 3 * bodies, 4 * bodies, 3 * bodies, 3 * bodies]
        parts = rows[:, : sum(widths)].split(widths, dim=1)
        self.joint_pos, self.joint_vel = parts[:2]
        """(M, D) joint angles [rad], and joint velocities [rad/s]."""
        self.root_pos, self.root_quat, self.root_lin_vel, self.root_ang_vel = parts[2:6]
        """(M, 3) position of the base [m]; (M, 4) orientation, w first; (M, 3) velocities [m/s, rad/s]."""
        self.pos, self.quat, self.lin_vel, self.ang_vel = (part.view(m, bodies, -1) for part in parts[6:])
        """(M, B, 3) positions of bodies [m]; (M, B, 4) orientations; (M, B, 3) velocities of their origins [m/s, rad/s]."""

    @property
    def qpos(self) -> Tensor:
        """(M, 7 + D) poses in the order of `Physics.qpos`: position of the base [m], orientation, joint angles [rad]."""
        return torch.cat([self.root_pos, self.root_quat, self.joint_pos], dim=1)


class ReferenceMotion:
    """The frames of all clips in one table, and the frame of each of N robots.

    Episodes begin in random frames. Each clip is divided into bins of equal length. Bins in which robots fail are drawn more
    often (Liao et al., BeyondMimic, arXiv 2508.08241).
    """

    STATE = ("frame", "failures")

    def __init__(
        self,
        clips: Sequence[Clip],
        skeleton: Skeleton,
        bodies: Sequence[str],
        numbers: RandomPool,
        bin_s: float,
        uniform: float,
        memory: float,
    ) -> None:
        """Compute the motion of the bodies. All clips have the rate of the control steps. `bin_s` [s], `uniform` and `memory`
        are the settings of `motion` in the configuration.
        """
        n, device = numbers.num_envs, numbers.device
        sizes = (len(skeleton.robot.joint_names), len(bodies))
        self._uniform, self._memory = uniform, memory
        tables: list[Tensor] = []
        starts: list[Tensor] = []
        bin_of, last, spans = [], [], []
        first = first_bin = 0
        for clip in clips:
            speeds, motion, count = clip.velocities(), skeleton.body_motion(clip, bodies), len(clip)
            arrays = [clip.joint_pos, speeds.joint, clip.root_pos, clip.root_quat, speeds.root_lin, speeds.root_ang, *motion]
            tables.append(torch.cat([torch.from_numpy(values.reshape(count, -1)) for values in arrays], dim=1).float())
            bins = int(count / (bin_s * clip.fps)) + 1
            bin_of.append(torch.arange(count) * bins // count + first_bin)
            starts.append(first + torch.arange(bins) * ((count - 1) / bins))
            spans.append(torch.full((bins,), (count - 1) / bins))
            last.append(torch.full((count,), first + count - 1))
            first, first_bin = first + count, first_bin + bins
        self.table = Frames(torch.cat(tables).to(device), *sizes)
        """Frames of all clips, one clip after the other."""
        self.clips: dict[str, Frames] = {}
        """Clip -> its frames. If several clips have one name, underscores are added."""
        for clip, rows in zip(clips, self.table.rows.split([len(clip) for clip in clips]), strict=True):
            name = clip.name
            while name in self.clips:
                name += "_"
            self.clips[name] = Frames(rows, *sizes)
        self._bin_of, self._last = torch.cat(bin_of).to(device), torch.cat(last).to(device)
        self._starts, self._spans = torch.cat(starts).float().to(device), torch.cat(spans).float().to(device)
        self.frame = torch.zeros(n, dtype=torch.long, device=device)
        """(N,) row of the frame that each robot should have reached at the end of the present control step."""
        self.failures = torch.zeros(len(self._starts), device=device)
        """(K,) failures of all robots per step in each bin, averaged over time. Each of several processes counts its own."""
        self.drawn = torch.zeros_like(self.frame)
        """(N,) rows in which the next episodes begin."""
        width = self.table.rows.shape[1]
        self.now = Frames(torch.zeros(n, width, device=device), *sizes)
        """The frame of each robot."""
        self.start = Frames(torch.zeros(n, width, device=device), *sizes)
        """The frame in which each robot's next episode begins."""
        self.chosen: Tensor | None = None
        """(N,) rows in which the next episodes begin instead of the drawn ones; None outside `MotionTracking.start_at`."""
        self._numbers = numbers.between(0.0, 1.0, 2)

    def chances(self) -> Tensor:
        """Return the probabilities (K,) with which episodes begin in the bins."""
        weights = self.failures + self._uniform / len(self.failures)
        return weights / weights.sum()

    def draw(self) -> None:
        """Draw the frame in which each robot's next episode begins."""
        which, where = self._numbers.values.unbind(dim=1)
        bins = torch.searchsorted(self.chances().cumsum(0), which.contiguous()).clamp_(max=len(self.failures) - 1)
        self.drawn.copy_(self._starts[bins] + where * self._spans[bins] if self.chosen is None else self.chosen)
        torch.index_select(self.table.rows, 0, self.drawn, out=self.start.rows)

    def begin(self, mask: Tensor) -> None:
        """Put the robots in `mask` (N,), whose episodes begin, on the drawn frames."""
        masked_set_(self.frame, mask, self.drawn)

    def count(self, failed: Tensor) -> None:
        """Count the robots `failed` (N,) in the bins of their frames."""
        counts = torch.zeros_like(self.failures).index_add_(0, self._bin_of[self.frame], failed.float())
        self.failures.lerp_(counts, self._memory)

    def ended(self) -> Tensor:
        """Return True (N,) for robots whose frame is the last of its clip."""
        return self.frame == self._last[self.frame]

    def advance(self) -> None:
        """Go on to the next frame of each clip; the last frame is kept."""
        torch.minimum(self.frame + 1, self._last[self.frame], out=self.frame)
        self.read()

    def read(self) -> None:
        """Look up each robot's frame."""
        torch.index_select(self.table.rows, 0, self.frame, out=self.now.rows)
