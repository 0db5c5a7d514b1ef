"""A page about a run: `legged runs report anymal_c_flat`.

report.html is written into the run's folder: settings, curves, evaluations and the film on one page that needs no network.
report.md and its pictures lie beside it. A training writes its report when it ends; this command writes it again, after an
evaluation or for a run that was killed. `--film` films the policy first; `--note` keeps a sentence about the run.
"""

import faulthandler
from pathlib import Path

import torch

from legged.cli.runs import folders_of, runs_parser
from legged.commandline.arguments import add_checkpoint_argument
from legged.commandline.command import command
from legged.config import LeggedConfig
from legged.errors import ConfigError, RunError
from legged.evaluation.reports.record import FILMS, read_record
from legged.evaluation.reports.run_report import command_on, write_report
from legged.learning.run_folder import CONFIG_FILE, NOTE_FILE, find_checkpoint, run_config
from legged.play.walking_film import film, write_film
from legged.policies.restore import TrainedPolicy
from legged.process.command_parser import CommandParser
from legged.process.paths import exists, ready_to_write, relative, write_text

SIDE = 320
"""Width and height of the film [pixels]."""
LONGEST_FILM_S = 900.0
"""Longest time for filming; a longer one hangs, and the process is ended [s]."""
LONGEST_NOTE = 1000


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = runs_parser(
        "report",
        __doc__,
        "legged runs report anymal_c_flat/2026-11-22_05-38-19",
        "legged runs report anymal_c_flat --film",
    )
    add_checkpoint_argument(parser)
    parser.add_argument("--film", action="store_true", help=f"film the policy again, into {FILMS[0]}")
    parser.add_argument("--note", help=f"a sentence about the run, kept in its {NOTE_FILE}")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_args(argv)
    if args.checkpoint is not None and not args.film:
        raise ConfigError(f"--checkpoint: {args.checkpoint}: says which policy is filmed; add --film")
    folders = folders_of(args)
    note = " ".join((args.note or "").split())
    if args.note is not None and not 0 < len(note) <= LONGEST_NOTE:
        raise ConfigError(f"--note: expected a sentence of at most {LONGEST_NOTE} letters, got {len(note)}")
    for folder in folders if note else ():
        write_text(folder / NOTE_FILE, f"{note}\n")
    for folder in folders:
        ready_to_write(folder, 4.0)
        if args.film:
            if argv is None:  # a drawing library may hang where exceptions do not reach it
                faulthandler.dump_traceback_later(LONGEST_FILM_S, exit=True, file=2)
            why = _film(folder, args.checkpoint)
            faulthandler.cancel_dump_traceback_later()
            print(f"no film: {why}" if why else f"written: {relative(folder / FILMS[0])}", flush=True)
        print(f"written: {relative(write_report(folder))}", flush=True)
    return 0


def _film(folder: Path, checkpoint: int | str | None) -> str:
    """Film the policy of a run; return the reason if that is impossible, else an empty text."""
    try:
        cfg = run_config(folder)
        if not isinstance(cfg, LeggedConfig):
            command = command_on(read_record(folder), "play")
            return f"'{cfg.task}' has no velocity commands; {command} --gif makes one"
        torch.set_num_threads(1)
        pictures = film(TrainedPolicy(cfg, find_checkpoint(folder, checkpoint)), SIDE)
        if not exists(folder / CONFIG_FILE):
            return "the run folder was removed"
        write_film(pictures, folder / FILMS[0])
    except (ConfigError, RunError) as error:
        return " ".join(str(error).split())
    return ""
