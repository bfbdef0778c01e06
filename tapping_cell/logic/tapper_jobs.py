"""Blocking jobs on the tapper's driver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.tapper import FireOutcome, FireResult
from tapping_cell.hardware.tapper_device import MountedTappers, TapperDevice
from tapping_cell.hardware.tapper_protocol import Reply, State
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import JobContext
from tapping_cell.logic.tap_commands import CodedError

WINDOW_S = 0.04
"""Time from the last check before FIRE to the board's deadline, s. This constant is twice the 20 ms
that FIRE and its reply take."""


@dataclass(frozen=True, slots=True)
class Status:
    """Reply of the board, and the driver's count of fired shots."""

    reply: Reply
    fired: int


@dataclass(frozen=True, slots=True)
class ChargeEnd:
    """Result of charging: the tapper is charged, or the tapper was discharged because of
    ``refusal``."""

    status: Status
    charged: bool
    refusal: CodedError | None


@dataclass(frozen=True, slots=True)
class FireEnd:
    """Result of a shot, and the board's status afterwards."""

    shot: int
    outcome: FireOutcome
    sentence: str
    refusal: CodedError | None
    """Reason given by the last check, if this check prevented the shot."""
    refused: HardwareFault | None
    """Fault reported by the board, if this fault prevented the shot."""
    status: Status | None
    fault: HardwareFault | None
    """Fault that occurred after the outcome was known."""


def connect(context: JobContext, patience: float) -> Status:
    """Open the port again and start a new session; the new session discharges the tapper."""
    driver: TapperDevice = context.driver
    return _make_status(driver, driver.connect(timeout=patience))


def read(context: JobContext) -> Status:
    """Request the state; this request also keeps a charged tapper charged."""
    driver: TapperDevice = context.driver
    return _make_status(driver, driver.status())


def clear(context: JobContext, is_stopped: Callable[[Now], bool]) -> Status:
    """Clear a stop or a fault; after a stop, the board requires a person at the cell.

    ``is_stopped``: query whether a stop is latched. Its answer waits until the host has carried out
    all effects of a stop. Raises HardwareFault STOPPED if a new stop occurred while this job was
    queued; the stop then remains latched in the driver.
    """
    driver: TapperDevice = context.driver
    if context.ask(is_stopped):
        raise HardwareFault(
            FaultReason.STOPPED,
            "a new stop occurred before the last one was cleared; make the cell safe, then clear"
            " the stop again",
        )
    return _make_status(driver, driver.clear())


def discharge(context: JobContext) -> Status:
    """Discharge the tapper without firing."""
    driver: TapperDevice = context.driver
    return _make_status(driver, driver.discharge())


def prove(context: JobContext) -> Status:
    """Have the board verify that its strikers are at their mounts."""
    driver: MountedTappers = context.driver
    return _make_status(driver, driver.home(lambda: not context.abandoned()))


def charge(
    context: JobContext,
    shot: int,
    energy: float,
    channel: int,
    check: Callable[[Now], CodedError | None],
    post_replies: bool,
) -> ChargeEnd:
    """Charge ``energy`` in J for a shot of a channel; discharge if ``check`` returns a reason.

    ``post_replies``: whether the board's last reply is sent to the state machine before each check.
    """
    driver: TapperDevice = context.driver
    refusal: CodedError | None = None

    def go_on() -> bool:
        nonlocal refusal
        if post_replies and driver.last_reply is not None:
            context.post(driver.last_reply)
        refusal = refusal or context.ask(check)
        return refusal is None and not context.abandoned()

    if not go_on():
        return ChargeEnd(_make_status(driver, driver.status()), False, refusal)
    reply = driver.charge(shot, energy, go_on, channel=channel)
    charged = reply.state is State.CHARGED
    return ChargeEnd(_make_status(driver, reply), charged, refusal)


def fire(
    context: JobContext,
    shot: int,
    check: Callable[[float, Now], CodedError | None],
    post_replies: bool,
) -> FireEnd:
    """Fire a charged shot if ``check`` allows the shot; otherwise discharge the tapper.

    ``check`` receives the latest possible end of the release pulse, in s of the steady clock.
    ``post_replies``: whether the board's last reply is sent to the state machine before each check.
    """
    driver: TapperDevice = context.driver
    refusal: CodedError | None = None

    def still_allowed(release_by: float) -> bool:
        nonlocal refusal
        if post_replies and driver.last_reply is not None:
            context.post(driver.last_reply)
        refusal = context.ask(lambda now: check(release_by, now))
        return refusal is None and not context.abandoned()

    result: FireResult = driver.fire(shot, WINDOW_S, still_allowed)
    outcome, sentence = result.outcome, result.sentence
    status, fault = None, None
    try:
        # This reply contains the number of the last shot fired and the measured speed of this shot.
        reply = driver.status()
        outcome, sentence = _confirmed(result, reply)
        if reply.state is State.CHARGED:
            reply = driver.discharge()
        status = _make_status(driver, reply)
    except HardwareFault as met:
        fault = met
    return FireEnd(shot, outcome, sentence, refusal, result.fault, status, fault)


def _confirmed(result: FireResult, reply: Reply) -> tuple[FireOutcome, str]:
    """Compare the outcome of a shot with a further reply of the board, and return the outcome and
    its reason. If the replies contradict each other, one of them did not come from the board, and
    the outcome is UNKNOWN."""
    fired = reply.last_fired == result.shot
    if result.outcome is FireOutcome.UNKNOWN or fired == (result.outcome is FireOutcome.FIRED):
        return result.outcome, result.sentence
    return (
        FireOutcome.UNKNOWN,
        f"the board's replies contradict each other: shot {result.shot} was answered with"
        f" {result.outcome.value}, but then the board reported {reply.last_fired} as the number of"
        " the last shot fired; check where the object is and what else is connected to the line",
    )


def wait_for_return(context: JobContext) -> Status:
    """Wait until the released striker is back at its mount, or until the board stops waiting for
    it."""
    driver: MountedTappers = context.driver
    return _make_status(driver, driver.wait_for_return(lambda: not context.abandoned()))


def _make_status(driver: TapperDevice, reply: Reply) -> Status:
    return Status(reply, driver.counters.fired)
