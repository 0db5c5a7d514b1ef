"""The page of an episode: one HTML file that holds pictures, numbers and the script that draws them."""

import base64
from pathlib import Path
from typing import Any

import numpy as np

from legged.episodes.panels import Panels
from legged.episodes.ranking import Figures
from legged.episodes.stored import Episodes
from legged.evaluation.reports import render
from legged.evaluation.result_file import changes_text
from legged.process.paths import relative, write_text


def page_name(number: int) -> str:
    """Return the file name of an episode's page."""
    return f"episode_{number:03d}.html"


def write_page(folder: Path, episodes: Episodes, figures: Figures, number: int, film: dict[str, Any]) -> Path:
    """Write the page of an episode into `folder`; return its path. `film` is the result of `Projector.show`.

    Raises:
        RunError: the page can't be written.
    """
    panels, about = Panels(episodes, number), episodes.about
    sections = panels.sections()
    data = {
        "steps": int(episodes.lengths[number]),
        "dt": episodes.dt,
        "film": film,
        "series": {name: _packed(array) for name, array in panels.arrays.items()},
        "sections": sections,
    }
    page = render(
        "episode.html",
        title=f"{about['task']}, episode {number}: {_ending(episodes, figures, number)}",
        summary=f"{about['checkpoint']} of {about.get('run', '')}, {about.get('physics', '')}; {_conditions(about)}",
        tables=[_facts(episodes, figures, number), _sums(episodes, number)],
        data=data,
    )
    path = folder / page_name(number)
    write_text(path, page)
    print(f"page {relative(path)} ({len(page) / 1e6:.1f} MB)")
    return path


def _packed(array: np.ndarray) -> dict[str, Any]:
    """Return numbers (T,) or (T, K) as text: little-endian 32-bit floats in base64, row by row."""
    rows = array.reshape(len(array), -1)
    return {"values": base64.b64encode(rows.astype("<f4").tobytes()).decode("ascii"), "columns": rows.shape[1]}


def _ending(episodes: Episodes, figures: Figures, number: int) -> str:
    seconds, terms = figures.values["length"][number], ", ".join(figures.ended[number])
    return f"{'failed' if figures.failed[number] else 'ended'} after {seconds:.2f} s by {terms}"


def _conditions(about: dict[str, Any]) -> str:
    """Return the conditions of a recording as text."""
    text = (
        "noise, pushes and randomisation as trained" if about.get("as_trained") else "without noise, pushes and randomisation"
    )
    changes = changes_text(about)
    return f"{text}, but with {changes}" if changes else text


def _facts(episodes: Episodes, figures: Figures, number: int) -> list[tuple[str, str]]:
    about = episodes.about
    rows = [(column.title, f"{figures.values[column.name][number]:{column.form}}") for column in figures.columns]
    if figures.strained:
        rows.append(("at the joint", figures.strained[number]))
    rows += [("robot", str(int(episodes["robot"][number]))), ("steps", f"{episodes.lengths[number]} of {episodes.dt:g} s")]
    if about.get("held_command"):
        rows.append(("command held [m/s, rad/s]", ", ".join(f"{value:g}" for value in about["held_command"])))
    rows += [("device", str(about.get("device", ""))), ("seed", str(about.get("seed", "")))]
    return rows


def _sums(episodes: Episodes, number: int) -> list[tuple[str, str]]:
    """Return the return by part, the largest first."""
    sums = np.nan_to_num(episodes.of(number)["reward_parts"]).sum(axis=0, dtype=np.float64)
    names = episodes.columns("reward_parts")
    order = np.argsort(-np.abs(sums), kind="stable")
    return [(f"return of {names[i]}", f"{sums[i]:.2f}") for i in order]
