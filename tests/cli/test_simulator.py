"""The simulated robot, and the robot's own program on it in another process."""

import json
import os
import subprocess
import sys
import threading
from itertools import pairwise
from pathlib import Path

import imageio.v3 as iio
import mujoco
import numpy as np
import pytest
from helpers import CALM, ENGINE, HANG_S, call

from legged.cli import deploy
from legged.cli.fit_actuator import fit_actuator
from legged.config.robot import TerrainConfig
from legged.config.world import SimConfig
from legged.deploy.udp import UdpRobot
from legged.errors import RunError
from legged.physics import RobotScene
from legged.process.headless import off_screen_library
from legged.registry import make_task, task_config
from legged.robots.robot import load_robot
from legged.simulated_robot.robot import SimulatedRobot
from legged.simulated_robot.server import Link, Server
from legged.terrain import Terrain, TileSpec

POLICIES = Path(__file__).resolve().parents[2] / "resources" / "policies"
SMALL_TERRAIN = [
    ("terrain.num_rows", 3),
    ("terrain.num_cols", 10),
    ("terrain.border_size", 4.0),
    ("terrain.max_init_terrain_level", 2),
]


def stairs(size=0.1):
    cfg = TerrainConfig(mesh_type="height_map", border_size=5.0)
    return Terrain.of_tiles([[TileSpec("stairs_up", size)]], cfg, np.random.default_rng(1))


@pytest.fixture
def simulated():
    return SimulatedRobot(load_robot("anymal_c"), None, SimConfig(dt=0.002))


def test_a_perfect_link_delivers_everything_at_once():
    link = Link(0.0, 0.0, 1)
    link.put(1.0, b"a")
    link.put(1.0, b"b")
    assert link.take(1.0) == [b"a", b"b"]
    assert link.take(2.0) == []


def test_a_late_link_delivers_later():
    link = Link(0.02, 0.0, 1)
    link.put(1.0, b"a")
    link.put(1.01, b"b")
    assert link.take(1.019) == []
    assert link.take(1.021) == [b"a"]
    assert link.take(1.031) == [b"b"]


def test_a_bad_link_loses_the_share_that_it_should():
    """Of 10,000 packets 10 % are 1,000, give or take five standard deviations of 30."""
    link = Link(0.0, 0.1, 1)
    for _ in range(10_000):
        link.put(0.0, b"x")
    assert abs(link.lost - 1000) < 150
    assert len(link.take(0.0)) == 10_000 - link.lost == link.sent - link.lost


def test_motors_follow_the_law_at_every_physics_step(simulated):
    """90 (0.5 - q) - 4 dq at the first joint, no more than 80 N m, of the state before the step."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        simulated.data.qvel[6:] = rng.normal(size=12)
        q, dq = simulated.data.qpos[7:].copy(), simulated.data.qvel[6:].copy()
        simulated.asked = np.array([rng.normal(size=12), np.full(12, 90.0), np.full(12, 4.0)])
        simulated.step()
        wanted = np.clip(90.0 * (simulated.asked[0] - q) - 4.0 * dq, -80.0, 80.0)
        np.testing.assert_allclose(simulated.state({}).torques, wanted)


def test_it_stands_in_its_default_pose_and_lies_without_torque(simulated):
    simulated.asked = np.array([simulated.robot.default_dof_pos, simulated.robot.stiffness, simulated.robot.damping])
    for _ in range(500):
        simulated.step()
    assert abs(simulated.data.qpos[2] - simulated.robot.height) < 0.05
    simulated.asked[:] = 0.0
    for _ in range(500):
        simulated.step()
    assert simulated.report()["lowest_base"] < 0.3
    assert not simulated.report()["fell"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["anymal_c", "anymal_c_flat"])
def test_its_sensors_and_sources_measure_what_the_tasks_do(name):
    """Put where a robot of the task is, on the same ground: the same numbers to the last digits of float32."""
    rough = name == "anymal_c"
    changes = [("env.num_envs", 3), ("init_state.yaw", [-3.0, 3.0]), *ENGINE, *CALM, *(SMALL_TERRAIN if rough else [])]
    task = make_task(task_config(name, changes, on_cpu=True))
    task.reset()
    simulated = SimulatedRobot(task.robot, task.terrain, SimConfig(dt=0.005), scan=task.cfg.terrain.scan)
    points = task.height_scan.points.double().numpy()
    if rough:
        assert np.ptp(task.measured_heights.numpy(), axis=1).any(), "somebody stands before a step"
    for robot in range(3):
        simulated.data.qpos[:], simulated.data.qvel[:] = task.physics._qpos[robot], task.physics._qvel[robot]
        state = simulated.state({"base_lin_vel": None, "heights": points})
        height = float(task.base_pos[robot, 2])
        np.testing.assert_allclose(state.quaternion, task.base_quat[robot], atol=1e-5)
        np.testing.assert_allclose(state.gyro, task.base_ang_vel[robot], atol=1e-5)
        np.testing.assert_allclose(state.positions, task.dof_pos[robot], atol=1e-5)
        np.testing.assert_allclose(state.velocities, task.dof_vel[robot], atol=1e-5)
        np.testing.assert_allclose(state.sources["base_lin_vel"], task.base_lin_vel[robot], atol=1e-5)
        if rough:
            measured = task.measured_heights[robot].numpy()
            same = np.abs(state.sources["heights"] + height - measured) < 1e-4
            assert same.mean() > 0.98, "a point on the edge between two cells may belong to either"
        else:
            np.testing.assert_allclose(state.sources["heights"], -height, atol=1e-5)


def test_its_ground_and_its_time_step_are_its_own():
    simulated = SimulatedRobot(load_robot("anymal_c"), stairs(0.1), SimConfig(dt=0.001))
    assert simulated.model.opt.timestep == 0.001
    # Eight rings of steps lead up from the middle, 0.3 m wide and 0.1 m high.
    points = np.array([[0.0, 0.0], [3.95, 0.0], [4.5, 0.0]]) - simulated.data.qpos[:2]
    ground = simulated.state({"heights": points}).sources["heights"] + simulated.data.qpos[2]
    np.testing.assert_allclose(ground, [-0.9, -0.1, 0.0], atol=0.11)
    assert ground[0] < ground[1] <= ground[2]
    assert simulated.data.qpos[2] == pytest.approx(ground[0] + simulated.robot.height, abs=1e-6)
    # Its contacts are those of C MuJoCo's own model of that ground.
    assert simulated.model.ngeom == RobotScene(simulated.robot, stairs(0.1)).model(SimConfig()).ngeom
    assert mujoco.mj_id2name(simulated.model, mujoco.mjtObj.mjOBJ_GEOM, 0) is not None


def test_a_simulation_that_blows_up_says_so_and_does_not_begin_anew():
    """D gains of 40 N m s/rad on legs of 0.014 kg m^2 are far beyond what steps of 20 ms can hold."""
    simulated = SimulatedRobot(load_robot("anymal_c"), None, SimConfig(dt=0.02))
    simulated.asked[:] = simulated.robot.default_dof_pos, simulated.robot.stiffness, np.full(12, 40.0)

    def ten_seconds():
        for _ in range(500):
            simulated.step()

    with pytest.raises(RunError, match=r"became unstable after \d\.\d\d s at steps of 0\.02 s \(--sim-dt\)"):
        ten_seconds()


@pytest.mark.slow
def test_it_brakes_when_nobody_speaks_to_it_any_more(simulated):
    server = Server(simulated)
    results = []
    thread = threading.Thread(target=lambda: results.append(server.run(1.5)))
    thread.start()
    robot = UdpRobot(f"127.0.0.1:{server.port}")
    assert robot.facts.name == "anymal_c"
    assert simulated.data.time == 0.0, "time stands still until the first command"
    robot.write(simulated.robot.default_dof_pos, simulated.robot.stiffness, simulated.robot.damping)
    thread.join()
    assert simulated.data.time > 0.3
    assert not simulated.asked[1].any()
    np.testing.assert_allclose(simulated.asked[2], simulated.robot.damping, rtol=1e-6)
    assert results[0]["lowest_base"] < 0.45
    assert len(robot.read()) > 50
    robot.close()


@pytest.mark.slow
def test_sources_come_every_fifth_state_at_any_time_step():
    """At 0.35 ms a state comes after 11 steps (4 ms are 11.4), and sources after 5 states, 19.25 ms; 20 ms are 57 steps."""
    server = Server(SimulatedRobot(load_robot("anymal_c"), None, SimConfig(dt=0.00035)))
    thread = threading.Thread(target=lambda: server.run(1.2))
    thread.start()
    robot = UdpRobot(f"127.0.0.1:{server.port}")
    robot.ask({"base_lin_vel": None})
    robot.write(server.robot.robot.default_dof_pos, server.robot.robot.stiffness, server.robot.robot.damping)
    thread.join()
    readings = [reading for reading in robot.read() if reading.time > 0.0 and reading.sources]
    robot.close()
    came = [b.time for a, b in pairwise(readings) if b.sources["base_lin_vel"] is not a.sources["base_lin_vel"]]
    assert len(came) > 5
    np.testing.assert_allclose(np.diff(came), 55 * 0.00035, atol=1e-6)


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--terrain", "stairs"], "error: --terrain: there is no terrain type 'stairs'; did you mean"),
        (["--size", "0.1"], "error: --size: a plane has no size"),
        (["--terrain", "slope_up", "--size", "90"], "error: --size: must be between 0 and 80, got 90"),
        (["--terrain", "stairs_up", "--size=-0.1"], "error: --size: must be between 0 and 100, got -0.1"),
        (["--loss", "1.5"], "error: --loss: must be between 0 and 0.9, got 1.5"),
        (["--latency", "nan"], "error: --latency: must be between 0 and 1, got nan"),
        (["--sim-dt", "0"], "error: --sim-dt: must be between 0.0001 and 0.02, got 0"),
        (["--commands", "none.txt"], "error: --commands: there is no file none.txt"),
        (["nobody"], "error: POLICY: there is no task and no run 'nobody'"),
        (["--robot", "anymal_x"], "error: --robot: there is no robot 'anymal_x'; did you mean"),
        (["--max-tilt", "-1"], "error: --max-tilt: must be between 0.1 and 1.6, got -1"),
    ],
)
def test_a_wrong_flag_ends_the_command_with_one_line(flags, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    policy = [] if flags == ["nobody"] else ["anymal_c_flat"]
    assert call(deploy.sim.main, [*policy, *flags]) == 2
    shown = capsys.readouterr().err
    assert shown.startswith(says)
    assert len(shown.splitlines()) == 1


@pytest.mark.slow
def test_a_film_has_a_picture_for_each_pose(tmp_path):
    if off_screen_library() is None:
        pytest.skip("nothing draws off screen here")
    robot = load_robot("anymal_c")
    pose = np.array([*robot.default_qpos[:2], robot.height, *robot.default_qpos[3:]])
    np.save(tmp_path / "poses.npy", [[0.04 * i, *pose] for i in range(4)])
    rows = {"times": np.array([0.0, 0.1]), "state": np.array([1, 2]), "states": np.array(["idle", "damping", "stand"])}
    np.savez(tmp_path / "log.npz", **rows)
    deploy.make_film(robot, None, tmp_path)
    frames = iio.imread(tmp_path / "film.mp4")
    assert frames.shape == (4, 360, 640, 3)
    assert frames.std() > 10.0


@pytest.mark.parametrize("count", [0, 1])
def test_a_run_too_short_for_a_film_has_none_and_says_so(count, tmp_path, capsys):
    """One pose lasts for no time, so a film of it would have 0 pictures a second."""
    robot = load_robot("anymal_c")
    np.save(tmp_path / "poses.npy", np.array([[0.04, *robot.default_qpos]] * count))
    np.savez(tmp_path / "log.npz", times=np.array([0.0]), state=np.array([0]), states=np.array(["idle"]))
    (tmp_path / "film.mp4").write_bytes(b"of the run before")
    deploy.make_film(robot, None, tmp_path)
    assert "no film, because the run was too short" in capsys.readouterr().out
    assert not (tmp_path / "film.mp4").exists()


def test_an_unknown_robot_is_not_simulated(capsys):
    assert call(deploy.robot.main, ["anymal_x"]) == 2
    assert "error: ROBOT: there is no robot 'anymal_x'" in capsys.readouterr().err


STAIRS = """
0 damping
0.2 stand
2.2 walk
2.4 0.9 0 0
8 0 0 0
8.5 damping
9 quit
"""


@pytest.mark.slow
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="a robot and its program need a core each")
def test_the_program_walks_up_stairs_in_another_process(tmp_path):
    """The shipped policy that needs no more than a robot measures: 50 Hz, of which cycles none was late, 1 % of packets lost,
    up 0.1 m steps in C MuJoCo at 2 ms, with motors that are 10 ms late and rub. What a cycle takes is not judged here: other
    tests share the cores. `legged fit-actuator` reads what the program logged, and finds the friction and the delay.
    """
    (tmp_path / "walk.txt").write_text(STAIRS)
    command = [sys.executable, "-m", "legged", "deploy", "sim", "anymal_c_proprio"]
    command += ["--commands", "walk.txt", "--terrain", "stairs_up", "--size", "0.1", "--loss", "0.01", "--out", "out"]
    command += ["--max-missed", "50", "--max-age", "0.5", "--stand-seconds", "1.9"]
    command += ["control.actuator.coulomb_friction={HAA: 1.5}", "control.actuator.delay=[2, 2]"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=HANG_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert not report["fell"]
    assert report["forward"] > 2.5
    assert report["climbed"] > 0.0
    assert 0.002 < report["lost"] / (report["sent"] + report["received"]) < 0.03
    log = np.load(tmp_path / "out" / "log.npz")
    assert list(log["notes"]) == ["idle -> damping", "damping -> stand", "stand -> walk", "walk -> damping"]
    walking = log["state"] == list(log["states"]).index("walk")
    rate = np.diff(log["times"][walking])
    assert np.median(rate) == pytest.approx(0.004)
    assert np.isfinite(log["torques"]).all()
    assert len(log["cycle_times"]) > 0.8 * 50 * 9
    assert (tmp_path / "logs" / "deploy" / "anymal_c_proprio" / "exported" / "policy.weights").is_file()
    written = str(tmp_path / "out" / "log_actuators.npz")
    assert call(fit_actuator.main, [written, "--joints", "HAA", "--updates", "5", "--out", str(tmp_path / "fit")]) == 0
    fit = json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert 0.006 < fit["drive"]["delay"] < 0.03
    assert 1.0 < fit["drive"]["breakaway"] < 2.0
    assert fit["held_out"]["parametric"]["rmse"] < 0.5 * fit["held_out"]["ideal PD"]["rmse"]
