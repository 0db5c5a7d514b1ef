"""Record episodes and list the worst: `legged episodes record anymal_c_flat --worst 1`.

Robots run whole episodes under a policy. episodes.npz and .json hold every state, command, action, torque, contact and reward
term; the episodes that went worst are listed. With --page or --worst each of those gets a page with a film next to plots, all
with one cursor.
"""

from pathlib import Path

from legged.cli.episodes import common
from legged.commandline.arguments import POLICY_HELP, add_checkpoint_argument, register_given
from legged.commandline.command import command
from legged.episodes.ranking import check_ended
from legged.episodes.recorder import check_wish
from legged.episodes.stored import ABOUT, ARRAYS, NO_NUMBERS, TIME_UP, save_episodes
from legged.policies.restore import policy_of
from legged.process.command_parser import CommandParser
from legged.process.paths import ready_to_write, relative

STEP_BYTES = 1200
"""Largest disk space for a control step of a robot [bytes]."""


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    parser = CommandParser(
        "legged episodes record",
        __doc__,
        "legged episodes record anymal_c_flat --worst 1",
        "legged episodes record anymal_c --episodes 100 --sort torque --worst 3",
    )
    parser.add_argument("policy", metavar="POLICY", help=POLICY_HELP)
    add_checkpoint_argument(parser)
    common.add_recording_arguments(parser)
    common.add_listing_arguments(parser)
    parser.add_argument("--out", type=Path, help="folder for all files; episodes/ in the run folder by default")
    return parser


@command
def main(argv: list[str] | None) -> int:
    """Run the command; return its exit code."""
    args = build_parser().parse_intermixed_args(argv)
    common.check_listing(args)
    register_given(args, "policy")
    wish, policy = common.wish_of(args), policy_of(args.policy, args.checkpoint)
    common.pages(args.page, wish.episodes)
    if args.ended is not None:  # checked before the recording replaces an older one
        terms = policy.cfg.terminations
        check_ended(args.ended, [*terms.failures, *terms.time_outs, TIME_UP, NO_NUMBERS])
    check_wish(policy, wish)
    folder = args.out or policy.output("episodes")
    if folder == policy.folder and args.out is None:
        folder /= "episodes"
    steps = round(policy.cfg.env.episode_length_s / policy.cfg.dt)
    ready_to_write(folder, 8.0 + wish.episodes * steps * STEP_BYTES / 2**20)
    episodes, cfg = common.run_episodes(policy, wish, args)
    save_episodes(episodes, cfg, folder)
    print(f"{policy.cfg.task}: {relative(policy.checkpoint)}, {len(episodes)} episodes in {episodes.about['physics']}")
    print(f"written: {relative(folder / ARRAYS)} and {ABOUT}")
    common.show(episodes, folder, args)
    return 0
