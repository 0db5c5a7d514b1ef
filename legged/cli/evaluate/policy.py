"""Measure a policy: `legged evaluate anymal_c_flat`.

A policy that follows velocity commands is measured over a grid of commands and, if it was trained on terrain, on terrain of
growing size, as `legged evaluate grid` and `legged evaluate terrain` do. Other policies run full episodes, as with
`legged evaluate episodes`. An ONNX file or an exported folder is measured as by `legged evaluate onnx`.

The tables are printed; evaluation_<physics>.json and pictures are written beside the checkpoint.
"""

import argparse

from legged.cli.evaluate import onnx
from legged.cli.evaluate.common import check_points, evaluation_parser, grid_of, settle
from legged.cli.evaluate.episodes import ENVIRONMENTS
from legged.cli.main import hint_at_sub_command
from legged.commandline.command import command
from legged.config import LeggedConfig
from legged.errors import ConfigError
from legged.evaluation.episodes import evaluate_episodes
from legged.evaluation.following import evaluate_following
from legged.evaluation.success import chosen_sizes
from legged.process.command_parser import CommandParser


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    return evaluation_parser(
        "evaluate", __doc__, "legged evaluate anymal_c --physics mujoco", "legged evaluate half_cheetah --seed 3"
    )


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    if onnx.exported_file(args.policy) is not None:
        _check_plain(args)
        return onnx.evaluate([args.policy, *(["--out", str(args.out)] if args.out else [])])
    with hint_at_sub_command("evaluate", [args.policy]):
        setting = settle(args, follows=False)
    cfg = setting.policy.cfg
    if not isinstance(cfg, LeggedConfig):
        return evaluate_episodes(setting, ENVIRONMENTS)
    sizes = chosen_sizes(cfg, None, False, setting.cfg.terrain.scale)
    return evaluate_following(setting, grid_of(setting), sizes, check_points(None, False))


def _check_plain(args: argparse.Namespace) -> None:
    """Check that no option is given that has no effect on an ONNX file, which runs in C MuJoCo unchanged."""
    if args.overrides:
        raise ConfigError(f"{args.overrides[0]}: an ONNX file runs as it is; `legged evaluate onnx` has its options")
    plain = vars(build_parser().parse_args([args.policy]))
    for name, value in vars(args).items():
        if value != plain[name] and name not in ("out", "overrides"):
            option = f"--{'import' if name == 'module' else name.replace('_', '-')}"
            raise ConfigError(f"{option}: means nothing for an ONNX file; `legged evaluate onnx` has its options")
