"""The calls of the tapper's driver end within their time limits, and not before a release is
impossible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import pytest
from hardware_faults import expect_fault
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.tapper import LONGEST_CHARGE, FireOutcome, TapperDriver
from tapping_cell.hardware.tapper_protocol import (
    LONGEST_WINDOW,
    Command,
    Mode,
    Reply,
    Result,
    State,
)
from tapping_cell.hardware.transport import Transport
from tapping_cell.simulation.fault_layer import FaultLayer
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.simulation.virtual_line import VirtualClock, VirtualTransport

REQUEST_S = 0.02
"""Duration of one request and its reply."""


class DeafLine(VirtualTransport):
    """A line that loses the stop command. A stop occurs just after FIRE was sent."""

    driver: TapperDriver

    def write(self, data: bytes, timeout: float = 1.0) -> None:
        super().write(data, timeout)
        if Command.FIRE.value.encode() in data:
            self.driver.stop()

    def stop(self, data: bytes) -> bool:
        return super().stop(b"")


def test_unknown_is_reported_only_when_a_release_is_impossible_even_during_a_stop() -> None:
    clock = VirtualClock()
    device = TapperEmulator(now=clock.now)
    line = DeafLine(FaultLayer(device), clock, "tapper")
    driver = line.driver = TapperDriver(line, draw_number=lambda below: 7)
    driver.connect()
    driver.charge(1, 0.001)
    promised: list[float] = []
    result = driver.fire(1, 0.1, lambda release_by: promised.append(release_by) is None)
    assert driver.stopped and result.outcome is FireOutcome.UNKNOWN
    assert clock.now >= promised[0]


class Restarted(TapperDriver):
    """A board that restarts after FIRE and reports the number of the shot, of an earlier life."""

    def __init__(self, boot: int) -> None:
        super().__init__(cast(Transport, Time()))
        self._boot, self._later = 1, boot

    def _request(self, command: Command, *arguments: int | Mode) -> Reply:
        return Reply(
            1, 1, Result.OK, State.CHARGED, 5, 0.01, True, False, 0, None, 1, 0, Mode.RUN, False
        )

    def _send_fire(self, shot: int, deadline: int, again: Callable[[], bool]) -> Reply:
        return replace(self._request(Command.FIRE), last_fired=shot, boot=self._later)


@pytest.mark.parametrize("boot", [1, 2])
def test_a_board_that_restarted_during_a_shot_does_not_tell_its_outcome(boot: int) -> None:
    result = Restarted(boot).fire(5, 0.04, lambda release_by: True)
    assert result.outcome is (FireOutcome.FIRED if boot == 1 else FireOutcome.UNKNOWN)


class LossyLine(VirtualTransport):
    """A line that loses every FIRE, and records when it was sent."""

    def __init__(self, line: FaultLayer, clock: VirtualClock) -> None:
        super().__init__(line, clock, "tapper")
        self.sent: list[float] = []

    def write(self, data: bytes, timeout: float = 1.0) -> None:
        is_fire = Command.FIRE.value.encode() in data
        if is_fire:
            self.sent.append(self.now())
        super().write(b"" if is_fire else data, timeout)


@given(st.floats(0.001, LONGEST_WINDOW), st.integers(0, 3))
def test_fire_is_sent_again_only_within_its_window_and_after_another_check(
    window: float, allowed: int
) -> None:
    clock = VirtualClock()
    line = LossyLine(FaultLayer(TapperEmulator(now=clock.now)), clock)
    driver = TapperDriver(line, draw_number=lambda below: 7)
    driver.connect()
    driver.charge(1, 0.001)
    checks: list[float] = []

    def check(release_by: float) -> bool:
        checks.append(clock.now)
        return len(checks) <= allowed

    result = driver.fire(1, window, check)
    assert result.outcome is FireOutcome.NOT_FIRED
    assert len(line.sent) <= allowed
    assert all(sent < checks[0] + window for sent in line.sent)
    resent = 1 + int(window / driver.settings.fire_reply_timeout)
    assert len(line.sent) >= min(allowed, resent, driver.settings.attempts) - 1


class Misunderstanding(TapperDriver):
    """A board that is charged with other arguments than those requested."""

    def __init__(self, shot: int, energy: float, channel: int) -> None:
        self.commands = list[Command]()
        super().__init__(cast(Transport, Time()))
        self._channels = 8
        self._charged = shot, energy, channel

    def _request(self, command: Command, *arguments: int | Mode) -> Reply:
        self.commands.append(command)
        shot, energy, channel = self._charged
        state = State.CHARGED if command is Command.CHARGE else State.SAFE
        return Reply(
            1, 1, Result.OK, state, shot, energy, True, False, 0, None, 1, 0, Mode.RUN, False,
            channels=8, at_mounts=255, channel=channel,
        )  # fmt: skip


@pytest.mark.parametrize("charged", [(5, 0.02, 2), (5, 0.01, 3), (5, 0.01, 0), (6, 0.01, 2)])
def test_a_board_that_is_charged_otherwise_than_requested_is_discharged(
    charged: tuple[int, float, int],
) -> None:
    driver = Misunderstanding(*charged)
    with pytest.raises(HardwareFault) as met:
        driver.charge(5, 0.01, channel=2)
    assert met.value.reason is FaultReason.REJECTED
    assert driver.commands[-1] is Command.DISCHARGE


class Time:
    """A transport that is only a clock."""

    name, is_open = "tapper", True

    def __init__(self) -> None:
        self.passed = 0.0

    def now(self) -> float:
        return self.passed

    def sleep(self, duration: float) -> None:
        self.passed += duration


class Flickering(TapperDriver):
    """A board that confirms every homing, but refuses every charge because of a flickering
    switch."""

    def __init__(self) -> None:
        self.time, self.commands = Time(), list[Command]()
        super().__init__(cast(Transport, self.time))

    def _request(self, command: Command, *arguments: int | Mode) -> Reply:
        self.time.passed += REQUEST_S
        self.commands.append(command)
        result = Result.NOT_HOMED if command is Command.CHARGE else Result.OK
        state = State.SAFE if command is Command.HOME else State.UNHOMED
        return Reply(
            1, 1, result, state, 0, 0.0, True, False, 0, None, 1, 0, Mode.RUN, False,
            channels=8, at_mounts=255,
        )  # fmt: skip


def test_a_board_that_is_homed_again_and_again_is_refused_after_the_time_limit() -> None:
    driver = Flickering()
    with expect_fault(FaultReason.STRIKER_AWAY):
        driver.charge(1, 0.01)
    assert driver.time.passed < driver.settings.home_timeout + 4 * REQUEST_S
    assert driver.commands.count(Command.HOME) > 1


def test_a_tap_can_be_given_up_before_every_homing() -> None:
    driver = Flickering()
    answers = iter([True, True, False])
    reply = driver.charge(1, 0.01, lambda: next(answers))
    assert reply.state is not State.CHARGED
    assert driver.commands.count(Command.HOME) == 2
    assert driver.commands[-1] is Command.DISCHARGE


def test_a_charged_striker_waits_for_an_arm_that_is_late() -> None:
    """The state machine discharges it after 3 s; charging may take up to ``charge_timeout``."""
    clock = VirtualClock()
    clock.limit = 60.0
    transport = VirtualTransport(FaultLayer(TapperEmulator(now=clock.now)), clock, "tapper")
    driver = TapperDriver(transport, draw_number=lambda below: below // 2)
    driver.connect()
    began = clock.now
    assert driver.charge(1, 0.001).state is State.CHARGED
    while clock.now < began + driver.settings.charge_timeout + 2.9:
        assert driver.status().state is State.CHARGED
        transport.sleep(0.1)
    while clock.now < began + LONGEST_CHARGE + 0.5:
        transport.sleep(0.1)
        last = driver.status().state
    assert last is State.SAFE
