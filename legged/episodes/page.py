"""The page of an episode: one HTML file with a film, numbers, plots, and the script that draws the plots. For the film,
recorded states are written into a task with one robot and drawn as in `play`. If nothing can be rendered, the page draws the
positions of the bodies as a stick figure.
"""

import base64
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from PIL import Image

from legged.config import TaskConfig, has_robot, override
from legged.envs import BaseTask, is_velocity_task
from legged.episodes.ranking import Figures, listing
from legged.episodes.stored import Episodes, joint_unit
from legged.errors import ConfigError, RunError
from legged.evaluation.reports import render
from legged.evaluation.result_file import changes_text
from legged.figures import COLORS, without_common_words
from legged.play.playground import Playground
from legged.process.paths import relative, write_text
from legged.registry import make_task
from legged.rendering.camera import RobotsCamera, camera_of

WIDTH, HEIGHT = 640, 360
"""Size of a picture [pixels]."""
FPS, MOST_PICTURES = 25.0, 400
"""Pictures per second, and the largest number of pictures of an episode. Long episodes have fewer pictures per second."""
FILL, GLIDE = 0.5, 0.3
"""The robot fills the share `FILL` of the picture's width or height. In each picture, the point that the camera looks at
moves by the share `GLIDE` of its distance to the robot."""
QUALITIES = (80, 70, 60, 50, 40, 30, 20, 15, 10)
"""JPEG qualities. The first one with which all pictures of an episode fit into BUDGET_MB is taken."""
BUDGET_MB = 3.0
"""Largest total size of the pictures of a page before base64 coding, which adds a third [MB]."""
OTHERS = "#BBBBBB"
MOST_PARTS = 7
"""The `MOST_PARTS` largest reward parts have their own colours. All other parts are summed."""
MOST_LINES = 8
"""Largest number of lines of a plot."""
LEG = re.compile(r"(?i)[lr]|[lr][fh]|[bfhmr][lr]|left|right|front|rear|hind|back")
"""Pattern of the words in a joint's name that stand for its leg."""


def write_page(folder: Path, episodes: Episodes, figures: Figures, number: int, film: dict[str, Any]) -> None:
    """Write the page of an episode, episode_<number>.html, into `folder`. `film` is the result of `Projector.show`.

    Raises:
        RunError: the page can't be written.
    """
    about, steps, panels = episodes.about, int(episodes.lengths[number]), Panels(episodes, number)
    sections = panels.sections()
    ended = f"{'failed' if figures.failed[number] else 'ended'} after {figures.values['length'][number]:.2f} s"
    what = "noise, pushes and randomisation"
    disturbed = f"{what} as trained" if about.get("as_trained") else f"without {what}"
    conditions = ", but with ".join(filter(None, (disturbed, changes_text(about))))

    heads, (row,) = listing(figures, [number])
    facts = [("at the joint" if head == "joint" else head, cell) for head, cell in zip(heads, row, strict=True)][2:]
    facts += [("robot", str(int(episodes["robot"][number]))), ("steps", f"{steps} of {episodes.dt:g} s")]
    if about.get("held_command"):
        facts.append(("command held [m/s, rad/s]", ", ".join(f"{value:g}" for value in about["held_command"])))
    facts += [(name, str(about.get(name, ""))) for name in ("device", "seed")]

    sums = np.nan_to_num(episodes.of(number)["reward_parts"]).sum(axis=0, dtype=np.float64)
    names, series = episodes.columns("reward_parts"), {}
    returns = [(f"return of {names[i]}", f"{sums[i]:.2f}") for i in np.argsort(-np.abs(sums), kind="stable")]
    for name, array in panels.arrays.items():  # each array is written as little-endian 32-bit floats in base64
        rows = array.reshape(len(array), -1)
        values = base64.b64encode(rows.astype("<f4").tobytes()).decode("ascii")
        series[name] = {"values": values, "columns": rows.shape[1]}
    page = render(
        "episode.html",
        title=f"{about['task']}, episode {number}: {ended} by {', '.join(figures.ended[number])}",
        summary=f"{about['checkpoint']} of {about.get('run', '')}, {about.get('physics', '')}; {conditions}",
        tables=[facts, returns],
        data={
            "steps": steps,
            "dt": episodes.dt,
            "film": film,
            "series": series,
            "sections": sections,
        },
    )
    path = folder / f"episode_{number:03d}.html"
    write_text(path, page)
    print(f"page {relative(path)} ({len(page) / 1e6:.1f} MB)")


# ---- film --------------------------------------------------------------------------------------------------------------


class Projector:
    """Renderer of recorded episodes. The task of the episodes is built once, with one robot in C MuJoCo."""

    def __init__(self, episodes: Episodes, cfg: TaskConfig) -> None:
        """Build the task of the configuration `cfg` on the ground of the episodes.

        Raises:
            ConfigError: the task no longer exists, or its model has changed.
        """
        self.episodes = episodes
        alone = [("env.num_envs", 1), ("sim.physics", "mujoco"), ("sim.solver", "mujoco"), ("sim.threads", 1)]
        ground = episodes.about.get("ground")
        terrain = None
        if ground is not None and has_robot(cfg):
            playground = Playground.of(cfg, ground["terrain"], ground["difficulty"])
            terrain = None if playground is None else playground.build(cfg)
        self.task: BaseTask = make_task(override(cfg.trained(), alone), "cpu", False, terrain)
        model = self.task.physics.model
        for name, width in (("qpos", model.nq), ("qvel", model.nv)):
            if episodes[name].shape[1] != width:
                raise ConfigError(f"{cfg.task}: its model has changed since the recording: {name} now has {width} numbers")

    def show(self, number: int) -> dict[str, Any]:
        """Return the film of an episode for its page. `pictures` are JPEGs in base64, and `every` is the number of steps from
        one picture to the next. If nothing can be rendered, the film has no `pictures`. It then has the reason `why`, and
        for a stick figure of B bodies their `parents` and their `places` (T', B, 3) at T' steps, in the world frame [m].
        """
        steps = int(self.episodes.lengths[number])
        every = max(1, round(1.0 / (FPS * self.episodes.dt)), -(-steps // MOST_PICTURES))
        shown = list(range(0, steps, every))
        try:
            return {"every": every, "width": WIDTH, "height": HEIGHT, "pictures": self._pictures(number, shown)}
        except RunError as error:
            return {"every": every, "why": str(error), **self._stick_figure(number, shown)}

    def _pictures(self, number: int, shown: list[int]) -> list[str]:
        camera, frames = camera_of(self.task, 1, WIDTH, HEIGHT), []
        if isinstance(camera, RobotsCamera):
            camera.come_near(FILL, GLIDE)
            camera.ghost = None  # no reference is recorded
        try:
            for step in shown:
                self._put(self.episodes.of(number), step)
                frames.append(Image.fromarray(camera.picture()))
        finally:
            camera.close()
        for quality in QUALITIES:
            found = [_jpeg(frame, quality) for frame in frames]
            if sum(map(len, found)) <= BUDGET_MB * 1e6:
                break
        return [base64.b64encode(picture).decode("ascii") for picture in found]

    def _put(self, one: dict[str, np.ndarray], step: int) -> None:
        """Put the robot into the state after a recorded step, and set the recorded command."""
        task = self.task
        qpos, qvel = (torch.as_tensor(np.nan_to_num(one[name][step : step + 1])) for name in ("qpos", "qvel"))
        task.physics.write(torch.ones(1, dtype=torch.bool), qpos, qvel)
        task.physics.refresh()
        if is_velocity_task(task):
            task.commands[:, :3].copy_(torch.as_tensor(one["command"][step]))

    def _stick_figure(self, number: int, shown: list[int]) -> dict[str, Any]:
        model = self.task.physics.model
        data, places = mujoco.MjData(model), []
        moved = np.flatnonzero(model.body_weldid != 0)  # bodies welded to the world, such as terrain, are left out
        for qpos in np.nan_to_num(self.episodes.of(number)["qpos"][shown]):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            places.append(data.xpos[moved])
        rows = {body: row for row, body in enumerate(moved)}
        parents = [rows.get(parent, -1) for parent in model.body_parentid[moved]]
        return {"parents": parents, "places": np.round(np.array(places), 3).tolist()}


def _jpeg(frame: Image.Image, quality: int) -> bytes:
    written = io.BytesIO()
    frame.save(written, "JPEG", quality=quality, optimize=True)
    return written.getvalue()


# ---- plots -------------------------------------------------------------------------------------------------------------


class Panels:
    """The plots of one episode, and the arrays that the plots show."""

    def __init__(self, episodes: Episodes, number: int) -> None:
        self.episodes, self.one, self.joints = episodes, episodes.of(number), episodes.about["joints"]
        self.arrays: dict[str, np.ndarray] = {}
        """Name of an array -> (T, K) values."""

    def sections(self) -> list[dict[str, Any]]:
        """Return the sections of the page in order (see `_section`). If the task multiplies rewards by the control step,
        reward parts are drawn per second.
        """
        legged, one = "command" in self.one, self.one
        if legged:
            found = [self._velocities(), self._feet(), self._base(), self._rewards()]
        else:
            speeds = self._undriven("qvel", "free_qvel", "velocities without a motor", "m/s or rad/s")
            positions = self._undriven("qpos", "free_qpos", "positions without a motor", "m or rad")
            found = [_section("Generalised coordinates", [*speeds, *positions], wide=True), self._rewards()]
        if "torque" in one and self.joints:
            note = "At the end of each control step. Dotted lines are the limits of the motors."
            found.append(self._by_joint("Torques", "torque", "max_torque", "torque", note))
        if "joint_pos" in one and self.joints:
            note = "Dotted lines are the joints' stops, if the plot's range contains them."
            found.append(self._by_joint("Joint positions", "joint_pos", "range", "position", note))
            found.append(self._by_joint("Joint velocities", "joint_vel", "max_velocity", "velocity", "", open=False))
        if legged:
            passive = self._undriven("qpos", "passive", "position", "rad, m or 1", first=7)
            found.append(_section("Passive joints", passive, note="No motor drives them.", open=False))
        self.arrays["action"], names = one["action"], self.episodes.columns("action")
        groups = [(kind, self._lines("action", names, members)) for kind, members in groups_of(names)]
        found.append(_section("Actions", [_panel(f"action, {kind}", "1", lines) for kind, lines in groups], open=False))
        return [section for section in found if section["panels"]]

    # ---- legged robots ---------------------------------------------------------------------------------------------

    def _velocities(self) -> dict[str, Any]:
        self.arrays |= {name: self.one[name] for name in ("command", "base_lin_vel", "base_ang_vel")}
        lines = []
        for axis, (name, series) in enumerate((("vx ", "base_lin_vel"), ("vy ", "base_lin_vel"), ("", "base_ang_vel"))):
            lines.append(_line(f"{name}commanded", "command", axis, COLORS[axis], dashed=True))
            lines.append(_line(f"{name}actual", series, axis, COLORS[axis]))
        velocities = [
            _panel("velocity, forward and to the left, base frame", "m/s", lines[:4], include=[0.0]),
            _panel("yaw rate", "rad/s", lines[4:], include=[0.0]),
        ]
        return _section("Commanded and actual velocity", velocities, wide=True)

    def _base(self) -> dict[str, Any]:
        _, _, z, _, x, y = self.one["qpos"][:, :6].T
        self.arrays["height"] = z - self.one["ground"]
        # The base's z axis has the vertical component 1 - 2 (x^2 + y^2), with x and y of the base's quaternion.
        self.arrays["tilt"] = np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x**2 + y**2), -1.0, 1.0)))
        height, tilt = _line("height", "height", 0, COLORS[0]), _line("tilt", "tilt", 0, COLORS[1])
        panels = [
            _panel("height above the ground", "m", [height], height=110),
            _panel("tilt", "deg", [tilt], height=110, include=[0.0]),
        ]
        return _section("Base", panels)

    def _feet(self) -> dict[str, Any]:
        feet, contacts = self.episodes.about["feet"], self.episodes.about["contacts"]
        threshold = self.episodes.about["contact_threshold"]
        self.arrays["feet_contact"] = self.one["feet_contact"]
        self.arrays["feet_up_force"] = self.one["feet_force"][:, :, 2]
        rows = [{**line, "above": 0.5} for line in self._lines("feet_contact", without_common_words(feet))]
        # Shapes other than feet are shown if they have a contact at any time.
        force = self.one["contact_force"]
        touched = [i for i, name in enumerate(contacts) if name not in feet and (force[:, i] > threshold).any()]
        self.arrays["other_force"] = force[:, touched] if touched else np.zeros((len(force), 1))
        rows += [{**_line(contacts[i], "other_force", k, "#666666"), "above": threshold} for k, i in enumerate(touched)]
        note = "Bars are contacts; grey bars are those of other shapes." if touched else "Bars are contacts."
        forces = _panel("vertical force on the feet", "N", self._lines("feet_up_force", feet))
        return _section("Feet", [_panel("gait diagram", "", rows, kind="gait"), forces], note=note, wide=True)

    # ---- all tasks --------------------------------------------------------------------------------------------------

    def _lines(self, series: str, labels: Sequence[str], columns: Sequence[int] | None = None) -> list[dict[str, Any]]:
        """Return the lines of `columns` of a series, by default of all columns; `labels` has a label for every column."""
        chosen = range(len(labels)) if columns is None else columns
        return [_line(labels[i], series, i, COLORS[k % len(COLORS)]) for k, i in enumerate(chosen)]

    def _undriven(self, array: str, series: str, title: str, unit: str, first: int = 0) -> list[dict[str, Any]]:
        """Return plots of the columns of `array`, from `first` on, that no motor drives. Each has up to MOST_LINES lines."""
        names, driven = self.episodes.columns(array), {joint[array] for joint in self.joints}
        columns = [i for i in range(first, len(names)) if i not in driven]
        if columns:
            self.arrays[series] = self.one[array][:, columns]
        lines = self._lines(series, [names[i] for i in columns])
        return [_panel(title, unit, lines[i : i + MOST_LINES]) for i in range(0, len(lines), MOST_LINES)]

    def _rewards(self) -> dict[str, Any]:
        parts, names = self.one["reward_parts"], self.episodes.columns("reward_parts")
        unit = float(self.episodes.about["reward_unit"])
        self.arrays["reward_parts"] = parts / unit
        size = np.abs(np.nan_to_num(parts)).sum(axis=0)
        note = "Rewards lie above zero, penalties below."
        if "termination" in names and size[names.index("termination")] > 0.0:
            once = float(parts[-1, names.index("termination")])
            note += f" The penalty of a failure, {once:.3g} at the end, is left out."
            size[names.index("termination")] = 0.0
        largest = [int(i) for i in np.argsort(-size, kind="stable") if size[i] > 0.0]
        rest = largest[MOST_PARTS:] if len(largest) > MOST_PARTS + 1 else []
        lines = self._lines("reward_parts", names, largest[:MOST_PARTS] if rest else largest)
        if rest:
            self.arrays["other_parts"] = self.arrays["reward_parts"][:, rest].sum(axis=1)
            lines.append(_line(f"{len(rest)} others", "other_parts", 0, OTHERS))
        stack = _panel("reward parts, stacked", "1/s" if unit != 1.0 else "1 a step", lines, kind="stack", height=230)
        return _section("Reward parts", [stack] if lines else [], note=note, wide=True)

    def _by_joint(self, title: str, name: str, limit: str, what: str, note: str, **options: Any) -> dict[str, Any]:
        """Return a section with a plot for each group of joints that differ only in their leg."""
        self.arrays[name], labels = self.one[name], [joint["name"] for joint in self.joints]
        panels = []
        for kind, members in groups_of(labels):
            units = {joint_unit(name, self.joints[i]["unit"]) for i in members}
            given = [self.joints[i][limit] for i in members if self.joints[i][limit] is not None]
            limits = sorted({value for one in given for value in (one if isinstance(one, list) else (-one, one))})
            include, lines = limits if name == "torque" else [], self._lines(name, labels, members)
            panels.append(_panel(f"{what}, {kind}", " or ".join(sorted(units)), lines, limits=limits, include=include))
        return _section(title, panels, note=note if any(panel["limits"] for panel in panels) else "", **options)


def groups_of(names: Sequence[str]) -> list[tuple[str, list[int]]]:
    """Return (common name, indices of the joints) for each group of joints whose names differ only in the words for a leg. A
    joint without partners is a group of its own, and so is every joint of a group of more than `MOST_LINES` joints.
    """
    found: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        words = [word for word in re.split(r"[\W_]+", name) if word and not LEG.fullmatch(word)]
        found.setdefault(" ".join(words) or name, []).append(i)
    groups: list[tuple[str, list[int]]] = []
    for kind, members in found.items():
        alike = 1 < len(members) <= MOST_LINES
        groups += [(kind, members)] if alike else [(names[i], [i]) for i in members]
    return groups


def _line(label: str, series: str, column: int, color: str, dashed: bool = False) -> dict[str, Any]:
    return {"label": label, "series": series, "column": column, "color": color, "dashed": dashed}


def _panel(title: str, unit: str, lines: list[dict[str, Any]], **options: Any) -> dict[str, Any]:
    """Return a plot. Options are its `kind`, `height` [pixels], `limits` to draw, and values to `include` in the axis."""
    usual: dict[str, Any] = {"kind": "lines", "height": 150, "limits": [], "include": []}
    return {"title": title, "unit": unit, "lines": lines, **usual, **options}


def _section(title: str, panels: list[dict[str, Any]], **options: Any) -> dict[str, Any]:
    """Return a section; options are a `note` below its title, and whether it is `wide` and `open` at first."""
    return {"title": title, "panels": panels, "note": "", "wide": False, "open": True, **options}
