"""The control loop: read, decide, write and log, at the rate of the policy."""

import gc
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from legged.deploy.interface import Interface, Reading
from legged.deploy.log import Log
from legged.deploy.operators import MOVING, TRANSITIONS, Event, Operator, Orders, Ramp, State
from legged.deploy.pace import Pace
from legged.deploy.policy import Policy
from legged.deploy.safety import Limits, Watch, braking, clamp_targets

STANDS_WITHIN = 0.6
"""Largest deviation of a joint from the default pose at which a robot counts as standing [rad]. The limit leaves room for the
deviation that the robot's weight causes."""
THERE = 0.05
"""Largest deviation of a joint from the default pose at which the robot stands up without folding its legs first [rad]."""
FAR = 100.0
"""Joint angle above which a measurement counts as invalid [rad]."""
HALT_S = 1.0
"""Time with the command zero between walking and standing [s]. Without this time, a robot that walks at 1 m/s would fall."""
RETURN_S = 0.3
"""Duration of the motion to the default pose from walking or from a nearby pose [s]. In a slow motion a robot tips over."""
SETTLE_S = 1.0
"""Time for which joints are braked before the program releases the robot [s]."""


def along(path: Sequence[np.ndarray], share: float) -> np.ndarray:
    """Return the pose (D,) after a share of a path's time. All segments take the same time, and start and end at rest."""
    legs = len(path) - 1
    i = min(int(share * legs), legs - 1)
    part = min(1.0, share * legs - i)
    smooth = part * part * (3.0 - 2.0 * part)
    return np.asarray((1.0 - smooth) * path[i] + smooth * path[i + 1])


class Program:
    """Control loop of one policy on one robot with one operator."""

    def __init__(
        self,
        policy: Policy,
        robot: Interface,
        operator: Operator,
        limits: Limits | None = None,
        stand_s: float = 3.0,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], object] = time.sleep,
        tell: Callable[[str], object] = print,
    ) -> None:
        """Check that the policy fits the robot. Standing up takes `stand_s` [s]; `tell` receives status lines.

        Raises:
            ConfigError: the policy does not fit the robot.
        """
        policy.fit(robot.facts)
        self._policy, self._robot, self._operator = policy, robot, operator
        self._contract = contract = policy.contract
        self._stand_s, self._clock, self._sleep, self._tell = stand_s, clock, sleep, tell
        self._watch = Watch(contract, limits or Limits())
        self._ramp = Ramp(contract)
        self._braking = braking(contract)
        self.pace = Pace(contract.control_dt, clock, sleep)
        self.log = Log(contract)
        self.state = State.IDLE
        self.stops: tuple[str, ...] = ()
        """Reasons for all stops so far, oldest first."""
        self._reading: Reading | None = None
        self._ticks = False
        """True once the robot's clock has advanced between two readings."""
        self._path, self._path_s = [contract.default], stand_s
        self._since = self._start = 0.0
        self.walked_s = 0.0
        """Time for which the policy acted [s]."""
        self._halting_s: float | None = None
        """Time for which the command has been zero while a walking robot halts [s]; None while the robot is not halting."""
        self._asked = (np.zeros(len(contract.joint_names)),) * 3
        """Last targets and gains that were sent to the robot."""

    def run(self, seconds: float = np.inf) -> None:
        """Run until the operator quits, or for `seconds`; then brake and release the robot."""
        collects = gc.isenabled()
        gc.freeze()
        gc.disable()  # a garbage collection takes longer than a cycle
        try:
            self._robot.ask({name: term.points for name, term in self._contract.sources.items()})
            self._start = self._clock()
            quits = False
            while not quits:
                now = self.pace.wait()
                quits = self._cycle(now) or now - self._start > seconds
            self._settle()
            self._write(self._contract.default, 0.0, self._braking)
        except BaseException:
            self._settle_blindly()
            raise
        finally:
            if collects:
                gc.enable()
            try:
                self._robot.close()
            finally:
                self._operator.close()

    def _cycle(self, now: float) -> bool:
        """Run one cycle; return whether the operator quits."""
        self._read()
        orders = self._operator.poll(now - self._start)
        reason = self._watch.reason(self._reading, now, self.pace.missed_in_a_row)
        events = list(orders.events)
        if orders.lost is not None and self.state in MOVING:
            self._stop(f"operator lost: {orders.lost}", now)
        if reason is not None and self.state in MOVING:
            self._stop(reason, now)
            events = [event for event in events if event is Event.QUIT]
        for event in events:
            if event is not Event.QUIT:
                self._handle(event, reason, now)
        if self._halting_s is not None and self._halting_s >= HALT_S:
            self._enter(State.STAND, now)
        targets, stiffness, damping = self._decide(orders, now)
        if not np.isfinite(targets).all():
            self._stop("non-finite output of the policy", now)
            targets, stiffness, damping = self._decide(orders, now)
        self._write(targets, stiffness, damping)
        self._log_cycle(now)
        self.pace.done()
        return Event.QUIT in events

    def _read(self) -> None:
        """Process and log the new readings. If a reading has the same time as the previous reading, the robot repeated a
        measurement, and the earlier time of arrival is kept. A stop request in any of the readings counts.
        """
        stops = False
        for reading in self._robot.read():
            last = self._reading
            if last is not None and (reading.time != last.time or self._ticks):
                self._ticks = True
                if reading.time == last.time:
                    reading = replace(reading, received=last.received)
            self.log.add_reading(reading, self.state, *self._asked)
            self._watch.see(reading)
            stops |= reading.stop
            self._reading = reading
        if stops and self._reading is not None:
            self._reading = replace(self._reading, stop=True)

    def _handle(self, event: Event, reason: str | None, now: float) -> None:
        """Execute an event, or report why it is refused."""
        if event is Event.STOP:
            self._stop("operator: stop", now)
            return
        if event is Event.WALK and self._halting_s is not None:
            self._halting_s = None
            self._say("walk: the robot walks on", now)
            return
        if event not in TRANSITIONS[self.state]:
            self._say(f"refused: '{event.value}' is not possible in the state {self.state.value}", now)
        elif State(event.value) in MOVING and reason is not None:
            self._say(f"refused: {event.value}: {reason}", now)
        elif event is Event.WALK and now - self._since < self._path_s:
            self._say(f"refused: walk: the robot first stands up, for {self._path_s:g} s", now)
        elif event is Event.WALK and (crooked := self._crooked()) is not None:
            self._say(f"refused: walk: {crooked}", now)
        elif self.state is State.WALK and event is Event.STAND:
            if self._halting_s is None:
                self._halting_s = 0.0
                self._say("walk: the robot halts, and then stands", now)
        else:
            self._enter(State(event.value), now)

    def _crooked(self) -> str | None:
        """Return a message about the joint that is furthest from the default pose; None if all are within `STANDS_WITHIN`."""
        if self._reading is None:
            return "no reading has arrived yet"
        away = np.abs(self._reading.positions - self._contract.default)
        if away.max() <= STANDS_WITHIN:
            return None
        joint = self._contract.joint_names[int(away.argmax())]
        return f"the robot does not stand: {joint} is {away.max():.2f} rad from its default (allowed: {STANDS_WITHIN:g})"

    def _stop(self, reason: str, now: float) -> None:
        if self.state is not State.STOP:
            self.stops += (reason,)
            self._say(f"stop: {reason}", now)
            self._enter(State.STOP, now)

    def _enter(self, state: State, now: float) -> None:
        self._say(f"{self.state.value} -> {state.value}", now)
        if state is State.STAND and self._reading is not None:
            # A lying robot first folds its legs. In a walking robot, the difference of targets and joint angles gives the
            # torques that carry the weight. So the targets start from their last values, not from the joint angles.
            damped, bent = self.state is State.DAMPING, self._contract.crouch
            first = self._reading.positions if damped else self._asked[0]
            lies = damped and np.abs(first - self._contract.default).max() > THERE
            self._path_s = self._stand_s if lies else min(RETURN_S, self._stand_s)
            self._path = [first, *([bent] if lies and bent is not None else []), self._contract.default]
        self.state, self._since, self._halting_s = state, now, None
        if state is State.WALK:
            self._policy.restart()
            self._ramp.restart()

    def _decide(self, orders: Orders, now: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return targets, P gains and D gains (D,) for the present state."""
        contract, reading = self._contract, self._reading
        nothing = np.zeros(len(contract.joint_names))
        if self.state in MOVING and reading is not None:
            if self.state is State.WALK:
                halts = self._halting_s is not None
                command = self._ramp.advance(Orders(np.zeros(3)) if halts else orders)
                if halts and not command.any():
                    self._halting_s = (self._halting_s or 0.0) + contract.control_dt
                targets = self._policy.act(reading, command, self._ramp.base)
                self.walked_s += contract.control_dt
            else:
                targets = along(self._path, (now - self._since) / self._path_s)
            clamped = clamp_targets(targets, reading.positions, reading.velocities, contract)
            return clamped, contract.stiffness, contract.damping
        positions = contract.default
        if reading is not None:  # a NaN target would give a NaN torque, even with a P gain of 0
            positions = np.where(np.abs(reading.positions) < FAR, reading.positions, positions)
        return positions, nothing, nothing if self.state is State.IDLE else self._braking

    def _write(self, targets: np.ndarray, stiffness: np.ndarray | float, damping: np.ndarray) -> None:
        asked = (targets, np.broadcast_to(stiffness, targets.shape), damping)
        self._robot.write(*asked)
        self._asked = asked

    def _log_cycle(self, now: float) -> None:
        policy, reading = self._policy, self._reading
        walks = self.state is State.WALK
        self.log.add_cycle(
            self.state,
            times=now - self._start,
            took=self._clock() - now,
            age=np.nan if reading is None else now - reading.received,
            command=self._ramp.command if walks else np.zeros(3),
            observation=policy.observation if walks else np.full_like(policy.observation, np.nan),
            actions=policy.actions if walks else np.full_like(policy.actions, np.nan),
            targets=self._asked[0],
        )

    def _settle(self) -> None:
        """Brake the joints for `SETTLE_S`, so that a standing robot sinks to the ground. An idle robot is not braked."""
        if self.state in (State.IDLE, State.STOP) and self._reading is None:
            return
        if self.state in MOVING:
            self._enter(State.DAMPING, self._clock())
        end = self._clock() + (SETTLE_S if self.state is not State.IDLE else 0.0)
        while (now := self.pace.wait()) < end:
            self._read()
            self._write(*self._decide(Orders(np.zeros(3)), now))
            self._log_cycle(now)
            self.pace.done()

    def _settle_blindly(self) -> None:
        """Send several braking commands after a failure, because one command may get lost. Ignore further failures."""
        contract = self._contract
        for _ in range(int(np.ceil(SETTLE_S / contract.control_dt))):
            with suppress(Exception):
                self._write(contract.default, 0.0, self._braking)
            self._sleep(contract.control_dt)

    def _say(self, text: str, now: float) -> None:
        self.log.note(now - self._start, text)
        self._tell(f"{now - self._start:7.2f} s  {text}")
