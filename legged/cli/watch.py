"""`legged watch`: a policy in the browser."""

import argparse
import math
import sys
from typing import Any

from legged.commandline.arguments import (
    BUILD,
    CHECKPOINT,
    POLICY_HELP,
    TILES,
    override_is_no_name,
    pick_device,
    policy_overrides,
    register_given,
    settle_on,
)
from legged.commandline.command import sub_command
from legged.deploy.command_parser import argument
from legged.errors import ConfigError
from legged.play.live.page import HOST, PORT, Page, free_port, is_loopback, load_viser, url
from legged.play.live.session import MOST_ROBOTS, Session, changes_for, check_ground, find_watched
from legged.process.cores import available_cores

ROBOTS = 4
"""Default number of robots."""
ROBOTS_A_THREAD = 4
"""Number of robots that one core simulates in real time."""


@sub_command(
    "legged watch anymal_c_flat",
    "legged watch anymal_c_flat/2026-11-22_05-38-19 --terrain stairs_up",
    arguments=(
        argument("policy", nargs="?", metavar="POLICY", help=f"{POLICY_HELP}; the newest run of all by default"),
        CHECKPOINT,
        *BUILD,
        *TILES,
        argument("--host", default=HOST, help="address to listen at; by default only this machine can connect"),
        argument("--port", type=int, help=f"port of the page; by default {PORT}, or the next free one"),
    ),
)
def watch(args: argparse.Namespace) -> int:
    """Watch a policy in a browser, also while it is trained: `legged watch anymal_c_flat`.

    The page shows the newest checkpoint of the run, and the next one as soon as it is written. Without POLICY the newest run
    of all is shown. Controls on the page set commands, terrain, pushes and playback speed.
    """
    override_is_no_name(args, "policy")
    register_given(args, "policy")
    port = free_port(args.host, args.port)
    count = ROBOTS if args.num_envs is None else args.num_envs
    if not 1 <= count <= MOST_ROBOTS:
        raise ConfigError(f"--num-envs: must be from 1 to {MOST_ROBOTS}, got {count}")
    device = pick_device(args.sim_device or "cpu")  # by default a GPU is left to the training
    settle_on(device)
    asked = policy_overrides(args)
    watched = find_watched(args.policy, args.checkpoint)
    engine: list[tuple[str, Any]] = []
    if device.type == "cpu":
        engine = [("sim.physics", "mujoco"), ("sim.threads", min(available_cores(), math.ceil(count / ROBOTS_A_THREAD)))]
    changes = changes_for(watched.cfg, count, [*engine, *asked])
    kind = check_ground(watched.cfg, args.terrain, args.difficulty)
    load_viser()
    session = Session(watched, changes, kind, args.difficulty, device, graph=device.type == "cuda" and not args.no_graph)
    page = Page(session, args.host, port)
    try:
        print(session.title(), flush=True)
        if not is_loopback(args.host):
            open_to_all = "everyone who reaches this machine can watch and steer, without a password"
            print(f"warning: --host {args.host}: {open_to_all}", file=sys.stderr, flush=True)
        print(f"watch it at {url(args.host, page.port)} (Ctrl-C ends it)", flush=True)
        page.run()
    finally:
        page.close()
    return 0
