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

from legged.cli.list import tasks as descriptions
from legged.commandline.command import run_main
from legged.errors import ConfigError
from legged.learning.timing import read_timing
from legged.process.paths import relative

ROOT = Path(__file__).resolve().parents[2]
MARKED = re.compile(r"(<!-- table: ([^\n]*?) -->\n)(.*?)(<!-- end -->|(?=<!-- table:)|\Z)", re.DOTALL)
WARP, C = "mujoco_warp", "mujoco"
STRESS, LEAGUE = f"stress_{C}", f"league_{C}"
NEW_GROUND = ("dense_blocks", "kerbs", "rubble")
FLAT = ("anymal_c", "anymal_b", "anymal_d", "spot", "go1", "go2", "go2w", "a1", "g1", "h1", "cassie")
TOLD_LESS = ("blind", "proprio", "estimator", "student", "student_ppo")
"""Variants of anymal_c whose policies observe less."""
REAL = tuple(f"{robot}_real" for robot in ("anymal_c", "go2", "g1", "h1", "cassie"))
SOLVERS = ("mujoco", "steel", "kamino", "featherstone", "xpbd", "semi_implicit")
Result = dict[str, Any]


def main(argv: list[str] | None = None, root: Path = ROOT) -> int:
    """Rewrite the tables of the pages below `root`, or compare them; return the exit code."""
    return run_main(lambda words: _main(words, root), argv)


def _main(argv: list[str] | None, root: Path) -> int:
    parser = argparse.ArgumentParser(prog="tables", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; print a diff and return 1 if a page is stale")
    check = parser.parse_args(argv).check
    stale = 0
    for page in (root / "README.md", *sorted((root / "docs").glob("*.md"))):
        name, text = str(page.relative_to(root)), page.read_text(encoding="utf-8")
        try:
            made = filled(text, root / "resources" / "policies")
        except ConfigError as error:
            raise ConfigError(f"{name}: {error}") from error
        if made == text:
            continue
        stale += 1
        if check:
            lines = difflib.unified_diff(text.splitlines(), made.splitlines(), name, f"{name}, generated", lineterm="")
            print("\n".join(lines))
        else:
            page.write_text(made, encoding="utf-8")
            print(f"written: {name}")
    return 1 if check and stale else 0


def filled(text: str, policies: Path) -> str:
    """Return a page with new tables, of the policies in a folder.

    Raises:
        ConfigError: a marker names no table or has no end, or a file with numbers is missing.
    """

    def replaced(match: re.Match[str]) -> str:
        begin, name, _, end = match.groups()
        if name not in TABLES:
            raise ConfigError(f"there is no table '{name}'; there are {', '.join(TABLES)}")
        if not end:
            raise ConfigError(f"the table '{name}' has no <!-- end -->")
        return f"{begin}\n{TABLES[name](policies)}\n\n{end}"

    return MARKED.sub(replaced, text)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a compact Markdown table."""
    return "\n".join(f"|{'|'.join(line)}|" for line in [head, ["---"] * len(head), *rows])


# ---- files and cells -------------------------------------------------------------------------------------------------


def read(folder: Path, name: str) -> Result:
    """Return a JSON file in the folder of a policy.

    Raises:
        ConfigError: the file is not there.
    """
    path = folder / f"{name}.json"
    if not path.is_file():
        raise ConfigError(f"{relative(path)} is not there")
    result: Result = json.loads(path.read_text(encoding="utf-8"))
    return result


def evaluation(folder: Path, engine: str = C) -> Result:
    """Return the evaluation of a policy in an engine."""
    return read(folder, f"evaluation_{engine}")


def seeds_of(folder: Path) -> list[Path]:
    """Return the folder of a shipped policy, then the folders of the task's other seeds."""
    return [folder, *sorted(folder.glob("seed_*"))]


def training(folder: Path) -> list[str]:
    """Return cells on the training of a policy: GPU, size, wall time with its parts, other trainings."""
    timing = read_timing(folder)
    if timing is None:
        cfg = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
        return ["-", f"{cfg['env']['num_envs']} x {cfg['train']['runner']['max_iterations']}", "not recorded", "-"]
    compiled = "*" if timing.kernels_compiled else ""
    wall = f"{timing.wall_s:.0f} ({timing.start_up_s:.0f}{compiled}, {timing.loop_s:.1f})"
    gpu = timing.device.removeprefix("NVIDIA ").partition(" ")[0]
    return [gpu, f"{timing.robots} x {timing.iterations}", wall, str(timing.beside)]


TRAINING = ("GPU", "environments x iterations", "wall time (start-up, loop) [s]", "other trainings")


def percent(share: float, digits: int = 0) -> str:
    """Return a share as a number of percent."""
    return f"{100.0 * share:.{digits}f}"


def errors(result: Result) -> list[str]:
    """Return cells with mean and worst cell of the velocity and yaw rate errors ('-' if every robot fell), and falls [%]."""
    tracking = result.get("rough", result)
    found = [[tracking[key][part] for part in ("mean", "worst")] for key in ("rmse_lin", "rmse_ang")]
    cells = ["-" if whole is None else f"{whole:.3f} ({worst:.3f})" for whole, worst in found]
    return [*cells, percent(tracking["falls"], 2)]


ERRORS = ("velocity RMSE [m/s]", "yaw rate RMSE [rad/s]", "falls [%]")


def over_seeds(values: Sequence[float]) -> str:
    """Return the mean of the seeds (lowest to highest); '-' for a single seed."""
    return f"{mean(values):.3f} ({min(values):.3f} to {max(values):.3f})" if len(values) > 1 else "-"


def points(result: Result, terrain: str) -> dict[float, float]:
    """Return size -> success on a terrain type; nothing if the type was not evaluated."""
    types = result.get("success", {}).get("types", {})
    return {point["size"]: point["share"] for point in types[terrain]["points"]} if terrain in types else {}


def success(result: Result, terrain: str, sizes: Iterable[float], digits: int = 0) -> list[str]:
    """Return cells with the success on a terrain type at some sizes [%]; '-' if a size was not evaluated."""
    found = points(result, terrain)
    return [percent(found[size], digits) if size in found else "-" for size in sizes]


def stairs(result: Result) -> list[float]:
    """Return the highest steps within the trained range that were evaluated, and the next higher ones [m]."""
    sizes = sorted(points(result, "stairs_up"))
    trained_to = result["success"]["types"]["stairs_up"]["trained_to"] if sizes else None
    last = max((i for i, size in enumerate(sizes[:-1]) if size <= (trained_to or 0.0) + 1e-9), default=0)
    return sizes[last : last + 2]


def crossings(result: Result) -> list[str]:
    """Return cells with two step heights, the success up, down and over obstacles at each [%], and the number of robots; '-'
    without evaluated stairs.
    """
    sizes = stairs(result)
    if not sizes:
        return ["-"] * len(CROSSINGS)
    shares = [", ".join(success(result, name, sizes)) for name in CROSSED]
    return [", ".join(f"{size:.2f}" for size in sizes), *shares, str(result["success"]["robots_per_point"])]


CROSSED = ("stairs_up", "stairs_down", "obstacles")
CROSSINGS = ("steps [m]", "up [%]", "down [%]", "obstacles [%]", "robots")


# ---- the tables ------------------------------------------------------------------------------------------------------


def results(policies: Path) -> str:
    """Return the short table of README.md."""

    def quality(task: str) -> str:
        if (policies / task / f"{LEAGUE}.json").exists():
            run = read(policies / task, LEAGUE)["stages"]["punches"]
            ended = f"{percent(run['completed'])} % to the end"
            return f"{run['survival_s']:.1f} of 90 s in the [G1 league](docs/league.md), {ended}"
        result = evaluation(policies / task)
        velocity, _, falls = errors(result)
        text = f"velocity RMSE {velocity.partition(' ')[0]} m/s, {falls} % fall"
        sizes = stairs(result)[:1]
        ways = [share for name in CROSSED[:2] for share in success(result, name, sizes)]
        return f"{text}; stairs of {100 * sizes[0]:.0f} cm: {ways[0]} % up, {ways[1]} % down" if sizes else text

    def effort(task: str) -> str:
        gpu, size, wall, others = training(policies / task)
        environments, _, iterations = size.partition(" x ")
        said = f"{environments} environments, {iterations} iterations"
        if gpu == "-":
            return f"{said}; time not recorded"
        beside = f", sharing the GPU with {others} other training{'s' * (others != '1')}" if others != "0" else ""
        return f"{gpu}, {said}: {wall.partition(' ')[0]} s{beside}"

    tasks = ("anymal_c_flat", "anymal_c", "g1_flat", "g1_teleop", "go2_real", "go2w")
    rows = [[f"`{task}`", descriptions()[task], effort(task), quality(task)] for task in tasks]
    return table(("task", "what it learns", "training", "quality in C MuJoCo"), rows)


def flat(policies: Path) -> str:
    """Return the table of tasks on a plane: training and errors of the shipped seed, and the errors of all seeds."""
    rows = []
    for task in (f"{robot}_flat" for robot in FLAT):
        seeds = [evaluation(folder)["rmse_lin"]["mean"] for folder in seeds_of(policies / task)]
        in_warp = evaluation(policies / task, WARP)["rmse_lin"]["mean"]
        cells = [*errors(evaluation(policies / task)), f"{in_warp:.3f}", over_seeds(seeds)]
        rows.append([f"`{task}`", *training(policies / task), *cells])
    return table(("task", *TRAINING, *ERRORS, "velocity, mujoco-warp", "velocity, all seeds"), rows)


def rough(policies: Path) -> str:
    """Return the table of tasks with terrain: training, errors and success of the shipped seed."""
    tasks = [*FLAT[:1], *(f"anymal_c_{name}" for name in TOLD_LESS), *FLAT[1:]]
    return table(("task", *TRAINING, *ERRORS, *CROSSINGS), [_rough_row(policies, task) for task in tasks])


def _rough_row(policies: Path, task: str) -> list[str]:
    result = evaluation(policies / task)
    return [f"`{task}`", *training(policies / task), *errors(result), *crossings(result)]


def real(policies: Path) -> str:
    """Return the table of tasks for real robots: training, errors and success."""
    return table(("task", *TRAINING, *ERRORS, *CROSSINGS), [_rough_row(policies, name) for name in REAL])


def real_stress(policies: Path) -> str:
    """Return the success of the tasks for real robots on stairs under each disturbance of the stress test."""
    names = {
        "nominal": "nothing",
        "payload": "payload",
        "friction": "friction 0.4",
        "weak motors": "motors at 85 %",
        **{name: name for name in ("delay 20 ms", "delay 40 ms", "pushes", "together", "everything")},
    }
    rows = []
    for task in REAL:
        result = read(policies / task, STRESS)
        lines = {line["name"]: line["stairs"]["share"] for line in result["lines"]}
        shares = [*(lines[name] for name in names), *(result["ground"][name]["share"] for name in NEW_GROUND)]
        rows.append([f"`{task}`", f"{result['definition']['riser_m']:.2f} m", *map(percent, shares)])
    return table(("[%]", "steps", *names.values(), *(name.replace("_", " ") for name in NEW_GROUND)), rows)


def stress(policies: Path) -> str:
    """Return the stress scores of the policies of the ANYmal C, and the number of robots that failed in some lines."""
    chosen = ("payload", "delay 40 ms", "no map", "together", "everything")
    rows = []
    for task in ("anymal_c", *(f"anymal_c_{name}" for name in TOLD_LESS)):
        folders = [policies / task, *sorted(path.parent for path in (policies / task).glob(f"seed_*/{STRESS}.json"))]
        tests = [read(folder, STRESS) for folder in folders]
        score, lines = tests[0]["score"], {line["name"]: line["stairs"] for line in tests[0]["lines"]}
        measured = [*(lines[name] for name in chosen), *(tests[0]["ground"][name] for name in NEW_GROUND)]
        scores = [f"{percent(score['value'], 1)} ({percent(score['low'])} to {percent(score['high'])})"]
        scores += [percent(score[part]) for part in ("stairs", "flat", "ground")]
        failed = [f"{point['robots'] - point['successes']}/{point['robots']}" for point in measured]
        seeds = ", ".join(percent(test["score"]["value"], 1) for test in tests[1:])
        rows.append([f"`{task}`", *scores, *failed, seeds or "-"])
    head = ("task", "score [%] (95 % interval)", "stairs", "flat", "new ground", *chosen)
    return table((*head, *(name.replace("_", " ") for name in NEW_GROUND), "other seeds"), rows)


def others(policies: Path) -> str:
    """Return the table of tasks that are measured by returns, speed or a single step."""

    def returns(folder: Path) -> str:
        found = read(folder, "evaluation_gymnasium")["episodes"]["return"]
        return f"{found['mean']:.0f} ({found['min']:.0f} to {found['max']:.0f})"

    def speed(folder: Path) -> str:
        episodes = evaluation(folder)["episodes"]
        return f"{episodes['metrics']['x_velocity']:.2f}, {percent(episodes['failures'], 1)} % fall"

    def crossed(folder: Path) -> str:
        return ", ".join(f"{share} %" for share in success(evaluation(folder, WARP), "step", (0.15, 0.2), digits=1))

    measures: dict[str, tuple[str, Callable[[Path], str]]] = {
        "half_cheetah": ("return in HalfCheetah-v5 (lowest to highest episode)", returns),
        "humanoid": ("forward speed in C MuJoCo [m/s], falls", speed),
        "anymal_c_step": ("steps of 15 and 20 cm crossed", crossed),
    }
    rows = []
    for task, (name, measured) in measures.items():
        first, *more = seeds_of(policies / task)
        _, size, wall, _ = training(policies / task)
        rows.append([f"`{task}`", size, wall, name, measured(first), "; ".join(map(measured, more)) or "-"])
    return table(("task", *TRAINING[1:3], "measure", "shipped policy", "other seeds"), rows)


def engines(policies: Path) -> str:
    """Return the errors of policies of anymal_c_flat in the engine of their training and in other engines."""
    trained_in = {
        "anymal_c_flat": "mujoco-warp (shipped)",
        "anymal_c_flat/newton_mujoco": "newton mujoco",
        "anymal_c_flat/newton_steel": "newton steel",
        "anymal_c_flat/newton_xpbd": "mujoco-warp, then 50 iterations in xpbd",
    }
    rows = []
    for folder, name in trained_in.items():
        found = {row["physics"]: row for row in read(policies / folder, "crossing")["engines"]}
        measured = [found[engine] for engine in (WARP, C, *(f"newton_{solver}" for solver in SOLVERS))]
        cells = [f"{row['rmse_lin']:.3f}, {row['rmse_ang']:.3f}" for row in measured]
        falls = [f", {percent(row['falls'])} % fall" if row["falls"] else "" for row in measured]
        rows.append([name, *map(str.__add__, cells, falls)])
    return table(("trained in", "mujoco-warp", "C MuJoCo", *(f"newton {solver}" for solver in SOLVERS)), rows)


TABLES: dict[str, Callable[[Path], str]] = {
    made.__name__: made for made in (results, flat, rough, real, real_stress, stress, others, engines)
}

if __name__ == "__main__":
    sys.exit(main())
