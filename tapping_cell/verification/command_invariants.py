"""Invariants of the tap commands that arm and tapper execute."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from tapping_cell.logic.clock import to_nanoseconds
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import ArmState, ErrorCode, TapCommand, TapperState
from tapping_cell.verification.host import HostClock
from tapping_cell.verification.scheduler import Scheduler

FRESH_S = 0.301
"""Maximum age of the last ``arm_state`` that the tapper has received when it charges, s."""
ABOVE_M, ABOVE_RAD = 0.005 + 1e-6, 0.05 + 1e-6
"""Maximum distance (horizontal) and angle from the tip to its strike pose when the tapper
charges."""
INVALID_FROM = "program"
"""Node that publishes invalid commands."""
EXPIRED_S = 0.5
"""Maximum time from a tap's expiry until the tapper ends the tap, if it has not begun to charge,
s."""


@dataclass(slots=True)
class CommandChecker:
    """Checks that invalid commands are not executed, and which commands the tapper begins and ends.
    Times are in s from the start of the run.

    ``commands_of``: return the commands with this id that the tapper's process has received.
    """

    scheduler: Scheduler
    tapper_clock: HostClock
    violate: Callable[[str, str], None]
    commands_of: Callable[[int], Iterable[TapCommand]]
    ended_taps: dict[int, float]
    """For each tap, the time at which the tapper's process received a message that ends it."""
    invalid: dict[int, str] = field(default_factory=dict)
    """Wrong field of the commands with these ids."""
    _refused_by_arm: set[int] = field(default_factory=set)
    _taken_while_inactive: set[int] = field(default_factory=set)
    """Ids of the commands that the tapper's process has received only while its node was
    inactive."""
    _withdrawn: set[int] = field(default_factory=set)
    """Taps that somebody has withdrawn, or that a deactivation has ended."""
    _received: set[int] = field(default_factory=set)
    """Taps whose command the tapper's process has handled since its start."""
    _withdrawn_first: set[int] = field(default_factory=set)
    """Taps whose withdrawal the tapper's process has handled since its start, but not their
    command."""
    _arm_seen: ArmState | None = None
    """Last state of the arm that the tapper's process has handled, and its time."""
    _arm_seen_at: float = 0.0
    _report: TapperState = field(default_factory=TapperState)
    """Last state that the tapper has published."""
    _expired_at: float | None = None
    """Time of the first message that reports the present tap as waiting after its expiry."""

    def on_invalid(self, tap_id: int, wrong: str, arm_refuses: bool) -> None:
        """Process that a program is about to publish a command with a wrong field."""
        self.invalid[tap_id] = wrong
        if arm_refuses:
            self._refused_by_arm.add(tap_id)

    def on_published(self, node: str, tap_id: int) -> None:
        """Process that a node has published a command. If it has the id of an invalid command of
        another node, this id does not identify the invalid command."""
        if node != INVALID_FROM:
            self.invalid.pop(tap_id, "")
            self._refused_by_arm.discard(tap_id)

    def on_tap_received(self, tap_id: int, active: bool) -> None:
        """Process a TAP that the tapper's process has handled. ``active``: whether its node was
        active."""
        if active:
            self._taken_while_inactive.discard(tap_id)
        else:
            self._taken_while_inactive.add(tap_id)
        begun = self._report.tap_id == tap_id and self._report.outcome == TapperState.NONE
        if begun and tap_id in self._withdrawn_first:
            self.violate(
                "took a withdrawn tap",
                f"the tapper has accepted tap {tap_id}, although it had already been withdrawn",
            )
        self._received.add(tap_id)

    def on_withdrawal_received(self, tap_id: int) -> None:
        """Process a WITHDRAW that the tapper's process has handled."""
        self._withdrawn.add(tap_id)
        if tap_id not in self._received:
            self._withdrawn_first.add(tap_id)

    def on_arm_state_received(self, message: ArmState) -> None:
        """Process a state of the arm that the tapper's process has handled."""
        self._arm_seen, self._arm_seen_at = message, self.scheduler.now

    def on_deactivated(self) -> None:
        """Process the deactivation of the tapper's node, which ends the tap under way."""
        if self._report.tap_id and self._report.outcome == TapperState.NONE:
            self.ended_taps.setdefault(self._report.tap_id, self.scheduler.now)
            self._withdrawn.add(self._report.tap_id)

    def on_process_lost(self) -> None:
        """Process the end of the tapper's process."""
        self._arm_seen, self._report, self._expired_at = None, TapperState(), None
        self._received.clear()
        self._withdrawn_first.clear()

    def on_arm_state(self, message: ArmState) -> None:
        """Process a state that the arm has published."""
        if message.tap_id in self._refused_by_arm and message.state in (
            ArmState.MOVING,
            ArmState.IN_POSITION,
        ):
            self._violate_invalid("the arm executes", message.tap_id)

    def on_tapper_state(self, message: TapperState) -> None:
        """Process a state that the tapper has published."""
        before, self._report = self._report, message
        if message.outcome == TapperState.NONE and message.tap_id in self.invalid:
            self._violate_invalid("the tapper has accepted", message.tap_id)
        waits = message.tap_id and message.outcome == TapperState.NONE
        if not (waits and message.state == TapperState.SAFE and self._is_expired(message.tap_id)):
            self._expired_at = None
        elif self._expired_at is None:
            self._expired_at = self.scheduler.now
        elif self.scheduler.now > self._expired_at + EXPIRED_S:
            self.violate(
                "expired tap not ended",
                f"tap {message.tap_id} still waits {self.scheduler.now - self._expired_at:.2f} s"
                " after its command had expired",
            )
            self._expired_at = self.scheduler.now
        if (
            message.tap_id == before.tap_id
            and before.outcome == TapperState.NONE
            and message.outcome == TapperState.NOT_FIRED
            and message.state == TapperState.SAFE
            and message.error_code == ErrorCode.NONE
        ):
            # The cause is recorded after the handler that publishes this state.
            tap_id = message.tap_id
            self.scheduler.after(0.0, lambda: self._check_ended(tap_id))

    def on_release(self, shot: int) -> None:
        """Check the release of a shot."""
        if shot in self.invalid:
            self._violate_invalid("the tapper has fired", shot)
        if shot in self._taken_while_inactive:
            self.violate(
                "command while inactive",
                f"shot {shot} was released, but its command arrived while the tapper's node was"
                " inactive",
            )

    def on_charge_allowed(self) -> None:
        """Check that the tapper begins or continues to charge only if the arm's last state is
        recent and says that the tip is above the strike pose of the tap, or there."""
        arm, tap_id, now = self._arm_seen, self._report.tap_id, self.scheduler.now
        if arm is None:
            return
        tip = from_message(arm.tip_pose)
        above = any(
            tip.distance_to(strike) <= ABOVE_M and abs(tip.rotation_to(strike)) <= ABOVE_RAD
            for strike in (from_message(one.strike_pose) for one in self.commands_of(tap_id))
        )
        of_tap = arm.tap_id == tap_id and arm.state in (ArmState.MOVING, ArmState.IN_POSITION)
        age = now - self._arm_seen_at
        if not (of_tap and above and age <= FRESH_S):
            self.violate(
                "charged away from its strike pose",
                f"the tapper charges for tap {tap_id}, but the last state of the arm that it has"
                f" received is {age:.2f} s old and reports state {arm.state}, tap {arm.tap_id} and"
                f" a tip {'above' if above else 'beside'} the strike pose",
            )

    def _violate_invalid(self, who: str, tap_id: int) -> None:
        self.violate(
            "executed an invalid command",
            f"{who} the command of tap {tap_id}, which is invalid: {self.invalid[tap_id]}",
        )

    def _is_expired(self, tap_id: int) -> bool:
        now = self.tapper_clock.now().ros
        return all(to_nanoseconds(one.expiry) < now for one in self.commands_of(tap_id))

    def _check_ended(self, tap_id: int) -> None:
        if tap_id not in self._withdrawn:
            self.violate(
                "ended without a cause",
                f"tap {tap_id} was ended without a reason, and nobody has withdrawn it",
            )
