"""Robustness of a policy: `legged evaluate stress anymal_c`.

Each line of the table is a disturbance (payload, friction, weak motors, delay, ...), unknown ground, or other solver
settings, on stairs and on the flat. The share of robots that succeed is printed and written to stress_<physics>.json and
.png.
"""

from legged.cli.evaluate.common import add_points_arguments, check_points, evaluation_parser, settle
from legged.commandline.command import command
from legged.errors import ConfigError, suggest
from legged.evaluation.stress.disturbances import NAMES
from legged.evaluation.stress.measuring import RISER, TREAD, Bench, evaluate_stress
from legged.process.command_parser import CommandParser

LIMITS = {"riser": (0.0, 1.0, "m"), "tread": (0.05, 2.0, "m"), "payload": (0.0, 1000.0, "kg")}
"""Option -> smallest and largest number, and its unit."""


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = evaluation_parser(
        "evaluate stress",
        __doc__,
        "legged evaluate stress anymal_c --physics mujoco",
        "legged evaluate stress go2 --lines nominal,payload,together --riser 0.12",
    )
    parser.add_argument("--lines", help="lines of the table, e.g. 'nominal,payload,together'; all, and a score, by default")
    parser.add_argument("--riser", type=float, help=f"height of a step [m]; {RISER} for a robot half a metre high")
    parser.add_argument("--tread", type=float, default=TREAD, help=f"width of a step [m]; {TREAD} by default")
    parser.add_argument("--payload", type=float, help="mass on the base [kg]; 8 kg for an ANYmal C, in proportion for others")
    add_points_arguments(parser, "all lines with every solver")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    robots = check_points(args.robots_per_point, args.full)
    for option, (low, high, unit) in LIMITS.items():
        value = getattr(args, option)
        if value is not None and not low <= value <= high:
            raise ConfigError(f"--{option}: must be between {low:g} and {high:g} {unit}, got {value:g}")
    lines = [name.strip() for name in args.lines.split(",")] if args.lines is not None else []
    for name in lines:
        if name not in NAMES:
            raise ConfigError(f"--lines: there is no line '{name}'{suggest(name, NAMES)}")
    return evaluate_stress(Bench(settle(args), robots, args.riser, args.tread, args.payload, lines), args.full)
