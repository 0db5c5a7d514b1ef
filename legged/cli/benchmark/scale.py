"""Speed and memory against the number of robots: `legged benchmark scale anymal_c --robots 1024,4096,16384`.

Each number is measured as by `legged benchmark step`, in a process of its own, so that each has the memory to itself.
"""

import sys

from legged.benchmarks.scale import numbers, scale
from legged.cli.benchmark.common import add_arguments, add_step_arguments, settle, write
from legged.commandline.command import command
from legged.errors import ConfigError
from legged.process.command_parser import CommandParser


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged benchmark scale",
        __doc__,
        "legged benchmark scale anymal_c --robots 1024,4096,16384",
        "legged benchmark scale go2_flat --robots 256,1024 --iterations 0 --out times",
    )
    add_arguments(parser)
    add_step_arguments(parser)
    parser.add_argument("--robots", required=True, help="numbers of robots, e.g. 1024,4096,16384")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    sizes = numbers(args.robots)
    if args.num_envs is not None:
        raise ConfigError("--num-envs: --robots names all numbers of robots; leave it out")
    cfg, device = settle(args)
    result = scale(sizes, args.runner or cfg.train.runner.loop, sys.argv[1:] if argv is None else argv, cfg, device)
    write(args, result.found)
    return result.code
