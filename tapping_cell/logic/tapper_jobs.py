"""The tapper's blocking sequences: plain code on its driver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tapping_cell.hardware.faults import HardwareFault
from tapping_cell.hardware.tapper import FireOutcome, FireResult, TapperDriver
from tapping_cell.hardware.tapper_device import TapperDevice
from tapping_cell.hardware.tapper_protocol import Reply, State
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import JobContext
from tapping_cell.logic.tap_commands import Trouble

WINDOW_S = 0.04
"""From the last check before FIRE to the board's deadline: a frame and its reply take 20 ms."""


@dataclass(frozen=True, slots=True)
class Status:
    """What the board tells, and what the driver counted."""

    reply: Reply
    fired: int


@dataclass(frozen=True, slots=True)
class ChargeEnd:
    """How charging ended: charged, or discharged for the reason that a check gave."""

    status: Status
    charged: bool
    refusal: Trouble | None


@dataclass(frozen=True, slots=True)
class FireEnd:
    """How a shot ended, and what the board tells afterwards."""

    shot: int
    outcome: FireOutcome
    sentence: str
    refusal: Trouble | None
    """What the last check had against it, if that is why it was not fired."""
    refused: HardwareFault | None
    """What the board had against it, if that is why."""
    status: Status | None
    fault: HardwareFault | None
    """What was met after the outcome was known."""


def connect(context: JobContext, patience: float) -> Status:
    """Open the line again with a new session, which discharges the tapper."""
    driver: TapperDevice = context.driver
    return _told(driver, driver.connect(timeout=patience))


def read(context: JobContext) -> Status:
    """Ask for the state; also what keeps a charged tapper alive."""
    driver: TapperDevice = context.driver
    return _told(driver, driver.status())


def clear(context: JobContext) -> Status:
    """End a stop or a fault; after a stop the board demands a person at the cell."""
    driver: TapperDevice = context.driver
    return _told(driver, driver.clear())


def discharge(context: JobContext) -> Status:
    """Relax the spring without a release."""
    driver: TapperDevice = context.driver
    return _told(driver, driver.discharge())


def prove(context: JobContext) -> Status:
    """Have the board prove that its strikers are at their mounts."""
    driver: TapperDriver = context.driver
    return _told(driver, driver.home(lambda: not context.abandoned()))


def charge(
    context: JobContext,
    shot: int,
    energy: float,
    channel: int,
    doubt: Callable[[Now], Trouble | None],
    tell: bool,
) -> ChargeEnd:
    """Charge ``energy`` in J for a shot of a channel, and discharge at once when ``doubt`` is met.

    ``tell``: post the board's last reply before each check.
    """
    driver: TapperDriver = context.driver
    refusal: Trouble | None = None

    def go_on() -> bool:
        nonlocal refusal
        if tell and driver.last_reply is not None:
            context.post(driver.last_reply)
        refusal = refusal or context.ask(doubt)
        return refusal is None and not context.abandoned()

    if not go_on():
        return ChargeEnd(_told(driver, driver.status()), False, refusal)
    reply = driver.charge(shot, energy, go_on, channel=channel)
    charged = reply.state is State.CHARGED
    return ChargeEnd(_told(driver, reply), charged, refusal)


def fire(
    context: JobContext,
    shot: int,
    doubt: Callable[[float, Now], Trouble | None],
    tell: bool,
) -> FireEnd:
    """Fire a charged shot within a window that ``doubt`` allows, and discharge what was not fired.

    ``doubt`` gets the latest time of the steady clock at which the release can still be on, in s.
    ``tell``: post the board's last reply before each check.
    """
    driver: TapperDevice = context.driver
    refusal: Trouble | None = None

    def still_allowed(release_by: float) -> bool:
        nonlocal refusal
        if tell and driver.last_reply is not None:
            context.post(driver.last_reply)
        refusal = context.ask(lambda now: doubt(release_by, now))
        return refusal is None and not context.abandoned()

    result: FireResult = driver.fire(shot, WINDOW_S, still_allowed)
    status, fault = None, None
    try:
        # The measured speed belongs to the same report as the outcome.
        reply = driver.status()
        if reply.state is State.CHARGED:
            reply = driver.discharge()
        status = _told(driver, reply)
    except HardwareFault as met:
        fault = met
    return FireEnd(shot, result.outcome, result.sentence, refusal, result.fault, status, fault)


def wait_for_return(context: JobContext) -> Status:
    """Wait until the striker that was released is back at its mount, or is given up."""
    driver: TapperDriver = context.driver
    return _told(driver, driver.wait_for_return(lambda: not context.abandoned()))


def _told(driver: TapperDevice, reply: Reply) -> Status:
    return Status(reply, driver.counters.fired)
