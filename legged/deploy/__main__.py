"""The robot's program: `python -m legged.deploy FOLDER --robot udp:HOST:PORT|go2|g1`.

The program runs the exported policy in FOLDER at the policy's rate. Beside policy.onnx, the folder has policy.json or
Unitree's deploy.yaml, or the ONNX file has mjlab's metadata. Commands come from the keyboard, a gamepad or a file. At its end
the program writes a log. It needs numpy and onnxruntime, for Unitree's robots also the extra `unitree-sdk2` of the package,
and for deploy.yaml also PyYAML.
"""

import argparse
import gc
import signal
import sys
from contextlib import ExitStack, suppress
from pathlib import Path
from types import FrameType

from legged.deploy.command_parser import CommandParser, argument, check_between
from legged.deploy.errors import ConfigError, RunError, suggest
from legged.deploy.interface import Interface
from legged.deploy.log import check_folder
from legged.deploy.operators import DEVICE, HELP, Event, Gamepad, Keyboard, Operator, Orders, Script
from legged.deploy.pace import StatusMessages, take_priority
from legged.deploy.policy import Policy
from legged.deploy.program import Program
from legged.deploy.safety import Limits
from legged.deploy.udp import UdpRobot
from legged.deploy.unitree import KINDS, SdkWire, UnitreeRobot

ENDING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")
"""Signals at which the program brakes the robot and then ends. They come from Ctrl-C, `kill`, a closed terminal, Ctrl-\\ and
Ctrl-Z. Most of these signals would otherwise end or pause the program without braking the robot."""
SWITCH_S = 5e-4
"""Python's switch interval between threads [s]. Python's default, 5 ms, is a quarter of a 50 Hz cycle."""
EXIT_STOPPED = 3
"""Exit code of a program that ran to its end, but had stopped the robot for safety."""
PROGRAM = (
    argument("--input", choices=tuple(HELP), default="keyboard", help="source of commands; default keyboard"),
    argument("--gamepad", type=Path, default=DEVICE, help=f"device; default {DEVICE}"),
    argument("--commands", type=Path, help="file of commands, in place of a keyboard or gamepad"),
    argument("--seconds", type=float, default=float("inf"), help="end after this time [s]; default: when the operator quits"),
    argument("--stand-seconds", type=float, default=3.0, help="time for standing up [s]; default 3"),
    argument("--max-tilt", type=float, default=Limits.max_tilt, help=f"stop at more tilt [rad]; default {Limits.max_tilt:g}"),
    argument("--max-age", type=float, default=Limits.max_age_s, help=f"largest data age [s]; default {Limits.max_age_s:g}"),
    argument(
        "--max-missed",
        type=int,
        default=Limits.max_missed,
        help=f"stop at this number of missed deadlines in a row; default {Limits.max_missed}",
    ),
)
"""Options of the program that do not depend on the robot."""


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code: 0 success, 1 failure, 2 wrong input, 3 the robot was stopped for safety, 130
    interrupted before a robot was connected.
    """
    try:
        return _main(argv)
    except (ConfigError, RunError) as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return 2 if isinstance(error, ConfigError) else 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr, flush=True)
        return 128 + signal.SIGINT


def build_parser() -> CommandParser:
    """Return the parser of the command line."""
    return CommandParser(
        "python -m legged.deploy",
        __doc__,
        "python -m legged.deploy logs/deploy/anymal_c_proprio/exported --robot udp:127.0.0.1:40000",
        "python -m legged.deploy exported --robot go2 --network eth0 --input gamepad",
        arguments=(
            argument("policy", type=Path, metavar="POLICY", help="folder with policy.onnx and its contract"),
            *PROGRAM,
            argument("--robot", required=True, help=f"udp:HOST:PORT, {' or '.join(KINDS)}"),
            argument("--network", help="network interface to a Unitree robot, e.g. eth0; found automatically by default"),
            argument("--domain", type=int, default=0, help="DDS domain: 0 for a robot, 1 for Unitree's simulator; default 0"),
            argument("--log", type=Path, default=Path("deploy_log.npz"), help="file of the log; default deploy_log.npz"),
        ),
    )


def _main(argv: list[str] | None) -> int:
    args = build_parser().parse_args(argv)
    limits = limits_of(args)
    if not args.robot.startswith("udp:") and args.robot not in KINDS:
        raise ConfigError(f"--robot: '{args.robot}' is unknown{suggest(args.robot, [*KINDS, 'udp:HOST:PORT'])}")
    try:
        fits = args.log.suffix == ".npz" and not args.log.is_dir()
    except OSError:  # the name may be too long
        fits = False
    if not fits:
        raise ConfigError(f"--log: must be the name of an .npz file, got '{args.log}'")
    check_folder(args.log.parent)
    policy = Policy(args.policy)
    if args.robot in KINDS:  # refuse a wrong policy before UnitreeRobot ends the robot's own controller
        policy.fit(KINDS[args.robot].facts)
    operator = Interruptible(make_operator(args))
    tell = StatusMessages()
    hurries = take_priority()  # the threads of a robot's SDK start later, and inherit the priority
    with ExitStack() as opened:
        opened.callback(operator.close)
        if args.robot in KINDS:
            robot: Interface = UnitreeRobot(args.robot, SdkWire(KINDS[args.robot], args.network, args.domain))
        else:
            robot = UdpRobot(args.robot.removeprefix("udp:"))
        opened.callback(robot.close)
        operator.take()
        program = Program(policy, robot, operator, limits, args.stand_seconds, tell=tell)
        opened.pop_all()  # from now on `program` closes operator and robot
    sys.setswitchinterval(SWITCH_S)
    hurry = "with priority" if hurries else "without priority (rtprio), so cycles may begin late on a busy machine"
    tell(f"{policy.contract.task} on {robot.facts.name}, {1.0 / policy.contract.control_dt:g} Hz, {hurry}")
    try:
        program.run(args.seconds)
    finally:
        program.log.save(args.log)
        tell(f"wrote {args.log}")
        tell.close()
    with suppress(OSError):  # the terminal may be closed
        print(program.pace.line(), flush=True)
    gc.collect()
    return EXIT_STOPPED if program.stops else 0


def limits_of(args: argparse.Namespace) -> Limits:
    """Return the limits that the flags set, in seconds, radians and cycles. Each flag has an allowed range, which excludes
    typical mistakes: a tilt in degrees or an age in milliseconds.

    Raises:
        ConfigError: a number is outside its range.
    """
    if not args.seconds > 0.0:
        raise ConfigError(f"--seconds: must be above 0, got {args.seconds:g}")
    check_between("--stand-seconds", args.stand_seconds, 1.0, 60.0)
    check_between("--max-tilt", args.max_tilt, 0.1, 1.6)
    check_between("--max-age", args.max_age, 0.005, 0.5)
    check_between("--max-missed", args.max_missed, 1, 50)
    return Limits(max_tilt=args.max_tilt, max_age_s=args.max_age, max_missed=args.max_missed)


def make_operator(args: argparse.Namespace) -> Operator:
    """Return the operator that the flags choose.

    Raises:
        ConfigError: the file, device or terminal does not exist.
    """
    if args.commands is not None:
        return Script(args.commands)
    operator: Operator = Gamepad(args.gamepad) if args.input == "gamepad" else Keyboard()
    print(HELP[args.input], flush=True)
    return operator


class Interruptible(Operator):
    """An operator that also ends the program when a signal in `ENDING` arrives, for example from Ctrl-C. If a robot is
    connected, the program brakes the robot first. Without a robot the program ends at once.
    """

    def __init__(self, operator: Operator) -> None:
        self._operator, self._ends, self._has_robot = operator, False, False
        for name in ENDING:
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), self._end)

    def _end(self, _number: int, _frame: FrameType | None) -> None:
        if not self._has_robot:
            raise KeyboardInterrupt
        self._ends = True

    def take(self) -> None:
        """Record that a robot is connected. From now on, a signal brakes the robot first, and then ends the program."""
        self._has_robot = True

    def poll(self, seconds: float) -> Orders:
        orders = self._operator.poll(seconds)
        if not self._ends:
            return orders
        return Orders(orders.velocity, (*orders.events, Event.QUIT), orders.shares, orders.lost)

    def close(self) -> None:
        self._operator.close()


if __name__ == "__main__":
    sys.exit(main())
