"""What a sweep has found: a table of its trials, the settings of the best, and figures."""

import json
import shlex
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legged.config import parse_override
from legged.config.loader import merge, nest
from legged.config.origins import Origins
from legged.config.yaml_files import dump
from legged.figures import COLORS, figure
from legged.process.paths import relative, write_text
from legged.sweeping.plan import Parameter, Plan
from legged.sweeping.study import RUNS, WHY, Trials

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

BLUE, VERMILLION, GREY = COLORS[0], COLORS[1], "#999999"
"""Of Okabe and Ito's colours, which colour-blind readers tell apart."""
FEWEST = 4
"""Trials with a value of which it can be said which setting mattered."""
WIDEST_NAME = 28
"""Letters of a setting's name in a figure."""


def write_report(trials: Trials, module: str | None = None) -> list[str]:
    """Write table.md, best.yaml and figures into the sweep's folder; return lines on what was found and where it is. `module`
    is what --import named.

    Raises:
        RunError: a file can't be written.
    """
    plan, all_trials = trials.plan, trials.all
    ranked = ranking(plan, all_trials)
    folder = plan.folder
    write_text(folder / "table.md", table(plan, all_trials, module))
    written = [folder / "table.md"]
    lines = [f"{trials.done} of {plan.given.trials} trials are done"]
    if ranked:
        best = ranked[0]
        write_text(folder / "best.yaml", best_yaml(plan, best))
        draw_history(plan, all_trials, folder / "history.png")
        draw_parallel(plan, ranked, folder / "parallel.png")
        written += [folder / name for name in ("best.yaml", "history.png", "parallel.png")]
        lines.append(f"best: trial {best.number}, {plan.objective_text}: {best.value:.4g}{_beside_own(plan, ranked)}")
        importance = importances(trials)
        if importance:
            draw_importance(plan, importance, folder / "importance.png")
            written.append(folder / "importance.png")
    return [*lines, f"written: {', '.join(relative(path) for path in written)}"]


def ranking(plan: Plan, trials: Sequence["FrozenTrial"]) -> list["FrozenTrial"]:
    """Return the trials with a value, the best first."""
    sign = 1.0 if plan.minimize else -1.0
    there = [trial for trial in trials if trial.state.name == "COMPLETE"]
    return sorted(there, key=lambda trial: sign * float(trial.value or 0.0))


def settings(plan: Plan, trial: "FrozenTrial") -> dict[str, Any]:
    """Return dotted path -> value of a trial, as it was trained with."""
    return {one.path: one.value(trial.params[one.path]) for one in plan.parameters if one.path in trial.params}


def own_trial(plan: Plan, trials: Sequence["FrozenTrial"]) -> "FrozenTrial | None":
    """Return the trial that has the task's own settings, if there is one."""
    own = plan.own
    return next((trial for trial in trials if settings(plan, trial) == own), None)


def _beside_own(plan: Plan, ranked: Sequence["FrozenTrial"]) -> str:
    own = own_trial(plan, ranked)
    if own is None:
        return ""
    return f"; the task's own settings: trial {own.number}, {own.value:.4g}, rank {ranked.index(own) + 1} of {len(ranked)}"


def table(plan: Plan, trials: Sequence["FrozenTrial"], module: str | None = None) -> str:
    """Return all trials as Markdown: those with a value by rank, then those that were ended early, then the others."""
    order = {"PRUNED": 0, "RUNNING": 1, "WAITING": 2, "FAIL": 3}
    ranked = ranking(plan, trials)
    others = sorted((t for t in trials if t.state.name != "COMPLETE"), key=lambda t: (order[t.state.name], t.number))
    paths = [one.path for one in plan.parameters]
    sign = -1.0 if plan.negated else 1.0
    own = own_trial(plan, trials)
    besides = f" Trial {own.number} has the task's own settings." if own is not None else ""
    lines = [f"# {plan.name}", "", f"`{plan.cfg.task}`, for the {plan.objective_text}.{besides}", ""]
    heads = ["rank", "trial", plan.objective_text, *(f"`{path}`" for path in paths), "run"]
    lines += [_row(heads), _row(["--:", "--:", "--:", *["--:"] * len(paths), ":--"])]
    for rank, trial in enumerate(ranked, 1):
        lines.append(_row([rank, trial.number, f"{trial.value:.4g}", *_values(plan, trial, paths), _runs(trial)]))
    for trial in others:
        why = trial.user_attrs.get(WHY) or {"RUNNING": "is being trained", "WAITING": "is to be tried again"}.get(
            trial.state.name, "failed"
        )
        if trial.state.name == "PRUNED" and trial.intermediate_values:
            step = max(trial.intermediate_values)
            why += f"; {sign * trial.intermediate_values[step]:.4g} at {step}"
        lines.append(_row(["", trial.number, why, *_values(plan, trial, paths), _runs(trial)]))
    if ranked:
        words = ["legged", "train", *(["--import", module] if module else []), plan.task]
        words += [_override(path, value) for path, value in settings(plan, ranked[0]).items()]
        lines += ["", "The settings of the best, as YAML:", "", "```yaml", best_yaml(plan, ranked[0]).rstrip(), "```"]
        lines += ["", "and on the command line:", "", "```", shlex.join(words), "```"]
        if plan.given.overrides:
            common = ", ".join(f"`{path}={_text(value)}`" for path, value in plan.given.overrides.items())
            lines += ["", f"Neither holds what all trials had in common: {common}."]
    return "\n".join(lines) + "\n"


def _row(cells: Sequence[object]) -> str:
    return "| " + " | ".join(str(cell).replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def _values(plan: Plan, trial: "FrozenTrial", paths: Sequence[str]) -> list[str]:
    given = settings(plan, trial)
    return [_text(given[path]) if path in given else "" for path in paths]


def _text(value: Any) -> str:
    """Return a value as it would stand in a YAML file, all of its digits: it is copied from there."""
    return value if isinstance(value, str) else json.dumps(value)


def _override(path: str, value: Any) -> str:
    """Return `key=value` for the command line; a text that would be read as something else has quotation marks."""
    plain = f"{path}={_text(value)}"
    return plain if parse_override(plain) == (path, value) else f"{path}={json.dumps(value)}"


def _runs(trial: "FrozenTrial") -> str:
    return ", ".join(f"`{Path(run).name}`" for run in trial.user_attrs.get(RUNS, []))


def best_yaml(plan: Plan, best: "FrozenTrial") -> str:
    """Return the settings of a trial as the lines of a task's YAML file."""
    nested: dict[str, Any] = {}
    for path, value in settings(plan, best).items():
        merge(nested, nest(path, value), "sweep", Origins())
    heading = f"# {plan.name}, trial {best.number}; {plan.objective_text}: {best.value:.4g}\n"
    return heading + dump(nested, sort_keys=False, default_flow_style=None, width=120)


def importances(trials: Trials) -> dict[str, float]:
    """Return dotted path -> share of what the settings explain of which trials are among the best (PED-ANOVA, Watanabe et
    al., arXiv 2304.10255), the largest first; nothing while there are too few trials to tell, or while the best quarter
    is no better than the rest: all settings would come out alike.
    """
    import optuna

    if len(ranking(trials.plan, trials.all)) < FEWEST or len(trials.plan.parameters) < 2:
        return {}
    evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=0.25)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*select the same set of trials", category=UserWarning)
        try:
            return dict(optuna.importance.get_param_importances(trials.study, evaluator=evaluator))
        except (ValueError, RuntimeError, UserWarning):
            return {}


# ---- figures ---------------------------------------------------------------------------------------------------------


def draw_history(plan: Plan, trials: Sequence["FrozenTrial"], path: Path) -> None:
    """Draw the value of each trial, and the best one so far; crosses on the axis are trials that were ended early."""
    there = [trial for trial in trials if trial.state.name == "COMPLETE"]
    early = [trial.number for trial in trials if trial.state.name == "PRUNED"]
    numbers, values = [trial.number for trial in there], [float(trial.value or 0.0) for trial in there]
    own = own_trial(plan, there)
    pick = min if plan.minimize else max
    best = [pick(values[: i + 1]) for i in range(len(values))]
    with figure(path, (7.0, 3.6)) as (drawn, axes):
        (axis,) = axes.flat
        axis.plot(numbers, values, "o", ms=4, color=BLUE, label="trial")
        until = max([*numbers, *early])
        axis.step([*numbers, until], [*best, best[-1]], where="post", color=VERMILLION, label="best so far")
        if own is not None:
            axis.axhline(float(own.value or 0.0), color="black", lw=1.0, ls="--", label="the task's own settings")
        if early:
            low = axis.get_ylim()[0]
            axis.plot(early, [low] * len(early), "x", ms=6, color=GREY, clip_on=False, zorder=5, label="ended early")
            axis.set_ylim(bottom=low)
        axis.set_xlabel("trial")
        axis.set_ylabel(plan.objective_text)
        axis.grid(alpha=0.3)
        drawn.legend(loc="outside upper center", ncols=4, frameon=False)


def draw_importance(plan: Plan, importance: dict[str, float], path: Path) -> None:
    """Draw a bar for each setting."""
    names = [_short(name) for name in importance][::-1]
    with figure(path, (7.0, 0.8 + 0.32 * len(names))) as (_, axes):
        (axis,) = axes.flat
        bars = axis.barh(names, [100.0 * value for value in importance.values()][::-1], color=BLUE)
        axis.bar_label(bars, fmt="%.0f", padding=3)
        axis.set_xlabel(f"share of what is explained of the {plan.objective_text} [%]")
        axis.margins(x=0.1)


def draw_parallel(plan: Plan, ranked: Sequence["FrozenTrial"], path: Path) -> None:
    """Draw an axis for each setting and one for the value; a line is a trial, the best one in vermillion."""
    values = [float(trial.value or 0.0) for trial in ranked]
    low, high = min(values), max(values)
    span = high - low or 1.0
    columns = len(plan.parameters) + 1
    with figure(path, (1.5 + 1.35 * columns, 4.2)) as (drawn, axes):
        from matplotlib import colormaps

        (axis,) = axes.flat
        # The best last, so that it lies on top.
        for rank, trial in reversed([*enumerate(ranked)]):
            value = float(trial.value or 0.0)
            heights = [_height(one, trial.params.get(one.path)) for one in plan.parameters] + [(value - low) / span]
            good = (high - value) / span if plan.minimize else (value - low) / span
            style: dict[str, Any] = {"color": colormaps["cividis_r"](good), "lw": 1.0, "alpha": 0.8}
            if rank == 0:
                style = {"color": VERMILLION, "lw": 2.5, "label": f"best: trial {trial.number}"}
            axis.plot(range(columns), heights, **style)
        for column, one in enumerate(plan.parameters):
            _scale(axis, column, one)
        for share in (0.0, 0.5, 1.0):
            axis.text(columns - 0.95, share, f"{low + share * (high - low):.3g}", va="center", fontsize="small")
        axis.set_xticks(
            range(columns), [*(_short(one.path) for one in plan.parameters), plan.figure], rotation=20, ha="right"
        )
        axis.set_yticks([])
        axis.set_xlim(-0.1, columns - 0.5)
        for side in ("left", "right", "top"):
            axis.spines[side].set_visible(False)
        for column in range(columns):
            axis.axvline(column, color="black", lw=0.6)
        axis.set_title(f"{plan.objective_text}; darker lines are better", fontsize="medium")
        drawn.legend(loc="outside lower right", frameon=False)


def _height(one: Parameter, drawn: Any) -> float:
    """Return where a value lies on its axis, from 0 to 1."""
    from math import log

    if drawn is None:
        return float("nan")
    if one.kind == "choice":
        return one.choices.index(drawn) / max(len(one.choices) - 1, 1)
    if one.log:
        return log(drawn / one.low) / log(one.high / one.low)
    return (drawn - one.low) / (one.high - one.low)


def _scale(axis: Any, column: int, one: Parameter) -> None:
    """Write the ends of a setting's axis, or its choices, beside it."""
    marks = {index / max(len(one.choices) - 1, 1): text.strip('"') for index, text in enumerate(one.choices)}
    for height, text in (marks or {0.0: f"{one.low:g}", 1.0: f"{one.high:g}"}).items():
        place = {"va": "bottom" if height < 0.5 else "top", "fontsize": "small"}
        axis.text(column + 0.04, height, text, bbox={"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 1}, **place)


def _short(path: str) -> str:
    """Return the end of a dotted path that tells it from others."""
    name = ".".join(path.split(".")[-2:]) if len(path.rpartition(".")[2]) < 6 else path.rpartition(".")[2]
    return name if len(name) <= WIDEST_NAME else f"...{name[-WIDEST_NAME:]}"
