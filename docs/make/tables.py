"""Tables of results in README.md and docs/*.md: `python docs/make/tables.py`, or with `--check` to compare only.

The numbers come from the JSON files next to the policies in resources/policies. A page holds a table between two markers,
`<!-- table: NAME -->` and `<!-- end -->`; the text between them is rewritten. With --check no page is written: the command
prints a diff and returns 1 if a page is stale.
"""

import argparse
import difflib
import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
MARKED = re.compile(r"(<!-- table: ([^\n]*?) -->\n)(.*?)(<!-- end -->|(?=<!-- table:)|\Z)", re.DOTALL)
WARP, C = "mujoco_warp", "mujoco"
FLAT = ("anymal_c", "anymal_b", "anymal_d", "spot", "go1", "go2", "go2w", "a1", "g1", "h1", "cassie")
TOLD_LESS = ("blind", "proprio", "estimator", "student", "student_ppo")
"""Variants of anymal_c whose policies observe less."""
SOLVERS = ("mujoco", "steel", "kamino", "featherstone", "xpbd", "semi_implicit")
Result = dict[str, Any]


def main(argv: list[str] | None = None, root: Path = ROOT) -> int:
    """Rewrite the tables of the pages below `root`, or compare them; return the exit code."""
    parser = argparse.ArgumentParser(prog="tables", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; print a diff and return 1 if a page is stale")
    check = parser.parse_args(argv).check
    shipped, stale = Shipped(root), 0
    for page in (root / "README.md", *sorted((root / "docs").glob("*.md"))):
        text = page.read_text(encoding="utf-8")
        try:
            made = filled(text, shipped)
        except TableError as error:
            print(f"error: {page.relative_to(root)}: {error}", file=sys.stderr)
            return 2
        if made != text:
            stale += 1
            name = str(page.relative_to(root))
            if check:
                lines = difflib.unified_diff(text.splitlines(), made.splitlines(), name, f"{name}, generated", lineterm="")
                print("\n".join(lines))
            else:
                page.write_text(made, encoding="utf-8")
                print(f"written: {name}")
    return 1 if check and stale else 0


class TableError(Exception):
    """A marker without a table, or a table without its data."""


def filled(text: str, shipped: "Shipped") -> str:
    """Return a page with new tables.

    Raises:
        TableError: a marker names no table or has no end, or a file with numbers is missing.
    """

    def replaced(match: re.Match[str]) -> str:
        begin, name, _, end = match.groups()
        if name not in TABLES:
            raise TableError(f"there is no table '{name}'; there are {', '.join(TABLES)}")
        if not end:
            raise TableError(f"the table '{name}' has no <!-- end -->")
        return f"{begin}\n{TABLES[name](shipped)}\n\n{end}"

    return MARKED.sub(replaced, text)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a compact Markdown table."""
    return "\n".join(f"|{'|'.join(line)}|" for line in [head, ["---"] * len(head), *rows])


class Shipped:
    """Reader of the files of the shipped policies."""

    def __init__(self, root: Path) -> None:
        self.policies, self.tasks = root / "resources" / "policies", root / "cfg"

    def json(self, folder: str, name: str) -> Result:
        """Return a JSON file of a policy.

        Raises:
            TableError: the file is not there.
        """
        if not self.has(folder, name):
            raise TableError(f"resources/policies/{folder}/{name}.json is not there")
        result: Result = json.loads((self.policies / folder / f"{name}.json").read_text(encoding="utf-8"))
        return result

    def has(self, folder: str, name: str) -> bool:
        """Return whether a policy has a JSON file of that name."""
        return (self.policies / folder / f"{name}.json").is_file()

    def evaluation(self, folder: str, engine: str = C) -> Result:
        """Return the evaluation of a policy in an engine."""
        return self.json(folder, f"evaluation_{engine}")

    def seeds(self, task: str) -> list[str]:
        """Return the folder of the shipped seed, then those of the other seeds."""
        return [task, *sorted(f"{task}/{path.name}" for path in (self.policies / task).glob("seed_*"))]

    def size(self, task: str) -> str:
        """Return environments and iterations of a training."""
        cfg = yaml.safe_load((self.policies / task / "config.yaml").read_text(encoding="utf-8"))
        return f"{cfg['env']['num_envs']} x {cfg['train']['runner']['max_iterations']}"

    def learns(self, task: str) -> str:
        """Return the first sentence of the comment at the head of a task's file."""
        lines = (self.tasks / f"{task}.yaml").read_text(encoding="utf-8").splitlines()
        comment = " ".join(line.lstrip("# ") for line in lines[: next(i for i, line in enumerate(lines) if line[:1] != "#")])
        return comment.partition(". ")[0].rstrip(".")

    def training(self, task: str) -> list[str]:
        """Return cells on the training of the shipped policy: GPU, size, wall time with its parts, other trainings."""
        if not self.has(task, "timing"):
            return ["-", self.size(task), "not recorded", "-"]
        timing = self.json(task, "timing")
        compiled = "*" if timing["kernels_compiled"] else ""
        wall = f"{timing['wall_s']:.0f} ({timing['start_up_s']:.0f}{compiled}, {timing['loop_s']:.1f})"
        size = f"{timing['robots']} x {timing['iterations']}"
        return [timing["device"].removeprefix("NVIDIA ").partition(" ")[0], size, wall, str(timing["beside"])]


TRAINING = ("GPU", "environments x iterations", "wall time (start-up, loop) [s]", "other trainings")


def percent(share: float, digits: int = 0) -> str:
    """Return a share as a number of percent."""
    return f"{100.0 * share:.{digits}f}"


def errors(result: Result) -> list[str]:
    """Return cells with mean and worst cell of the velocity and yaw rate errors, and the share of falls [%]."""
    tracking = result.get("rough", result)
    cells = [f"{tracking[key]['mean']:.3f} ({tracking[key]['worst']:.3f})" for key in ("rmse_lin", "rmse_ang")]
    return [*cells, percent(tracking["falls"], 2)]


ERRORS = ("velocity RMSE [m/s]", "yaw rate RMSE [rad/s]", "falls [%]")


def over_seeds(values: Sequence[float]) -> str:
    """Return the mean of the seeds (lowest to highest); '-' for a single seed."""
    return f"{mean(values):.3f} ({min(values):.3f} to {max(values):.3f})" if len(values) > 1 else "-"


def share_at(result: Result, terrain: str, size: float) -> float:
    """Return the success on a terrain type at a size."""
    shares: list[float] = [p["share"] for p in result["success"]["types"][terrain]["points"] if abs(p["size"] - size) < 1e-6]
    if not shares:
        raise TableError(f"the evaluation of '{result['task']}' has no {terrain} of {size:g}")
    return shares[0]


def stairs(result: Result) -> tuple[float, float]:
    """Return the highest steps within the trained range that were evaluated, and the next higher ones [m]."""
    entry = result["success"]["types"]["stairs_up"]
    sizes = sorted(point["size"] for point in entry["points"])
    last = max(i for i, size in enumerate(sizes[:-1]) if size <= entry["trained_to"] + 1e-9)
    return sizes[last], sizes[last + 1]


def crossings(result: Result) -> list[str]:
    """Return cells with two step heights, the success up, down and over obstacles at each [%], and the number of robots."""
    sizes = stairs(result)
    shares = [", ".join(percent(share_at(result, name, size)) for size in sizes) for name in CROSSED]
    return [", ".join(f"{size:.2f}" for size in sizes), *shares, str(result["success"]["robots_per_point"])]


CROSSED = ("stairs_up", "stairs_down", "obstacles")
CROSSINGS = ("steps [m]", "up [%]", "down [%]", "obstacles [%]", "robots")


# ---- the tables ------------------------------------------------------------------------------------------------------


def results(shipped: Shipped) -> str:
    """Return the short table of README.md."""

    def quality(task: str) -> str:
        if task == "half_cheetah":
            returns = shipped.json(task, "evaluation_gymnasium")["episodes"]["return"]
            return f"return {returns['mean']:.0f} in Gymnasium's HalfCheetah-v5"
        result = shipped.evaluation(task)
        velocity, _, falls = errors(result)
        text = f"velocity RMSE {velocity.partition(' ')[0]} m/s, {falls} % fall"
        if "success" not in result:
            return text
        size = stairs(result)[0]
        up, down = (percent(share_at(result, name, size)) for name in CROSSED[:2])
        return f"{text}; stairs of {100 * size:.0f} cm: {up} % up, {down} % down"

    def training(task: str) -> str:
        gpu, size, wall, others = shipped.training(task)
        environments, _, iterations = size.partition(" x ")
        said = f"{environments} environments, {iterations} iterations"
        if gpu == "-":
            return f"{said}; time not recorded"
        beside = f", sharing the GPU with {others} other training{'s' * (others != '1')}" if others != "0" else ""
        return f"{gpu}, {said}: {wall.partition(' ')[0]} s{beside}"

    tasks = ("anymal_c_flat", "anymal_c", "g1_flat", "go2_real", "go2w", "half_cheetah")
    rows = [[f"`{task}`", shipped.learns(task), training(task), quality(task)] for task in tasks]
    return table(("task", "what it learns", "training", "quality in C MuJoCo"), rows)


def flat(shipped: Shipped) -> str:
    """Return the table of tasks on a plane: training and errors of the shipped seed, and the errors of all seeds."""
    rows = []
    for task in (f"{robot}_flat" for robot in FLAT):
        seeds = [shipped.evaluation(folder)["rmse_lin"]["mean"] for folder in shipped.seeds(task)]
        in_warp = shipped.evaluation(task, WARP)["rmse_lin"]["mean"]
        cells = [*errors(shipped.evaluation(task)), f"{in_warp:.3f}", over_seeds(seeds)]
        rows.append([f"`{task}`", *shipped.training(task), *cells])
    return table(("task", *TRAINING, *ERRORS, "velocity, mujoco-warp", "velocity, all seeds"), rows)


def rough(shipped: Shipped) -> str:
    """Return the table of tasks with terrain: training, errors and success of the shipped seed."""
    tasks = [*FLAT[:1], *(f"anymal_c_{name}" for name in TOLD_LESS), *FLAT[1:]]
    return table(("task", *TRAINING, *ERRORS, *CROSSINGS), [_rough_row(shipped, task) for task in tasks])


def _rough_row(shipped: Shipped, task: str) -> list[str]:
    result = shipped.evaluation(task)
    return [f"`{task}`", *shipped.training(task), *errors(result), *crossings(result)]


def real(shipped: Shipped) -> str:
    """Return the table of tasks for real robots: training, errors and success."""
    return table(
        ("task", *TRAINING, *ERRORS, *CROSSINGS), [_rough_row(shipped, f"{name}_real") for name in ("anymal_c", "go2")]
    )


def real_stress(shipped: Shipped) -> str:
    """Return the success of the tasks for real robots on stairs under each disturbance of the stress test."""
    names = {
        "nominal": "nothing",
        "payload": "payload",
        "friction": "friction 0.4",
        "weak motors": "motors at 85 %",
        **{name: name for name in ("delay 20 ms", "delay 40 ms", "pushes", "together", "everything")},
    }
    ground = ("dense_blocks", "kerbs", "rubble")
    rows = []
    for task in ("anymal_c_real", "go2_real"):
        result = shipped.json(task, f"stress_{C}")
        lines = {line["name"]: line["stairs"]["share"] for line in result["lines"]}
        shares = [*(lines[name] for name in names), *(result["ground"][name]["share"] for name in ground)]
        rows.append([f"`{task}`", f"{result['definition']['riser_m']:.2f} m", *map(percent, shares)])
    return table(("[%]", "steps", *names.values(), *(name.replace("_", " ") for name in ground)), rows)


def stress(shipped: Shipped) -> str:
    """Return the stress scores of the policies of the ANYmal C, and the number of robots that failed in some lines."""
    chosen, ground = ("payload", "delay 40 ms", "no map", "together", "everything"), ("dense_blocks", "kerbs", "rubble")
    rows = []
    for task in ("anymal_c", *(f"anymal_c_{name}" for name in TOLD_LESS)):
        tests = [shipped.json(task, f"stress_{C}")]
        tests += [shipped.json(seed, f"stress_{C}") for seed in shipped.seeds(task)[1:] if shipped.has(seed, f"stress_{C}")]
        score, lines = tests[0]["score"], {line["name"]: line["stairs"] for line in tests[0]["lines"]}
        points = [*(lines[name] for name in chosen), *(tests[0]["ground"][name] for name in ground)]
        scores = [f"{percent(score['value'], 1)} ({percent(score['low'])} to {percent(score['high'])})"]
        scores += [percent(score[part]) for part in ("stairs", "flat", "ground")]
        failed = [f"{point['robots'] - point['successes']}/{point['robots']}" for point in points]
        seeds = ", ".join(percent(test["score"]["value"], 1) for test in tests[1:])
        rows.append([f"`{task}`", *scores, *failed, seeds or "-"])
    head = ("task", "score [%] (95 % interval)", "stairs", "flat", "new ground", *chosen)
    return table((*head, *(name.replace("_", " ") for name in ground), "other seeds"), rows)


def others(shipped: Shipped) -> str:
    """Return the table of tasks that are measured by returns, speed or a single step."""

    def returns(folder: str) -> str:
        found = shipped.json(folder, "evaluation_gymnasium")["episodes"]["return"]
        return f"{found['mean']:.0f} ({found['min']:.0f} to {found['max']:.0f})"

    def speed(folder: str) -> str:
        episodes = shipped.evaluation(folder)["episodes"]
        return f"{episodes['metrics']['x_velocity']:.2f}, {percent(episodes['failures'], 1)} % fall"

    def crossed(folder: str) -> str:
        result = shipped.evaluation(folder, WARP)
        return ", ".join(f"{percent(share_at(result, 'step', size), 1)} %" for size in (0.15, 0.2))

    measures: dict[str, tuple[str, Callable[[str], str]]] = {
        "half_cheetah": ("return in HalfCheetah-v5 (lowest to highest episode)", returns),
        "humanoid": ("forward speed in C MuJoCo [m/s], falls", speed),
        "anymal_c_step": ("steps of 15 and 20 cm crossed", crossed),
    }
    rows = []
    for task, (name, measured) in measures.items():
        first, *more = shipped.seeds(task)
        _, size, wall, _ = shipped.training(task)
        rows.append([f"`{task}`", size, wall, name, measured(first), "; ".join(map(measured, more)) or "-"])
    return table(("task", *TRAINING[1:3], "measure", "shipped policy", "other seeds"), rows)


def engines(shipped: Shipped) -> str:
    """Return the errors of policies of anymal_c_flat in the engine of their training and in other engines."""
    trained_in = {
        "anymal_c_flat": "mujoco-warp (shipped)",
        "anymal_c_flat/newton_mujoco": "newton mujoco",
        "anymal_c_flat/newton_steel": "newton steel",
        "anymal_c_flat/newton_xpbd": "mujoco-warp, then 50 iterations in xpbd",
    }
    rows = []
    for folder, name in trained_in.items():
        found = {row["physics"]: row for row in shipped.json(folder, "crossing")["engines"]}
        measured = [found[engine] for engine in (WARP, C, *(f"newton_{solver}" for solver in SOLVERS))]
        cells = [f"{row['rmse_lin']:.3f}, {row['rmse_ang']:.3f}" for row in measured]
        falls = [f", {percent(row['falls'])} % fall" if row["falls"] else "" for row in measured]
        rows.append([name, *map(str.__add__, cells, falls)])
    return table(("trained in", "mujoco-warp", "C MuJoCo", *(f"newton {solver}" for solver in SOLVERS)), rows)


TABLES: dict[str, Callable[[Shipped], str]] = {
    made.__name__: made for made in (results, flat, rough, real, real_stress, stress, others, engines)
}

if __name__ == "__main__":
    sys.exit(main())
