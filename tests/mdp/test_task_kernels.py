"""Kernels of the task do what the same formula does in torch, bit by bit."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from legged.config.legged import CommandCurriculumConfig, CommandsConfig
from legged.config.randomization import DrawConfig, ForceConfig, KickConfig
from legged.config.robot import HeightMapConfig, RobotControlConfig, RobotDomainRandConfig, TerrainConfig
from legged.mdp.command_curriculum import CommandCurriculum
from legged.mdp.commands import Commands
from legged.mdp.contacts import FeetContacts
from legged.mdp.control import Control
from legged.mdp.disturbances import Disturbances
from legged.mdp.height_map_errors import HeightMapErrors
from legged.mdp.kernels.task import TaskKernels
from legged.mdp.random_pool import RandomPool
from legged.mdp.randomization import Randomization
from legged.mdp.rewards import Rewards
from legged.mdp.sensors import HeightScan
from legged.mdp.terrain_curriculum import TerrainCurriculum
from legged.robots.robot import load_robot
from legged.state import state_of
from legged.terrain import Terrain

N, DT, CPU = 64, 0.02, torch.device("cpu")


def pair(make):
    """The part of a task without and with kernels, each made from the same random numbers."""
    parts = []
    for kernels in (None, TaskKernels(nullcontext)):
        torch.manual_seed(3)
        parts.append(make(kernels))
    return parts


def assert_same(parts) -> None:
    for one, other in zip(*(state_of(part).values() for part in parts), strict=True):
        torch.testing.assert_close(one, other, rtol=0.0, atol=0.0, equal_nan=True)


def chance(share: float, *shape: int) -> torch.Tensor:
    return torch.rand(*shape) < share


def test_joints_are_held_alike_at_their_limits_too():
    robot = load_robot("anymal_c")
    laws = pair(lambda kernels: Control(robot, RobotControlConfig(), torch.zeros(N, 12), 0.005, kernels))
    actions, state = torch.randn(N, 12), torch.randn(2, N, 30)
    state[0, 3, 10] = torch.nan
    torques = []
    for law in laws:
        law.set_actions(actions)
        torques.append(law.compute(state[0, :, 7:19], 5.0 * state[1, :, 6:18]))
    assert torques[1] is laws[1].torques
    torch.testing.assert_close(*torques, rtol=0.0, atol=0.0, equal_nan=True)
    assert (torques[0].abs() == 80.0).any()
    assert torques[0].isnan().sum() == 1


def test_feet_swing_and_stand_alike():
    parts = pair(lambda kernels: FeetContacts(N, 4, DT, CPU, kernels))
    shapes = torch.zeros(N, 13, 3)
    for step in range(40):
        shapes[:, :, 2] = 2.0 * torch.rand(N, 13) * chance(0.5, N, 13)
        for part in parts:
            part.update(shapes[:, 3:13:3])
            part.reset(torch.arange(N) == step)
        assert_same(parts)
    assert min(parts[0].last_air_time.unique().numel(), parts[0].contact_time.unique().numel()) > 5


@pytest.mark.parametrize("heading", [False, True])
def test_commands_are_renewed_and_steered_alike(heading):
    cfg = CommandsConfig(heading_command=heading, resampling_time_s=0.2, standing_share=0.3, single_axis_share=0.3)
    parts = pair(lambda kernels: Commands(cfg, N, DT, CPU, kernels))
    for step in range(30):
        quat = torch.nn.functional.normalize(torch.randn(N, 4), dim=1)
        reset = chance(0.1, N)
        for part in parts:
            torch.manual_seed(step)
            part.numbers.draw()
            part.ranges.copy_(part.full_ranges * (0.3 if step < 10 else 1.0))  # as a curriculum does
            part.draw()
            part.held.copy_(torch.arange(N) % 7 == 0)
            part.steered.copy_(torch.arange(N) % 5 > 0)
            part.update(reset, quat)
        for one, other in zip(*(state_of(part).values() for part in parts), strict=True):
            # Sines of the two libraries differ in the last place, and what is below a rate of 0.1 with them hardly ever.
            torch.testing.assert_close(one, other, rtol=0.0, atol=1e-5 if heading and one.is_floating_point() else 0.0)
    assert parts[0].is_moving.any()
    assert not parts[0].is_moving.all()


def test_command_ranges_widen_alike():
    cfg = CommandCurriculumConfig(enabled=True, start=0.3, window_s=0.1)
    full = torch.tensor([[-1.0, 1.0], [-0.5, 0.5], [-0.6, 1.2]])
    parts = pair(lambda kernels: CommandCurriculum(cfg, full, DT, kernels))
    seen = set()
    for _ in range(30):
        commands = 2.0 * torch.rand(N, 3) - 1.0
        velocity, valid = commands * (0.6 + 0.4 * torch.rand(N, 3)), chance(0.9, N)
        velocity[~valid] = torch.nan
        for part in parts:
            part.update(commands, velocity, 2.0 * velocity, valid)
        assert_same(parts)
        seen.add(tuple(parts[0].share.tolist()))
    assert len(seen) > 3


def ground() -> Terrain:
    names = {name: 0.25 for name in ("rough_slope_up", "stairs_up", "stairs_down", "obstacles")}
    return Terrain.build(replace(TerrainConfig(), mesh_type="height_map", proportions=names, num_rows=4, num_cols=8), 1)


@pytest.mark.slow
@pytest.mark.parametrize("scan", ["lowest", "own", "highest"])
def test_the_ground_is_scanned_alike_on_it_beyond_it_and_nowhere(scan):
    terrain = ground()
    pose = base_pos, base_quat = 100.0 * torch.rand(N, 3) - 30.0, torch.nn.functional.normalize(torch.randn(N, 4), dim=1)
    parts = pair(lambda kernels: HeightScan(TerrainConfig(scan=scan), terrain, pose, kernels))
    base_pos[1, 0], base_pos[2, 1], base_quat[3] = torch.nan, torch.inf, torch.nan
    for part in parts:
        part.update()
    # Where a point lies on the border of two cells, sines of two libraries may put it into either.
    same = torch.cat([parts[0].heights == parts[1].heights, (parts[0].ground == parts[1].ground).unsqueeze(1)], dim=1)
    assert same.float().mean() > 0.999
    assert parts[0].heights.unique().numel() > 50


def test_robots_move_between_levels_alike():
    terrain = ground()
    parts = pair(lambda kernels: TerrainCurriculum(TerrainConfig(max_init_terrain_level=3), terrain, N, 1.0, CPU, kernels))
    for step in range(16):
        ended, valid, left = chance(0.4, N), chance(0.9, N), torch.randint(0, 2, (N,))
        commands, velocity = 4.0 * torch.randn(N, 4), 4.0 * torch.randn(N, 3)
        commands[::5], velocity[~valid] = 0.0, torch.nan
        for part in parts:
            torch.manual_seed(step)
            part.draw()
            part.update(ended, valid, commands, velocity, left)
        assert torch.equal(parts[0].levels, parts[1].levels)
        torch.testing.assert_close(parts[0].origins, parts[1].origins, rtol=0.0, atol=0.0)
        torch.testing.assert_close(parts[0].way, parts[1].way)
    assert parts[0]._sums[1:].sum(dim=1).min() > 10.0


@pytest.mark.parametrize("only_positive", [False, True])
def test_rewards_are_added_alike(only_positive):
    terms = torch.zeros(4, N)
    functions = {name: lambda i=i: terms[i] for i, name in enumerate(("walk", "rest", "termination", "broken"))}
    functions["rest"] = lambda: terms[1].double()  # a term of numbers of another kind
    scales = {"walk": 1.0, "rest": -2.0, "termination": -50.0, "broken": 3.0}
    parts = pair(lambda kernels: Rewards(functions, scales, DT, only_positive, torch.zeros(N), kernels))
    for _ in range(5):
        terms.copy_(torch.randn(4, N))
        terms[3, :4] = torch.tensor([torch.nan, torch.inf, 1e12, -torch.inf])
        valid = chance(0.8, N)
        for part in parts:
            part.compute(valid)
        assert_same(parts)
        assert parts[0].terms_finite.equal(parts[1].terms_finite)
        assert parts[0].last.equal(parts[1].last)
        torch.testing.assert_close(parts[0].total, parts[1].total, rtol=1e-6, atol=1e-6)
    assert not parts[0].terms_finite[3, :4].any()


def varying(*names, when="interval"):
    """Entries of `domain_rand.ranges` that are drawn again."""
    return {name: DrawConfig(range=(0.5, 1.5), when=when, interval_s=0.1 if when == "interval" else 0.0) for name in names}


class NoPhysics:
    """What the parts below ask of an engine."""

    def __init__(self) -> None:
        self.forces, self.pushed = torch.zeros(N, 3, 6), torch.zeros(N, 6)
        self.model = SimpleNamespace(jnt_bodyid=[1])

    def push(self, mask, delta):
        self.pushed += torch.where(mask[:, None], delta, 0.0)

    def choose_variants(self, mask, chosen):
        self.chosen = torch.where(mask, chosen, -1)


@pytest.mark.parametrize("chosen", [(), ("link_mass",), ("link_mass", "alone")])
def test_numbers_are_drawn_again_alike(chosen):
    """With masses of links, worlds choose among models of which constants were derived, also where nothing else is drawn."""
    ranges = {**varying("p_gain", "velocity_limit"), **varying("d_gain", when="reset"), "joint_offset": (0.5, 1.5)}
    if chosen:
        ranges = {**varying("link_mass", when="reset"), **({} if "alone" in chosen else ranges)}
    numbers, parts, engines = [], [], []
    for kernels in (None, TaskKernels(nullcontext)):
        torch.manual_seed(3)
        numbers.append(RandomPool(N, CPU))
        engines.append(NoPhysics())
        parts.append(Randomization(ranges, N, CPU))
        parts[-1].widen(dict.fromkeys(ranges, 3))
        parts[-1].prepare(engines[-1], numbers[-1], DT, 24, kernels)
    for step in range(20):
        reset = chance(0.1, N)
        for part, drawn, engine in zip(parts, numbers, engines, strict=True):
            torch.manual_seed(step)
            drawn.draw()
            part.draw()
            before = part.drawn.clone()
            part.redraw(reset)
            part.rewrite(engine)
        assert_same(parts)
        changed = (parts[1].drawn != before).any(dim=1)
        torch.testing.assert_close(changed, parts[1]._any_due)
    assert 0 < changed.sum() < N
    assert parts[1].steps == 20.0


@pytest.mark.parametrize("of", ["kicks and forces", "kicks", "forces"])
def test_kicks_and_forces_come_and_end_alike(of):
    """Two of each: what a robot gets of two kicks at once is their sum, and so are two forces on one body."""
    kick = KickConfig(interval_s=(0.1, 0.3), x=(-1.0, 1.0), yaw=(-0.5, 0.5))
    trip = KickConfig(interval_s=(0.2, 0.2), y=(-1.0, 1.0), grow=(0.0, 1.0))
    pull = ForceConfig(body="", interval_s=(0.05, 0.2), duration_s=(0.04, 0.1), y=(-50.0, 50.0))
    lift = ForceConfig(body="", interval_s=(0.1, 0.1), duration_s=(0.02, 0.1), z=(0.0, 50.0))
    cfg = RobotDomainRandConfig(
        kicks={"kick": kick, "trip": trip} if "kicks" in of else {},
        forces={"pull": pull, "lift": lift} if "forces" in of else {},
    )
    numbers, parts, engines = [], [], []
    for kernels in (None, TaskKernels(nullcontext)):
        torch.manual_seed(3)
        numbers.append(RandomPool(N, CPU))
        engines.append(NoPhysics())
        parts.append(Disturbances(cfg, engines[-1], DT, 24, numbers[-1], kernels))
    kicked = 0
    for step in range(40):
        mask = chance(0.9, N)
        for part, drawn, engine in zip(parts, numbers, engines, strict=True):
            torch.manual_seed(step)
            engine.pushed.zero_()
            drawn.draw()
            part.draw()
            part.act(engine, mask)
        assert_same(parts)
        torch.testing.assert_close(engines[1].forces, engines[0].forces, rtol=0.0, atol=0.0)
        torch.testing.assert_close(engines[1].pushed, engines[0].pushed, rtol=1e-6, atol=1e-7)
        kicked += int((engines[1].pushed[:, 0] != 0.0).sum())
    assert parts[1].steps == 40.0
    assert (kicked > 0) == ("kicks" in of)
    if "kicks" in of:
        assert 40 * N * DT / 0.3 * 0.7 < kicked < 40 * N * DT / 0.1
    both = engines[1].forces[:, 1, 1:3] != 0.0
    assert both.any(dim=0).all() == ("forces" in of)
    assert not engines[1].forces[:, [0, 2]].any()


@pytest.mark.parametrize(
    "errors",
    [
        {"offset": 0.05, "shift": 0.1, "drift": 0.01, "shift_drift": 0.02, "holes": 0.1, "lost": 0.2},
        {"offset": 0.05, "holes": 0.3},
        {"lost": 0.4},
        {"shift": 0.1, "drift": 0.02},
    ],
    ids=["all", "constant", "lost", "without holes"],
)
def test_maps_go_wrong_alike(errors):
    cfg = TerrainConfig(measured_points_x=(-0.1, 0.1, 0.3), measured_points_y=(0.0,))
    numbers, maps = [], []
    for kernels in (None, TaskKernels(nullcontext)):
        numbers.append(RandomPool(N, CPU))
        pose = (torch.zeros(N, 3), torch.zeros(N, 4))
        scan = HeightScan(cfg, None, pose, kernels)
        maps.append(HeightMapErrors(HeightMapConfig(**errors), scan, pose, torch.neg, DT, numbers[-1], kernels))
    for step in range(5):
        begun = chance(1.0 if step == 0 else 0.3, N)
        for one, drawn in zip(maps, numbers, strict=True):
            torch.manual_seed(step)
            drawn.draw()
            one.advance(begun)
        for name in ("error", "rate", "holes"):
            torch.testing.assert_close(*(getattr(one, name) for one in maps), rtol=0.0, atol=0.0)
    error, holes = maps[1].error, maps[1].holes
    assert (error[:, 2].abs().max() > 0.0) == (errors.get("offset", 0.0) + errors.get("drift", 0.0) > 0.0)
    missing = {"holes": 0.0, "lost": 0.0} | errors
    assert holes.shape == (N, 3 if missing["holes"] or missing["lost"] else 0)
    share = missing["holes"] + (1.0 - missing["holes"]) * missing["lost"]
    assert not holes.numel() or 0.3 * share < holes.float().mean() < 3.0 * share
    if missing["lost"]:
        whole = holes.all(dim=1)
        assert 0.3 * missing["lost"] < whole.float().mean() < 3.0 * missing["lost"]
        assert missing["holes"] or (holes.any(dim=1) == whole).all()
