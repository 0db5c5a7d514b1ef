"""The report on a run: `python -m legged.tools.report logs/anymal_c_flat/<run>`, or `--task anymal_c_flat` for the newest.

Writes report.html, which holds all that it shows and opens without a network, and report.md with its pictures beside it, into
the run folder. A training does that by itself when it ends; this makes it anew, after an evaluation or for a run that was
killed. `--film` films the policy first, where pictures can be drawn; `--note` keeps a sentence about the run in it.
"""

import argparse
import faulthandler
import sys
from pathlib import Path

import torch

from legged.commandline.arguments import add_run_arguments, register_given
from legged.commandline.command import run_main
from legged.commandline.parser import CommandParser, add_import_argument
from legged.config import LeggedConfig
from legged.errors import ConfigError, RunError
from legged.evaluation.reports.record import FILMS, read_record
from legged.evaluation.reports.run_report import command_on, write_report
from legged.learning.run_folder import CONFIG_FILE, NOTE_FILE, find_checkpoint, find_run, run_config
from legged.play.contact_sheet import film, sheet, write_sheet
from legged.policies.restore import TrainedPolicy
from legged.process.paths import exists, ready_to_write, relative, write_text
from legged.registry import import_tasks, task_config

SIDE = 320
"""Width and height of the film [pixels]."""
LONGEST_FILM_S = 900.0
"""Filming that takes longer hangs, and ends the process [s]."""
LONGEST_NOTE = 1000


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(_main, argv)


def build_parser() -> CommandParser:
    """Return what reads the command line."""
    parser = CommandParser(
        "report",
        __doc__,
        "python -m legged.tools.report logs/anymal_c_flat/2026-11-22_05-38-19",
        "python -m legged.tools.report --task anymal_c_flat --film",
    )
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="run folders")
    parser.add_argument("--task", help="report on a run of this task; a name or a YAML file")
    add_run_arguments(parser)
    add_import_argument(parser)
    parser.add_argument("--film", action="store_true", help=f"film the policy anew, into {FILMS[0]}")
    parser.add_argument("--note", help=f"a sentence about the run, kept in its {NOTE_FILE}")
    return parser


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_args(argv)
    if args.checkpoint is not None and not args.film:
        raise ConfigError(f"--checkpoint: {args.checkpoint}: says which policy is filmed; add --film")
    if args.task:
        register_given(args)
    elif args.module:
        import_tasks(args.module)
    folders = _folders(args)
    if args.note is not None:
        write_note(folders, args.note)
    for folder in folders:
        ready_to_write(folder, 4.0)
        if args.film:
            if argv is None:  # a library that draws may hang where no exception reaches it
                faulthandler.dump_traceback_later(LONGEST_FILM_S, exit=True, file=2)
            why = _film(folder, args.checkpoint)
            faulthandler.cancel_dump_traceback_later()
            print(f"no film: {why}" if why else f"written: {relative(folder / FILMS[0])}", flush=True)
        print(f"written: {relative(write_report(folder))}", flush=True)
    return 0


def _folders(args: argparse.Namespace) -> list[Path]:
    """Return the run folders that the command line names.

    Raises:
        ConfigError: it names none, or one that is no run folder.
    """
    if args.runs and args.load_run is not None:
        raise ConfigError(f"--load_run: '{args.load_run}' beside run folders; name runs in one of both ways")
    if args.runs:
        for folder in args.runs:
            if not exists(folder / CONFIG_FILE):
                raise ConfigError(f"{folder}: is no run folder (it has no {CONFIG_FILE})")
        return list(args.runs)
    if not args.task:
        raise ConfigError("--task: which run? Name its folder, or its task and, if it is not the newest, --load_run")
    changes = [("train.runner.experiment_name", args.experiment_name)] if args.experiment_name else []
    return [find_run(task_config(args.task, changes), args.load_run)]


def write_note(folders: list[Path], text: str) -> None:
    """Keep a sentence in run folders.

    Raises:
        ConfigError: it is none.
        RunError: it can't be written.
    """
    if not text.strip() or len(text) > LONGEST_NOTE:
        raise ConfigError(f"--note: expected a sentence of at most {LONGEST_NOTE} letters, got {len(text.strip())}")
    for folder in folders:
        write_text(folder / NOTE_FILE, " ".join(text.split()) + "\n")


def _film(folder: Path, checkpoint: int | str | None) -> str:
    """Film the policy of a run; return why that can't be done, nothing if it was."""
    try:
        cfg = run_config(folder)
        if not isinstance(cfg, LeggedConfig):
            command = command_on(read_record(folder), "play", "--load_run")
            return f"'{cfg.task}' follows no commands; {command} --gif makes one"
        torch.set_num_threads(1)
        policy = TrainedPolicy(cfg, find_checkpoint(folder, checkpoint))
        pictures = sheet([film(policy, SIDE)], [cfg.task])
        if not exists(folder / CONFIG_FILE):
            return "the run folder has gone"
        write_sheet(pictures, folder / FILMS[0])
    except (ConfigError, RunError) as error:
        return " ".join(str(error).split())
    return ""


if __name__ == "__main__":
    sys.exit(main())
