"""`legged evaluate league`: the public walking league for Unitree's G1, and the same runs for an H1."""

import argparse

from legged.cli.evaluate import EVALUATED, description_of, exported_file, onnx_file, settle
from legged.commandline.arguments import measuring_device, policy_overrides
from legged.commandline.command import sub_command
from legged.deploy.command_parser import argument, check_number
from legged.errors import ConfigError, suggest
from legged.evaluation.league.measuring import MOST_RUNS, evaluate_foreign, evaluate_league
from legged.evaluation.league.task import STAGES
from legged.evaluation.result_file import CHANGED, changes_of
from legged.policies.foreign import read_layout
from legged.process.paths import ready_to_write

RUNS = 64
"""Default number of runs of each stage."""


@sub_command(
    "legged evaluate league g1_flat",
    "legged evaluate league logs/ppo_g1_29dof.onnx --layout holosoma --stages held,punches --runs 10",
    arguments=(
        *EVALUATED,
        argument("--runs", type=int, default=RUNS, help=f"number of runs of each stage; {RUNS} by default"),
        argument("--stages", default=",".join(STAGES), help=f"stages to measure; {','.join(STAGES)} by default"),
        argument("--layout", help="description of an ONNX file, as in `legged evaluate onnx`"),
    ),
)
def league(args: argparse.Namespace) -> int:
    """Measure a policy of a G1 or an H1 in the public walking league: `legged evaluate league g1_flat`.

    A run is a tour of 18 waypoints in 90 s. It ends when the robot falls. In the stage `own` the policy moves the arms, in
    `held` they are held, in `walking` they move at random, and in `punches` forces hit the robot besides. The last stage is
    the league's own run. Runs have the ids 0, 1, ..., and an id means the same waypoints, arms and punches as in the league.
    Times until the fall and errors at the waypoints are printed, and written to league_<physics>.json.
    """
    check_number("--runs", args.runs, 1, MOST_RUNS)
    stages = [name.strip() for name in args.stages.split(",")]
    for name in stages:
        if name not in STAGES:
            raise ConfigError(f"--stages: there is no stage '{name}'{suggest(name, STAGES)}")
    runs = range(args.runs)
    if exported_file(args.policy) is None:
        if args.layout is not None:
            raise ConfigError("--layout: has no effect on a policy that is not an ONNX file")
        return evaluate_league(settle(args), runs, stages)
    for option in ("checkpoint", "num_envs", "module"):
        if getattr(args, option) is not None:
            raise ConfigError(
                f"--{'import' if option == 'module' else option.replace('_', '-')}: has no effect on an ONNX file"
            )
    file = onnx_file(args.policy)
    layout = read_layout(args.layout or str(description_of(file, file)), "--layout")
    if layout.task:
        raise ConfigError(f"POLICY: {file} tracks a motion; the league measures policies that follow velocity commands")
    overrides, device = policy_overrides(args), measuring_device(args)
    folder = args.out or (file.parent / CHANGED if changes_of(overrides) else file.parent)
    ready_to_write(folder)
    return evaluate_foreign(file, layout, runs, stages, device, not args.no_graph, overrides, folder)
