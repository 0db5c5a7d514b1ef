"""The results of a sweep: a table of its trials, the settings of the best one, and Optuna's figures."""

import json
import shlex
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from legged.config import parse_override
from legged.config.loader import merge, nest
from legged.config.origins import Origins
from legged.config.yaml_files import dump
from legged.evaluation.tables import markdown_table
from legged.figures import DPI
from legged.process.paths import relative, replacing, write_text
from legged.sweeping.plan import Plan
from legged.sweeping.study import RUNS, WHY, Trials

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from optuna.importance import PedAnovaImportanceEvaluator
    from optuna.trial import FrozenTrial

FEWEST = 4
"""Fewest trials with a value from which the importance of settings is computed."""


def write_report(trials: Trials, module: str | None = None) -> list[str]:
    """Write table.md, best.yaml and figures into the sweep's folder; return lines about the result and the files. `module` is
    the value of --import.

    Raises:
        RunError: a file can't be written.
    """
    plan, all_trials = trials.plan, trials.all
    ranked, folder = ranking(plan, all_trials), plan.folder
    write_text(folder / "table.md", table(plan, all_trials, module))
    written = [folder / "table.md"]
    lines = [f"{trials.done} of {plan.given.trials} trials are done"]
    if ranked:
        best, own = ranked[0], own_trial(plan, ranked)
        write_text(folder / "best.yaml", best_yaml(plan, best))
        written += [folder / "best.yaml", *draw_figures(trials)]
        lines.append(f"best: trial {best.number}, {plan.objective_text}: {best.value:.4g}")
        if own is not None:
            rank = f"rank {ranked.index(own) + 1} of {len(ranked)}"
            lines[-1] += f"; the task's own settings: trial {own.number}, {own.value:.4g}, {rank}"
    return [*lines, f"written: {', '.join(relative(path) for path in written)}"]


def ranking(plan: Plan, trials: Sequence["FrozenTrial"]) -> list["FrozenTrial"]:
    """Return the trials with a value, the best first."""
    there = [trial for trial in trials if trial.state.name == "COMPLETE"]
    return sorted(there, key=lambda trial: float(trial.value or 0.0), reverse=not plan.minimize)


def settings(plan: Plan, trial: "FrozenTrial") -> dict[str, Any]:
    """Return dotted path -> value of the settings that a trial was trained with."""
    return {one.path: one.value(trial.params[one.path]) for one in plan.parameters if one.path in trial.params}


def own_trial(plan: Plan, trials: Sequence["FrozenTrial"]) -> "FrozenTrial | None":
    """Return the trial that has the task's own settings, if there is one."""
    own = plan.own
    return next((trial for trial in trials if settings(plan, trial) == own), None)


def table(plan: Plan, trials: Sequence["FrozenTrial"], module: str | None = None) -> str:
    """Return all trials as Markdown: those with a value by rank, then those that were ended early, then the others."""
    order = {"PRUNED": 0, "RUNNING": 1, "WAITING": 2, "FAIL": 3}
    ranked = ranking(plan, trials)
    others = sorted((t for t in trials if t.state.name != "COMPLETE"), key=lambda t: (order[t.state.name], t.number))
    paths = [one.path for one in plan.parameters]
    own = own_trial(plan, ranked)
    besides = f" Trial {own.number} has the task's own settings." if own is not None else ""
    rows = [[rank, trial.number, f"{trial.value:.4g}"] for rank, trial in enumerate(ranked, 1)]
    rows += [["", trial.number, _why_no_value(plan, trial)] for trial in others]
    for row, trial in zip(rows, [*ranked, *others], strict=True):
        given = settings(plan, trial)
        row += [_text(given[path]) if path in given else "" for path in paths]
        row.append(", ".join(f"`{Path(run).name}`" for run in trial.user_attrs.get(RUNS, [])))
    heads = ["rank", "trial", plan.objective_text, *(f"`{path}`" for path in paths), "run"]
    parts = [f"# {plan.name}", f"`{plan.cfg.task}`, for the {plan.objective_text}.{besides}"]
    parts.append(markdown_table(heads, rows, left=[len(heads) - 1]))
    if ranked:
        words = ["legged", "train", *(["--import", module] if module else []), plan.task]
        words += [_override(path, value) for path, value in settings(plan, ranked[0]).items()]
        parts += ["The settings of the best, as YAML:", f"```yaml\n{best_yaml(plan, ranked[0])}```"]
        parts += ["and on the command line:", f"```\n{shlex.join(words)}\n```"]
        if plan.given.overrides:
            common = ", ".join(f"`{path}={_text(value)}`" for path, value in plan.given.overrides.items())
            parts.append(f"Neither holds the overrides of all trials: {common}.")
    return "\n\n".join(parts) + "\n"


def _why_no_value(plan: Plan, trial: "FrozenTrial") -> str:
    """Return the reason why a trial has no value, with the last figure of a trial that was ended early."""
    state = trial.state.name
    why = trial.user_attrs.get(WHY) or {"RUNNING": "is being trained", "WAITING": "is to be tried again"}.get(state, "failed")
    if state != "PRUNED" or not trial.intermediate_values:
        return str(why)
    step = max(trial.intermediate_values)
    return f"{why}; {(-1.0 if plan.negated else 1.0) * trial.intermediate_values[step]:.4g} at {step}"


def _text(value: Any) -> str:
    """Return a value with all its digits, as in a YAML file."""
    return value if isinstance(value, str) else json.dumps(value)


def _override(path: str, value: Any) -> str:
    """Return `key=value` for the command line, with quotation marks around a text that would be read as something else."""
    plain = f"{path}={_text(value)}"
    return plain if parse_override(plain) == (path, value) else f"{path}={json.dumps(value)}"


def best_yaml(plan: Plan, best: "FrozenTrial") -> str:
    """Return the settings of a trial as the lines of a task's YAML file."""
    nested: dict[str, Any] = {}
    for path, value in settings(plan, best).items():
        merge(nested, nest(path, value), "sweep", Origins())
    heading = f"# {plan.name}, trial {best.number}; {plan.objective_text}: {best.value:.4g}\n"
    return heading + dump(nested, sort_keys=False, default_flow_style=None, width=120)


def importances(trials: Trials) -> dict[str, float]:
    """Return dotted path -> importance of a setting for a trial to be among the best (PED-ANOVA, Watanabe et al., arXiv
    2304.10255), the largest first. Return nothing while there are too few trials, or while the best quarter is no better than
    the rest: all settings would have the same importance.
    """
    import optuna

    if len(ranking(trials.plan, trials.all)) < FEWEST or len(trials.plan.parameters) < 2:
        return {}
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*select the same set of trials", category=UserWarning)
        try:
            return dict(optuna.importance.get_param_importances(trials.study, evaluator=_evaluator()))
        except (ValueError, RuntimeError, UserWarning):
            return {}


def _evaluator() -> "PedAnovaImportanceEvaluator":
    import optuna

    return optuna.importance.PedAnovaImportanceEvaluator(target_quantile=0.25)


def draw_figures(trials: Trials) -> list[Path]:
    """Draw Optuna's figures of the trials: values over trials, values over settings and, where it is known, the importance of
    settings. Return the paths of the files.

    Raises:
        RunError: a file can't be written.
    """
    import matplotlib.pyplot as plt
    from optuna.visualization import matplotlib as drawing

    plt.switch_backend("agg")  # draw without a window system
    plan, study = trials.plan, trials.study
    own = own_trial(plan, ranking(plan, trials.all))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Optuna calls these functions experimental
        history = drawing.plot_optimization_history(study, target_name=plan.objective_text)
        if own is not None and own.value is not None:
            history.axhline(own.value, color="black", lw=1.0, ls="--", label="the task's own settings")
            history.legend()
        drawn = {"history": history, "parallel": drawing.plot_parallel_coordinate(study, target_name=plan.objective_text)}
        if importances(trials):
            drawn["importance"] = drawing.plot_param_importances(
                study, evaluator=_evaluator(), target_name=plan.objective_text
            )
        paths = []
        for name, axes in drawn.items():
            figure = cast("Figure", axes.figure)
            paths.append(plan.folder / f"{name}.png")
            with replacing(paths[-1]) as part:
                figure.savefig(part, dpi=DPI, format="png", bbox_inches="tight")
            plt.close(figure)
    return paths
