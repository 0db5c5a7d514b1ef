"""A Go2 or a G1 controlled by Unitree's SDK 2, on the network or in Unitree's simulator."""

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib import import_module
from typing import Any, Protocol

import numpy as np

from legged.deploy.interface import Interface, Reading
from legged.deploy.unitree_messages import (
    KINDS,
    L2,
    OTHER_G1,
    SELECT,
    B,
    UnitreeKind,
    copy_into,
    fill_command,
    new_command,
    pressed,
)
from legged.errors import ConfigError, RunError

COMMAND_TOPIC, STATE_TOPIC = "rt/lowcmd", "rt/lowstate"
SWITCHER = "unitree_sdk2py.comm.motion_switcher.motion_switcher_client"
SIMULATOR_DOMAIN = 1
"""DDS domain of Unitree's own simulator."""
REPEAT_S = 0.005
"""Interval at which a command is repeated; motors and simulators expect several per control step [s]."""
HOLD_S = 0.1
"""Time without a new command after which the program counts as dead and joints are braked [s]."""
FIRST_STATE_S = 5.0
"""Time within which a robot must send its first state [s]."""
RELEASE_S = 10.0
"""Time within which a robot must leave its own controller [s]."""
BRAKING = 2.0
"""D gain of joints that are braked after the program died [N m s/rad]."""


class Wire(Protocol):
    """Transport of Unitree's messages."""

    def new_command(self) -> Any:
        """Return a LowCmd_ of the robot's kind, with zeros."""

    def listen(self, heard: Callable[[Any], None]) -> None:
        """Call `heard` with every LowState_ from another thread."""

    def take_over(self) -> None:
        """Make the robot leave its own controller before the first command, since two programs must never command one robot.

        Raises:
            RunError: the robot keeps its controller or does not answer.
        """

    def send(self, command: Any) -> None:
        """Send a LowCmd_."""

    def close(self) -> None:
        """Release the connection."""


class SdkWire:
    """Transport by Unitree's SDK (the extra `unitree-sdk2`)."""

    def __init__(self, kind: UnitreeKind, network: str | None, domain: int) -> None:
        """Join the network by the interface `network`, such as eth0. The DDS domain 0 is a robot's, `SIMULATOR_DOMAIN` that
        of Unitree's simulator.

        Raises:
            ConfigError: the SDK is not installed, or cannot join the network.
        """
        try:
            channel = import_module("unitree_sdk2py.core.channel")
            default = import_module("unitree_sdk2py.idl.default")
            messages = import_module(f"unitree_sdk2py.idl.{kind.package}.msg.dds_")
            # A simulator has no controller to leave.
            self._switcher = None if domain == SIMULATOR_DOMAIN else import_module(SWITCHER)
        except ImportError as error:
            raise ConfigError(
                f"--robot: Unitree's SDK cannot be imported ({' '.join(str(error).split())}): pip install"
                " 'legged[unitree-sdk2]'; where that is done, install it from Unitree's own sources (unitree_sdk2_python)"
            ) from error
        try:
            channel.ChannelFactoryInitialize(domain, network)
        except Exception as error:  # the SDK raises plain exceptions
            raise ConfigError(f"--network: {network or 'none given'}: domain {domain} cannot be joined ({error})") from error
        self._new: Callable[[], Any] = getattr(default, f"{kind.package}_msg_dds__LowCmd_")
        self._publisher = channel.ChannelPublisher(COMMAND_TOPIC, messages.LowCmd_)
        self._publisher.Init()
        self._subscriber = channel.ChannelSubscriber(STATE_TOPIC, messages.LowState_)

    def new_command(self) -> Any:
        return self._new()

    def listen(self, heard: Callable[[Any], None]) -> None:
        self._subscriber.Init(heard, 10)

    def take_over(self) -> None:
        if self._switcher is None:
            return
        client = self._switcher.MotionSwitcherClient()
        client.SetTimeout(RELEASE_S)
        client.Init()
        end, answered = time.perf_counter() + RELEASE_S, False
        while time.perf_counter() < end:
            code, mode = client.CheckMode()
            if code == 0 and not (mode or {}).get("name"):
                return
            answered |= code == 0
            client.ReleaseMode()
            time.sleep(1.0)
        if not answered:
            raise RunError("--robot: nobody says whether the robot's own controller is on; is --network the right one?")
        raise RunError(f"--robot: the robot's own controller is still on after {RELEASE_S:g} s; leave it by hand")

    def send(self, command: Any) -> None:
        if self._publisher.Write(command) is False:  # the SDK does not raise
            raise RunError("--robot: Unitree's SDK could not send a command")

    def close(self) -> None:
        self._subscriber.Close()
        self._publisher.Close()


class UnitreeRobot(Interface):
    """A Unitree robot. A thread repeats the newest command, and brakes the joints if the program dies."""

    def __init__(self, name: str, wire: Wire, repeat_s: float = REPEAT_S) -> None:
        """Wait for the first state of the robot `name`, a key of `KINDS`, and make it leave its own controller.

        Raises:
            ConfigError: the robot has fewer joints.
            RunError: the robot sends no state, or keeps its controller.
        """
        self.kind = KINDS[name]
        self.facts = self.kind.facts
        self._wire, self._repeat_s = wire, repeat_s
        self._places = list(self.kind.motors)
        self._lock = threading.Lock()
        self._heard: list[Reading] = []
        self._mode_machine: int | None = None
        self._first = threading.Event()
        wire.listen(self._hear)
        try:
            self._meet(name)
        except BaseException:  # Ctrl-C too
            wire.close()
            raise
        self._record = new_command(self.kind, self._mode_machine or 0)
        self._command = wire.new_command()
        self._written: float | None = None
        self._braked = False
        self._closing = threading.Event()
        self._repeater = threading.Thread(target=self._repeat, name="unitree-commands", daemon=True)
        self._repeater.start()

    def _meet(self, name: str) -> None:
        """Wait for the first state, check that it is from the robot `name`, and take over."""
        if not self._first.wait(FIRST_STATE_S):
            raise RunError(
                f"--robot: {name}: no state came within {FIRST_STATE_S:g} s; is it on, and --network the right one?"
            )
        lacks = OTHER_G1.get(self._mode_machine or 0) if name == "g1" else None
        if lacks is not None:
            raise ConfigError(f"--robot: g1: mode_machine is {self._mode_machine}: this robot has {lacks}, not 29 joints")
        self._wire.take_over()
        with self._lock:
            del self._heard[:-1]  # only the newest state counts

    def _hear(self, state: Any) -> None:
        """Store the reading of a LowState_."""
        received = time.perf_counter()
        motors = [state.motor_state[place] for place in self._places]
        reading = Reading(
            time=1e-3 * float(state.tick),
            received=received,
            quaternion=np.array(state.imu_state.quaternion, dtype=float),
            gyro=np.array(state.imu_state.gyroscope, dtype=float),
            positions=np.array([motor.q for motor in motors], dtype=float),
            velocities=np.array([motor.dq for motor in motors], dtype=float),
            torques=np.array([motor.tau_est for motor in motors], dtype=float),
            temperatures=np.array([np.max(motor.temperature) for motor in motors], dtype=float),
            stop=pressed(state.wireless_remote, SELECT)
            or (pressed(state.wireless_remote, L2) and pressed(state.wireless_remote, B)),
        )
        with self._lock:
            self._heard.append(reading)
            self._mode_machine = int(getattr(state, "mode_machine", 0))
        self._first.set()

    def ask(self, sources: Mapping[str, np.ndarray | None]) -> None:
        """Do nothing: the robot has no sources, and policies that need one are refused."""

    def read(self) -> list[Reading]:
        with self._lock:
            found, self._heard = self._heard, []
        return found

    def write(self, positions: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        with self._lock:
            self._fill(positions, stiffness, damping)
            self._written, self._braked = time.perf_counter(), False
            self._wire.send(self._command)

    def _fill(self, positions: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        if "mode_machine" in (self._record.dtype.names or ()):
            self._record["mode_machine"] = self._mode_machine or 0
        fill_command(self._record, self.kind, positions, stiffness, damping)
        copy_into(self._record, self._command)

    def _repeat(self) -> None:
        """Send the newest command until the robot is released; brake once the command is too old."""
        nothing = np.zeros(len(self._places))
        while not self._closing.wait(self._repeat_s):
            with self._lock:
                if self._written is None:
                    continue
                if not self._braked and time.perf_counter() - self._written > HOLD_S:
                    self._fill(nothing, nothing, np.full(len(self._places), BRAKING))
                    self._braked = True
                with suppress(Exception):  # a later command may succeed; `write` raises its own errors
                    self._wire.send(self._command)

    def close(self) -> None:
        self._closing.set()
        self._repeater.join()
        self._wire.close()
