"""Keys of the viewer -> commands; on terrain, tiles."""

import contextlib

import mujoco
import pytest
import torch
from helpers import CALM, ENGINE

from legged.config import override
from legged.play.playground import SETTING, Playground
from legged.play.viewer import BACKSPACE, COMMA, DOWN, LEFT, NEXT, RIGHT, SPACE, UP, Keyboard, begin_anew, view
from legged.registry import make_task, task_config
from legged.rendering.ghost import GHOST


def test_each_key_moves_its_own_axis_by_its_step():
    keyboard = Keyboard([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])
    for key in (UP, UP, UP, DOWN, COMMA, LEFT, LEFT, RIGHT):
        keyboard.press(key)
    assert keyboard.command == [0.2, 0.1, 0.2]
    keyboard.press(SPACE)
    assert keyboard.command == [0.0, 0.0, 0.0]


def test_commands_stay_inside_the_trained_ranges():
    keyboard = Keyboard([-0.25, -1.0, -1.0], [0.35, 1.0, 1.0])
    for _ in range(9):
        keyboard.press(UP)
    assert keyboard.command[0] == 0.35
    for _ in range(9):
        keyboard.press(DOWN)
    assert keyboard.command[0] == -0.25


def test_other_keys_do_nothing_and_backspace_asks_for_a_new_start():
    keyboard = Keyboard([-1.0] * 3, [1.0] * 3)
    keyboard.press(ord("Q"))
    assert keyboard.command == [0.0, 0.0, 0.0]
    assert not keyboard.restart
    keyboard.press(BACKSPACE)
    assert keyboard.restart


@pytest.mark.slow
def test_n_goes_on_to_the_next_tile(capsys):
    cfg = task_config("anymal_c", [*ENGINE, *CALM], on_cpu=True)
    playground = Playground.of(cfg, None, None)
    cfg = override(cfg, [*SETTING, *playground.changes(cfg), ("env.num_envs", 2)])
    torch.set_num_threads(1)
    task = make_task(cfg, terrain=playground.build(cfg))
    keyboard = Keyboard([-1.0] * 3, [1.0] * 3)
    for tile in ("stairs_up", "stairs_down", "slope_up"):
        begin_anew(task, playground, keyboard)
        assert not keyboard.restart
        assert capsys.readouterr().out.startswith(f"{tile}, ")
        away = task.base_pos[0, :2] - torch.tensor(task.terrain.origins[0, column_of(playground, tile), :2])
        assert away.abs().max() <= 0.3
        keyboard.press(NEXT)
        assert keyboard.restart


def column_of(playground: Playground, name: str) -> int:
    """Where a type is."""
    return [spec.type for spec in playground.rows[0]].index(name)


def test_on_a_plane_robots_just_begin_anew(capsys):
    cfg = task_config("anymal_c_flat", [*ENGINE, *CALM, ("env.num_envs", 1)], on_cpu=True)
    task = make_task(cfg)
    task.step(torch.zeros(1, 12))
    keyboard = Keyboard([-1.0] * 3, [1.0] * 3)
    keyboard.press(BACKSPACE)
    begin_anew(task, None, keyboard)
    assert int(task.episode_length_buf[0]) == 0
    assert not keyboard.restart
    assert capsys.readouterr().out == ""


class FakeWindow:
    """A window that is open for five pictures, in whose third somebody presses backspace."""

    def __init__(self, data, press, scene=None) -> None:
        self.data, self.press, self.cam, self.seen = data, press, mujoco.MjvCamera(), []
        self.opt, self.user_scn = mujoco.MjvOption(), scene

    def is_running(self) -> bool:
        if len(self.seen) == 3:
            self.press(BACKSPACE)
        return len(self.seen) < 5

    def lock(self):
        return contextlib.nullcontext()

    def sync(self) -> None:
        self.seen.append(self.data.qpos.copy())


def test_a_task_without_commands_is_shown_as_it_is_simulated(monkeypatch):
    task = make_task(task_config("half_cheetah", [*ENGINE, ("env.num_envs", 2)], on_cpu=True))
    windows, lengths = [], []

    @contextlib.contextmanager
    def launch(model, data, key_callback, **_):
        windows.append(FakeWindow(data, key_callback))
        yield windows[0]

    def act(_observations):
        lengths.append(int(task.episode_length_buf[0]))
        return torch.full((2, 6), 0.5)

    monkeypatch.setattr("mujoco.viewer.launch_passive", launch)
    view(task, act)
    assert lengths == [0, 1, 2, 0, 1]  # it began anew
    assert abs(torch.tensor(windows[0].seen[-1]) - task.physics.qpos[0]).max() < 1e-5
    assert windows[0].cam.trackbodyid == 1


def test_a_tracker_is_shown_beside_its_reference(monkeypatch):
    task = make_task(task_config("g1_tracking", [*ENGINE, ("env.num_envs", 1)], on_cpu=True))
    scenes, shapes = [], []

    @contextlib.contextmanager
    def launch(model, data, key_callback, **_):
        scenes.append(mujoco.MjvScene(model, 1000))
        yield FakeWindow(data, key_callback, scenes[0])

    def act(_observations):
        shapes.append(scenes[0].ngeom)
        return torch.zeros(1, task.num_actions)

    monkeypatch.setattr("mujoco.viewer.launch_passive", launch)
    view(task, act)
    assert shapes[0] == 0
    assert shapes[1] > task.robot.num_dof
    assert set(shapes[1:]) == {shapes[1]}  # each picture replaces the last one's ghost
    assert {geom.rgba[3] for geom in scenes[0].geoms[: shapes[1]]} == {GHOST[3]}
