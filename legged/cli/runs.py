"""`legged runs`: tables and pages about runs and evaluations."""

import argparse
import faulthandler
from pathlib import Path

import torch
from rich.console import Console

from legged.cli.main import hint_at_sub_command
from legged.commandline.arguments import CHECKPOINT, IMPORT, import_given
from legged.commandline.command import sub_command
from legged.config import follows_velocities
from legged.deploy.command_parser import argument
from legged.errors import ConfigError, RunError
from legged.evaluation.learning_curves import Log, common_time, labels, levels, outcomes, read_config, read_scalars
from legged.evaluation.reports.charts import draw_charts
from legged.evaluation.reports.comparison import (
    Evaluations,
    comparison_parts,
    draw_comparison,
    episodes_comparison,
    grouped,
    keep_types,
    success_table,
    tracking_table,
)
from legged.evaluation.reports.document import to_html, to_markdown, write_pages
from legged.evaluation.reports.experiments import TITLE, experiments_parts
from legged.evaluation.reports.record import FILMS, folders_in, read_record
from legged.evaluation.reports.run_report import command_on, write_report
from legged.evaluation.result_file import has_tracking, read_results
from legged.evaluation.success import types_in
from legged.learning.run_folder import CONFIG_FILE, LOGS, NOTE_FILE, find_checkpoint, own_run, run_config
from legged.play.films import film, write_film
from legged.policies.restore import TrainedPolicy
from legged.process.paths import exists, make_folder, ready_to_write, relative, write_text
from legged.process.startup import command_of_ours

SIDE = 320
"""Width and height of the film [pixels]."""
LONGEST_FILM_S = 900.0
"""Time limit for filming [s]. A process that takes longer is assumed to hang, and is ended."""
LONGEST_NOTE = 1000
MOST_COMPARED = 8
"""Largest number of runs in a comparison. Each run has its own colour, and there are eight colours."""
PICTURE = "learning_curve.png"
RUNS = (argument("runs", nargs="+", metavar="RUN", help="a run, its folder, or a task (its newest run)"), IMPORT)
"""The positional argument RUN, which takes one or more runs, and the option --import."""


def _folders_of(args: argparse.Namespace) -> list[Path]:
    """Register the user-defined tasks of --import, and return the folders of the runs on the command line.

    Raises:
        ConfigError: there is no such run or module.
    """
    import_given(args)
    return [own_run(name, "RUN") for name in args.runs]


@sub_command(
    "legged runs",
    "legged runs logs/anymal_c_flat logs/go2_flat --seeds-share",
    arguments=(
        argument("folders", nargs="*", type=Path, metavar="FOLDER", help=f"folders of runs; {LOGS}/ by default"),
        argument("--out", type=Path, metavar="FOLDER", help=f"folder for the pages; by default the first FOLDER, or {LOGS}/"),
        argument("--seeds-share", action="store_true", help="one row of means for runs that differ in their seed only"),
        IMPORT,
    ),
)
def runs(args: argparse.Namespace) -> int:
    """List all runs in one table: `legged runs`.

    Every run in logs/, or in the folders given, becomes a row of experiments.html and experiments.md, newest first. The
    HTML page can be sorted and filtered. With `--seeds-share`, runs that differ only in their seed share a row of means.
    """
    import_given(args)
    folder: Path = args.out or (args.folders[0] if args.folders else LOGS)
    if exists(folder) or args.out is not None:  # otherwise `folders_in` reports that the folder does not exist
        ready_to_write(folder, 4.0)
    with hint_at_sub_command("runs", list(map(str, args.folders))):
        found = {run.resolve(): run for given in args.folders or [LOGS] for run in folders_in(given)}
    records = [read_record(run) for run in found.values()]
    make_folder(folder)
    parts = {ending: experiments_parts(records, folder, ending, args.seeds_share) for ending in ("md", "html")}
    write_text(folder / "experiments.md", to_markdown(TITLE, parts["md"], "experiments"))
    page = folder / "experiments.html"
    write_text(page, to_html(TITLE, parts["html"]))
    print(f"written: {relative(page)}, {len(records)} runs")
    return 0


@sub_command(
    "legged runs report anymal_c_flat/2026-11-22_05-38-19",
    "legged runs report anymal_c_flat --film",
    arguments=(
        *RUNS,
        CHECKPOINT,
        argument("--film", action="store_true", help=f"film the policy again, into {FILMS[0]}"),
        argument("--note", help=f"a sentence about the run, kept in its {NOTE_FILE}"),
    ),
)
def report(args: argparse.Namespace) -> int:
    """Write a page about a run: `legged runs report anymal_c_flat`.

    report.html in the run's folder shows settings, curves, evaluations and the film, and needs no internet. report.md has the
    same contents. Both are written when a training ends. This command writes them again, e.g. after an evaluation, or for a
    run that was killed. `--film` adds a new film of the policy; `--note` stores a sentence about the run.
    """
    if args.checkpoint is not None and not args.film:
        raise ConfigError(f"--checkpoint: {args.checkpoint}: has no effect without --film; add --film")
    folders = _folders_of(args)
    note = " ".join((args.note or "").split())
    if args.note is not None and not 0 < len(note) <= LONGEST_NOTE:
        raise ConfigError(f"--note: expected a sentence of at most {LONGEST_NOTE} letters, got {len(note)}")
    for folder in folders if note else ():
        write_text(folder / NOTE_FILE, f"{note}\n")
    for folder in folders:
        ready_to_write(folder, 4.0)
        print(f"written: {relative(write_report(folder))}", flush=True)  # this report stays if filming fails
        if args.film:
            if command_of_ours():  # if drawing hangs, this timer ends the command's process
                faulthandler.dump_traceback_later(LONGEST_FILM_S, exit=True, file=2)
            why = _film(folder, args.checkpoint)
            faulthandler.cancel_dump_traceback_later()
            if not why:
                write_report(folder)
            print(f"no film: {why}" if why else f"written: {relative(folder / FILMS[0])}", flush=True)
    return 0


def _film(folder: Path, checkpoint: int | str | None) -> str:
    """Film the policy of a run. Return the reason why there is no film, or an empty text if there is one."""
    try:
        cfg = run_config(folder)
        if not follows_velocities(cfg):
            command = command_on(read_record(folder), "play")
            return f"'{cfg.task}' has no velocity commands; film it with `{command} --gif`"
        torch.set_num_threads(1)
        pictures = film(TrainedPolicy(cfg, find_checkpoint(folder, checkpoint)), SIDE)
        if not exists(folder / CONFIG_FILE):
            return "the run folder was removed"
        write_film(pictures, folder / FILMS[0])
    except (ConfigError, RunError) as error:
        return " ".join(str(error).split())
    return ""


@sub_command(
    "legged runs compare anymal_c_flat/11-22_s1 anymal_c_flat/11-22_s2",
    "legged runs compare anymal_c_flat go2_flat --out comparison",
    arguments=(
        *RUNS,
        argument("--out", type=Path, default=LOGS, metavar="FOLDER", help=f"folder for the pages; {LOGS}/ by default"),
    ),
)
def compare(args: argparse.Namespace) -> int:
    """Show several runs side by side: `legged runs compare A B`.

    comparison.html and comparison.md show the settings that differ, plots with the learning curves of all runs, and the
    evaluations with confidence intervals. Every run is compared with the first one.
    """
    if not 2 <= len(args.runs) <= MOST_COMPARED:
        raise ConfigError(f"RUN: expected 2 to {MOST_COMPARED} runs, got {len(args.runs)}")
    folders = _folders_of(args)
    if len({run.resolve() for run in folders}) < len(folders):
        raise ConfigError(f"RUN: a run is given twice: {', '.join(args.runs)}")
    ready_to_write(args.out, 4.0)
    records = [read_record(run) for run in folders]
    make_folder(args.out)
    page = write_pages(args.out / "comparison", "Comparison", comparison_parts(records))
    print(f"written: {relative(page)}, {len(records)} runs")
    return 0


@sub_command(
    "legged runs evaluations logs/anymal_c_flat/2026-11-22_05-38-19 logs/anymal_c_flat/2026-11-22_06-02-41",
    "legged runs evaluations logs/anymal_c/*/evaluation_mujoco.json --types stairs_up,slope_up --out pictures",
    arguments=(
        argument(
            "paths", nargs="+", type=Path, metavar="PATH", help="evaluation_<physics>.json files, or folders that hold them"
        ),
        argument("--types", help="terrain types to show, e.g. stairs_up,slope_up; all by default"),
        argument("--out", type=Path, help="folder for success.png, a picture of success against difficulty"),
    ),
)
def evaluations(args: argparse.Namespace) -> int:
    """Show evaluation files side by side: `legged runs evaluations logs/anymal_c/RUN logs/anymal_c/RUN`.

    Evaluations of the same task, engine, overrides and grid of commands form a group, e.g. those of several seeds. Tables
    show the mean of each group and the largest deviation from the mean. The picture shows the mean and the range.
    """
    if args.out:
        ready_to_write(args.out)
    results = read_results(args.paths)
    if args.types:
        keep_types(results, [name.strip() for name in args.types.split(",")])
    episodes: Evaluations = {}
    following: Evaluations = {}
    for key, seeds in grouped(results).items():
        of_episodes = {"episodes" in result for result in seeds}
        if len(of_episodes) > 1:
            told = "some files hold tracking errors, and other files hold episode returns; compare them separately"
            raise ConfigError(f"{key[0]} in {key[1]}: {told}")
        (episodes if of_episodes.pop() else following)[key] = seeds
    tracked = {key: seeds for key, seeds in following.items() if any(map(has_tracking, seeds))}
    with_success = {key: seeds for key, seeds in following.items() if any(map(types_in, seeds))}
    console = Console(width=130)
    for groups, table in ((tracked, tracking_table), (episodes, episodes_comparison), (with_success, success_table)):
        if groups:
            console.print(table(groups))
    if args.out:
        if not with_success:
            raise ConfigError("--out: there is nothing to draw, because no file holds success rates on terrain; omit --out")
        make_folder(args.out)
        draw_comparison(with_success, args.out / "success.png")
        print(f"written: {relative(args.out / 'success.png')}")
    return 0


@sub_command(
    "legged runs curves anymal_c_flat/2026-11-22_05-38-19",
    "legged runs curves logs/anymal_c/*_s1 logs/anymal_c/*_s2 --out pictures",
    arguments=(
        *RUNS,
        argument("--out", type=Path, default=Path("."), help=f"folder for {PICTURE}; the working directory by default"),
    ),
)
def curves(args: argparse.Namespace) -> int:
    """Draw learning curves of runs as a picture: `legged runs curves anymal_c_flat`.

    learning_curve.png shows returns, errors, falls and metrics over iterations, one line for each run. An axis on top shows
    the time, unless the runs differ by more than 5 % in the time of an iteration. For runs on terrain the picture also shows
    the mean level on each terrain type, and how large a share of episodes moved the robot to a higher or a lower level.
    """
    folders = _folders_of(args)
    ready_to_write(args.out)
    logs = [Log(read_scalars(run), read_config(run)) for run in folders]
    named = list(zip(labels(folders, [log.config for log in logs]), logs, strict=True))
    charts = [*outcomes(named), *levels(logs)]
    if not charts:
        raise ConfigError(f"{relative(folders[0])}: its TensorBoard file holds no returns, errors or metrics")
    make_folder(args.out)
    draw_charts(charts, args.out / PICTURE, iteration_s=common_time([log.scalars for log in logs]))
    print(f"written: {relative(args.out / PICTURE)}")
    return 0
