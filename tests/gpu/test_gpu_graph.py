"""The step as a CUDA graph: what is replayed is what would have been run, and what cannot be captured is named."""

import gc
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from devices import CUDA
from helpers import CALM, TASK

from legged.config import TaskConfig
from legged.envs import LeggedRobot
from legged.errors import TermError
from legged.evaluation.league.measuring import rules, with_ideal_motors
from legged.evaluation.league.robot import league_robot
from legged.evaluation.league.task import Course, make_league
from legged.graph.step_graph import Branch, ForbidHostReads, HostReadError, StepGraph
from legged.policies.restore import nominal
from legged.registry import make_task, task_config

pytestmark = pytest.mark.gpu

DEVICE = torch.device(CUDA)
ROBOTS, STEPS = 64, 50
LONG = 20_000_000
"""Cycles of the device for which a launch keeps its stream busy: about 10 ms."""


# ---- graphs of plain functions -------------------------------------------------------------------------------------------


class Walk:
    """A step that draws, multiplies and accumulates."""

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(0)
        self.matrix = (torch.randn(32, 32, generator=generator) / 8.0).to(DEVICE)
        self.place, self.noise = torch.zeros(256, 32, device=DEVICE), torch.zeros(256, 32, device=DEVICE)
        self.count = torch.zeros((), dtype=torch.long, device=DEVICE)

    def step(self) -> None:
        self.noise.normal_()
        weights = torch.tensor([1.0, -0.5], device=DEVICE)
        self.place.copy_(torch.tanh(self.place @ self.matrix) + self.noise)
        self.place[:, [3, 5]] += weights * torch.rand(256, 2, device=DEVICE)
        self.count.add_(1)


def test_an_old_graph_in_a_cycle_does_not_break_the_next_capture():
    """A task that was dropped is freed when Python's collector runs next, perhaps while another's step is recorded."""
    old = StepGraph(Walk().step, DEVICE, enabled=True)
    old.cycle = old  # type: ignore[attr-defined]
    walk, thresholds = Walk(), gc.get_threshold()

    def littering() -> None:
        walk.step()
        if torch.cuda.is_current_stream_capturing():
            gc.set_threshold(1, 1, 1)  # the collector would run with every list
        for _ in range(200):
            cycle: list[object] = []
            cycle.append(cycle)

    gc.set_threshold(10**9)  # the rehearsals free nothing
    try:
        del old
        assert StepGraph(littering, DEVICE, enabled=True).captured
    finally:
        gc.set_threshold(*thresholds)


def test_replays_are_eager_calls_with_the_same_random_numbers():
    """To the bit: kernels and random numbers are the same ones. Constants of Python's numbers are part of the graph."""
    captured, eager = Walk(), Walk()
    graph = StepGraph(captured.step, DEVICE, enabled=True)
    assert graph.captured
    assert int(captured.count) == StepGraph.WARM_UP_STEPS + ForbidHostReads.STEPS  # a recording runs nothing
    captured.place.zero_()
    torch.manual_seed(5)
    for _ in range(20):
        graph()
    torch.manual_seed(5)
    for _ in range(20):
        eager.step()
    assert torch.equal(captured.place, eager.place)
    assert torch.equal(captured.noise, eager.noise)
    torch.manual_seed(5)
    graph()
    first = captured.noise.clone()
    graph()
    assert not torch.equal(captured.noise, first)


def test_without_capture_nothing_is_called_and_nothing_recorded():
    walk = Walk()
    graph = StepGraph(walk.step, DEVICE, enabled=False)
    assert (graph.captured, int(walk.count)) == (False, 0)
    graph()
    assert int(walk.count) == 1


@pytest.mark.parametrize("captured", [False, True], ids=["eager", "captured"])
def test_a_branch_is_a_stream_that_waits_and_is_waited_for(captured):
    """Each line spends its time before it writes what the other reads: without the waiting, zeros would be read."""
    branch, streams = Branch(DEVICE), []
    before, beside, after = (torch.zeros(1024, device=DEVICE) for _ in range(3))
    number = torch.zeros((), device=DEVICE)

    def step() -> None:
        for each in (before, beside, after):
            each.zero_()
        torch.cuda._sleep(LONG)
        before.copy_((number + 1.0).expand(1024))
        with branch.fork():
            streams.append(torch.cuda.current_stream(DEVICE).cuda_stream)
            beside.copy_(before).mul_(2.0)
            torch.cuda._sleep(LONG)
            beside.add_(1.0)
        streams.append(torch.cuda.current_stream(DEVICE).cuda_stream)
        branch.join()
        after.copy_(beside)

    graph = StepGraph(step, DEVICE, enabled=captured)
    for value in (1.0, 4.0):
        number.fill_(value)
        graph()
        torch.testing.assert_close(after, torch.full_like(after, 2.0 * (value + 1.0) + 1.0), rtol=0.0, atol=0.0)
    assert len(set(streams[-2:])) == 2


def test_a_step_that_reads_on_the_host_is_refused_before_it_is_captured():
    """So that nothing is broken by it: another step is captured afterwards."""
    numbers = torch.tensor([1.0, -2.0], device=DEVICE)
    with pytest.raises(HostReadError, match="reads a value on the host") as error:
        StepGraph(lambda: numbers[0].item(), DEVICE, enabled=True)
    assert "--no-graph" in "".join(error.value.__notes__)
    assert StepGraph(Walk().step, DEVICE, enabled=True).captured


def test_all_that_the_guard_lets_through_can_be_captured():
    """And gives the same; what only a recording meets is named, too. In a process of its own, which a capture that fails
    leaves unusable.
    """
    program = Path(__file__).with_name("capture_each.py")
    found = subprocess.run([sys.executable, program], capture_output=True, text=True, timeout=300, check=False)
    assert found.stdout.endswith("all done\n"), f"{found.stdout[-2000:]}\n{found.stderr[-4000:]}"


# ---- the step of a task --------------------------------------------------------------------------------------------------


EVENTFUL = [("env.episode_length_s", 0.3), ("commands.resampling_time_s", 0.2), ("domain_rand.push_interval_s", 0.1)]
"""Episodes, commands and pushes that end, change and come within the steps below."""


def config(*overrides, task: str = TASK) -> TaskConfig:
    """A task as a GPU runs it, with a few robots."""
    return task_config(task, [("env.num_envs", ROBOTS), *overrides])


class InTheAir(LeggedRobot):
    """Robots far above the ground, where no contacts come in another order each time; with a term as forks write them."""

    def _init_buffers(self) -> None:
        super()._init_buffers()
        self._spawn = self.numbers.between([0.0, 0.0, 50.0], [0.0, 0.0, 50.0], 3)

    def _reward_mine(self) -> torch.Tensor:
        weights = torch.tensor([1.0, 0.5], device=self.device)
        hips = self.dof_pos[:, [0, 3, 6, 9]] - self.default_dof_pos[[0, 3, 6, 9]]
        return hips.abs().sum(dim=1) + (self.dof_vel[:, [1, 2]] * weights).square().sum(dim=1)


def rollout(task, scale: float, states: dict) -> tuple[list[dict[str, torch.Tensor]], torch.Tensor]:
    """What a task shows at each of STEPS steps from a state under random actions, and how many episodes ended (N,)."""
    generator = torch.Generator().manual_seed(3)
    task.load_state_dict(states)
    torch.manual_seed(7)
    task.reset()
    shown, ended = [], torch.zeros(ROBOTS, dtype=torch.long, device=task.device)
    for step in range(STEPS):
        if step % 5 == 0:
            actions = (scale * torch.randn(ROBOTS, task.num_actions, generator=generator)).to(task.device)
        observations, rewards, dones, extras = task.step(actions)
        shown.append(
            {
                "actor": observations["actor"],
                "critic": observations["critic"],
                "reward": rewards,
                "done": dones,
                "time out": extras["time_outs"],
                "qpos": task.physics.qpos.clone(),
                "qvel": task.physics.qvel.clone(),
            }
        )
        ended += dones
    return shown, ended


@pytest.mark.parametrize(("engine", "apart"), [("mujoco_warp", 0.0), ("newton", 1e-4)])
def test_a_captured_step_is_the_eager_one(engine, apart):
    """To the bit, under the same random numbers: noise, pushes, commands, resets, rewards and all that is seen. Newton adds
    up joint forces atomically, in another order each time.
    """
    cfg = config(*EVENTFUL, ("sim.physics", engine))
    cfg.rewards.scales["mine"] = 1.0
    captured, eager = InTheAir(cfg, CUDA), InTheAir(cfg, CUDA, graph=False)
    assert (captured.captured, eager.captured) == (True, False)
    states = eager.state_dict()
    (found, ended), (expected, _) = rollout(captured, 1.0, states), rollout(eager, 1.0, states)
    assert (ended >= 2).all()
    assert (found[-1]["qpos"][:, 2] > 40.0).all()
    for step, (now, wanted) in enumerate(zip(found, expected, strict=True)):
        for name in now:
            difference = (now[name].float() - wanted[name].float()).abs().max()
            assert difference <= apart, f"{name} at step {step}: differs by up to {difference:.1e}"
    last = found[-1]
    assert last["reward"].isfinite().all()
    assert last["actor"].std() > 0.01


def test_a_captured_step_on_the_ground_is_nearly_the_eager_one():
    """Nothing is random but the start. Sums over contacts come in any order, so that robots part by rounding; those few that
    stumble part further.
    """
    cfg = config(*CALM, ("sim.physics", "mujoco_warp"))
    captured, eager = make_task(cfg, CUDA), make_task(cfg, CUDA, graph=False)
    assert (captured.captured, eager.captured) == (True, False)
    states = eager.state_dict()
    (found, _), (expected, _) = rollout(captured, 0.3, states), rollout(eager, 0.3, states)
    difference = (found[-1]["qpos"] - expected[-1]["qpos"]).abs().amax(dim=1)
    alike = difference < 2e-3
    assert alike.float().mean() > 0.9, f"of {ROBOTS} robots {int(alike.sum())} are alike; median {difference.median():.1e}"
    rewards = (found[-1]["reward"] - expected[-1]["reward"]).abs()[alike]
    assert rewards.median() < 1e-3
    assert (found[-1]["qpos"] - found[0]["qpos"])[:, 7:].abs().max() > 0.1  # they did move
    assert captured.physics.robot_state.contact_forces.norm(dim=2).sum(dim=1).median() > 100.0


def check_alike(captured, eager) -> None:
    """Check that a quarter of a second after the same state most robots are alike in all that is shown."""
    assert (captured.captured, eager.captured) == (True, False)
    states = eager.state_dict()
    found, expected = (rollout(task, 0.3, states)[0][12] for task in (captured, eager))
    for name in found:
        difference = (found[name].float() - expected[name].float()).abs().view(ROBOTS, -1).amax(dim=1)
        alike = difference < 1e-2
        assert alike.float().mean() > 0.9, f"{name}: of {ROBOTS} robots {int(alike.sum())} are alike"
    assert found["actor"].std() > 0.01


AT_ONCE = [0.0, 0.0]
HIT = [
    ("domain_rand.held_goals.grow", AT_ONCE),
    ("domain_rand.forces.punch.grow", AT_ONCE),
    ("domain_rand.forces.punch.interval_s", [0.02, 0.1]),
]
"""Arms that move and punches that come from the start on."""
SENT = [
    ("commands.waypoints.share", 0.5),
    ("commands.ranges.base_height", [0.6, 0.74]),
    ("commands.ranges.base_pitch", [-0.1, 0.2]),
]
"""Waypoints for half of the robots, and heights and pitches of the base."""


@pytest.mark.parametrize(
    ("name", "changes"), [("g1_tracking", []), ("g1_teleop", HIT), ("g1_flat", SENT)], ids=["frames", "arms", "waypoints"]
)
def test_a_captured_humanoid_is_nearly_the_eager_one(name, changes):
    """Frames, goals of arms, punches, waypoints, noise and randomised values are drawn alike."""
    cfg = config(("sim.physics", "mujoco_warp"), *changes, task=name)
    captured = make_task(cfg, CUDA)
    check_alike(captured, make_task(cfg, CUDA, graph=False))
    if changes is HIT:
        assert captured.physics.forces.abs().sum(dim=(1, 2)).count_nonzero() > 0
        assert captured.control.held_offsets.std(dim=0).min() > 0.01
    if changes is SENT:
        assert captured.base_commands.std(dim=0).min() > 0.01


def test_a_captured_tour_of_the_league_is_nearly_the_eager_one(tmp_path):
    """With its first punch, which is in the sixth to the ninth control step."""
    robot = league_robot("g1", tmp_path)
    course = Course.of(range(ROBOTS), robot, np.array([(-0.5, 0.5), (-0.5, 0.5), (-1.0, 1.0)]))
    cfg = config(("sim.physics", "mujoco_warp"), task="g1_teleop")
    cfg = nominal(with_ideal_motors(cfg), rules(cfg, course, "punches", (robot.stiffness, robot.damping)))
    captured, eager = (make_league(course, "punches", cfg, DEVICE, graph, None) for graph in (True, False))
    check_alike(captured, eager)
    assert captured.physics.forces is not None
    assert int(captured.lasted.max()) == STEPS


class ReadsOnTheHost(LeggedRobot):
    def _reward_mine(self) -> torch.Tensor:
        return self.base_pos[:, 2] * (1.0 if self.base_pos[0, 2] > 0.0 else 2.0)


class Counts(LeggedRobot):
    def __init__(self, *args, **kwargs) -> None:
        self.calls = 0
        super().__init__(*args, **kwargs)

    def _reward_mine(self) -> torch.Tensor:
        self.calls += 1
        return self.base_pos[:, 2]


@pytest.mark.parametrize(
    ("kind", "reason"),
    [(ReadsOnTheHost, "_reward_mine: reads a value on the host"), (Counts, r"_reward_mine: self\.calls changed from")],
    ids=["reads", "counts"],
)
def test_a_term_that_no_graph_can_hold_is_named_and_runs_without_one(kind, reason):
    cfg = config()
    cfg.rewards.scales["mine"] = 1.0
    with pytest.raises(TermError, match=reason):
        kind(cfg, CUDA)
    task = kind(cfg, CUDA, graph=False)
    _, rewards, _, _ = task.step(torch.zeros(ROBOTS, task.num_actions))
    assert rewards.isfinite().all()
    assert not task.captured


@pytest.mark.parametrize("task", ["half_cheetah", "humanoid"])
def test_a_task_without_robot_is_captured_and_its_states_are_finite(task):
    """Under random actions, through episodes that end by time or in a fall."""
    made = make_task(config(("env.episode_length_s", 0.5), task=task), CUDA)
    assert made.captured
    assert made.physics.why_library == ""
    ended = 0
    for _ in range(40):
        observations, rewards, dones, _ = made.step(2.0 * torch.rand(ROBOTS, made.num_actions, device=CUDA) - 1.0)
        ended += int(dones.sum())
        assert observations["actor"].isfinite().all()
        assert rewards.isfinite().all()
    assert ended >= ROBOTS
    assert not made.physics.overflowed.any()
    assert made.physics.qvel.abs().max() > 0.1
