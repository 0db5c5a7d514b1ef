"""Time of a control step, of the physics in it, and of training iterations: `legged benchmark step anymal_c_flat`.

Random actions move the robots, or a policy with `--policy`. Robots that flail under random actions need more solver rounds
where their physics is randomised or has dry friction. On a GPU the timed steps run under torch's sync debug mode "error",
which raises at any synchronisation with the host.
"""

from legged.benchmarks.kernel_times import kernel_times, table
from legged.benchmarks.step_times import report
from legged.cli.benchmark.common import (
    add_arguments,
    add_memory,
    add_step_arguments,
    measure,
    policy_in,
    settle,
    taught,
    time_loops,
    write,
)
from legged.commandline.arguments import settle_on
from legged.commandline.command import command
from legged.errors import ConfigError
from legged.process.command_parser import CommandParser

KERNEL_STEPS = 20
"""Number of control steps whose kernels --kernels times."""


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged benchmark step",
        __doc__,
        "legged benchmark step anymal_c_flat --runner captured --out times",
        "legged benchmark step go2 --num-envs 8192 --policy go2",
    )
    add_arguments(parser)
    add_step_arguments(parser)
    parser.add_argument("--kernels", type=int, metavar="COUNT", help="also list this many kernels that take longest (GPU)")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    cfg, device = settle(args)
    if args.kernels is not None and device.type != "cuda":
        raise ConfigError(f"--kernels: needs a GPU, and the task is on {device}")
    if args.kernels is not None and args.policy is not None:
        raise ConfigError("--kernels: lists the launches under random actions; leave out either --kernels or --policy")
    settle_on(device)
    count = args.iterations if args.iterations is not None else (3 if device.type == "cpu" else 20)
    policy = policy_in(args, cfg)
    cfg, teacher = taught(cfg, count)
    task, result = measure(cfg, device, args, policy)
    if args.kernels is not None:
        times = kernel_times(task, KERNEL_STEPS)
        result["kernels"] = [vars(time) for time in times]
        print(table(times, args.kernels), flush=True)
    if count > 0:
        result["iterations"] = time_loops(task, cfg, teacher, args.runner, count)
    add_memory(result, device)
    print(report(task, result), flush=True)
    write(args, result)
    return 0
