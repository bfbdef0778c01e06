"""The cycle of one tap of the tapper: wait for the arm, charge, ask the arm to stand still, fire.

Each method takes the record of the present state, and yields effects, jobs and the record of the
next state. The caller carries them out in this order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from tapping_cell.logic import permit, tapper_jobs
from tapping_cell.logic.clock import Now
from tapping_cell.logic.device import Abandon, Run
from tapping_cell.logic.effects import Call, Message, Token
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.logic.tapper_jobs import ChargeEnd
from tapping_cell.logic.tapper_peers import TapperPeers
from tapping_cell.logic.tapper_states import (
    Charged,
    Charging,
    Discharging,
    Event,
    Firing,
    Over,
    Serving,
    Steps,
    Waiting,
)
from tapping_cell.logic.transitions import Go
from tapping_cell.messages import ErrorCode, HoldStill, TapperState

HOLD_TIMEOUT_S = 0.2
"""Timeout of one call of ``hold_still``, after which the tapper repeats the call."""
HOLD_ATTEMPTS = 5
SHOWN_AFTER_S = 0.3
"""Time after which ``tapper_state`` contains the reason why an accepted tap waits."""
LONGEST_WAIT_S = 4.0
"""Time after which a tap is given up that waits for anything but the arm's way to its strike
pose."""
LONGEST_CHARGED_S = 3.0
"""Maximum time from the end of charging until the arm is in position. After this time the striker
is discharged."""


class TapperCycle:
    """See the module's docstring."""

    def __init__(
        self,
        peers: TapperPeers,
        check_charging: Callable[[Now], CodedError | None],
        check_firing: Callable[[float, Now], CodedError | None],
        post_replies: bool,
    ) -> None:
        """``check_charging``, ``check_firing``: return why charging or firing is forbidden, or
        None; ``post_replies``: whether the jobs report each reply of the board."""
        self._peers = peers
        self._check_charging = check_charging
        self._check_firing = check_firing
        self._post_replies = post_replies
        self.is_fixed = False
        """Whether the tappers are at fixed mounts, which need no arm."""

    def proceed(self, at: Serving | None, now: Now) -> Steps:
        """Charge when the arm is ready, and call ``hold_still`` once it is in position."""
        if isinstance(at, Waiting):
            yield from self._charge_when_ready(at, now)
        elif isinstance(at, Charged):
            yield from self._ask_when_in_position(at, now)

    def check_expiry(self, at: Serving | None, now: Now) -> Steps:
        """Give the tap up if its expiry passes before charging."""
        if not isinstance(at, Waiting) or now.ros <= at.tap.expiry:
            return
        reason = self._peers.check_firing(at.tap.tap_id, at.tap.planned, at.tap.strike, now)
        why = f": {reason[1]}" if reason is not None else ""
        sentence = f"the tap's expiry passed before it could be fired{why}"
        yield from self.give_up(at, (ErrorCode.TAPPER_COMMAND_EXPIRED, sentence))

    def shown_obstacle(self, at: Serving | None, now: Now) -> CodedError | None:
        """Return why the accepted tap waits, if it has waited for a while."""
        if isinstance(at, Waiting) and now.steady > at.obstacle_since + SHOWN_AFTER_S:
            return at.obstacle
        return None

    def give_up(self, at: Serving, why: CodedError) -> Steps:
        """End the tap under way. The striker is not released, unless its release has already
        begun."""
        first = at.given_up or why
        if isinstance(at, Waiting):
            yield Over(Event.GIVEN_UP, TapperState.NOT_FIRED, why)
        elif isinstance(at, Charging):
            yield Go(Event.GIVEN_UP, Discharging(tap=at.tap, given_up=first))
            yield Abandon()
        elif isinstance(at, Charged):
            yield from self.discharge(at, why)
        else:
            yield Go(None, replace(at, given_up=first))
            if isinstance(at, Firing):
                yield Abandon()

    def discharge(self, at: Serving, why: CodedError) -> Steps:
        """End the tap, of which no job may have fired it, and discharge the striker."""
        yield Go(Event.GIVEN_UP, Discharging(tap=at.tap, given_up=why))
        yield Run("discharge", tapper_jobs.discharge)

    def charge_ended(self, at: Serving, end: ChargeEnd, now: Now) -> Steps:
        """Handle the end of the job that charges."""
        if end.charged and isinstance(at, Discharging):
            # The tap was given up at the moment when charging ended.
            yield Run("discharge", tapper_jobs.discharge)
        elif not end.charged:
            yield not_fired(at.given_up or end.refusal)
        else:
            charged = Charged(tap=at.tap, given_up=at.given_up, charged_at=now.steady)
            yield Go(Event.CHARGED, charged)
            yield from self._ask_when_in_position(charged, now)

    def answered(
        self, at: Serving | None, token: Token, response: Message | None, now: Now
    ) -> Steps:
        """Handle the answer to ``hold_still``; None after its timeout."""
        if not isinstance(at, Charged) or token != _token(at):
            return
        flight = at.tap.flight
        # Count the hold time from the moment at which hold_still was requested. The arm counts it
        # from the later moment at which it handles the request, so the arm stands still for longer.
        until = at.asked_at + permit.hold(flight)
        if response is not None:
            until -= permit.shortfall(flight, response.duration)
        late = response is None or now.steady > until - permit.RELEASE_S - flight
        if response is not None and not response.granted:
            yield from self.discharge(at, (response.error_code, response.error_msg))
        elif not late:
            yield from self._fire(at, Event.HELD, until)
        elif at.attempts < HOLD_ATTEMPTS:
            yield from self._ask_arm(at, now)
        else:
            sentence = (
                "the arm did not answer hold_still in time, or granted too short a time, in"
                f" {HOLD_ATTEMPTS} attempts; check scara_arm and the network"
            )
            yield from self.discharge(at, (ErrorCode.ARM_SILENT, sentence))

    def _charge_when_ready(self, at: Waiting, now: Now) -> Steps:
        if (differ := self._peers.clock_error(now)) is not None:
            yield from self.give_up(at, differ)  # waiting would not remove the difference
            return
        if self._check_charging(now) is not None:
            yield from self._note_obstacle(at, now)
            return
        tap = at.tap
        yield Go(Event.ARM_READY, Charging(tap=tap))
        job = partial(
            tapper_jobs.charge,
            shot=tap.tap_id,
            energy=tap.energy,
            channel=tap.channel,
            check=self._check_charging,
            post_replies=self._post_replies,
        )
        yield Run("charge", job)

    def _note_obstacle(self, at: Waiting, now: Now) -> Steps:
        """Note why the tap waits, and give it up if the reason lasts."""
        obstacle = self._peers.obstacle(at.tap.tap_id, at.tap.planned, at.tap.strike, now)
        since = math.inf if obstacle is None else min(at.obstacle_since, now.steady)
        if obstacle is not None and now.steady > since + LONGEST_WAIT_S:
            yield from self.give_up(at, obstacle)
        else:
            yield Go(None, replace(at, obstacle=obstacle, obstacle_since=since))

    def _ask_when_in_position(self, at: Charged, now: Now) -> Steps:
        """Call ``hold_still`` once the arm is in position, or discharge if the tap must end."""
        if at.attempts > 0:
            return
        tap = at.tap
        if self.is_fixed:
            yield from self._fire(at, Event.FIXED, math.inf)
            return
        if self._peers.check_firing(tap.tap_id, tap.planned, tap.strike, now) is None:
            yield from self._ask_arm(at, now)
            return
        why = self._check_charging(now)
        if why is None and now.steady > at.charged_at + LONGEST_CHARGED_S:
            why = (
                ErrorCode.TAPPER_ARM_NOT_IN_POSITION,
                f"the arm was not in position {LONGEST_CHARGED_S:.0f} s after the tapper was"
                " charged",
            )
        if why is not None:
            yield from self.discharge(at, why)

    def _ask_arm(self, at: Charged, now: Now) -> Steps:
        asked = replace(at, attempts=at.attempts + 1, asked_at=now.steady)
        yield Go(None, asked)
        duration = permit.hold(at.tap.flight)
        request = HoldStill.Request(tap_id=at.tap.tap_id, duration=duration)
        yield Call("hold_still", request, _token(asked), HOLD_TIMEOUT_S)

    def _fire(self, at: Charged, event: Event, still_until: float) -> Steps:
        yield Go(event, Firing(tap=at.tap, given_up=at.given_up, still_until=still_until))
        job = partial(
            tapper_jobs.fire,
            shot=at.tap.tap_id,
            check=self._check_firing,
            post_replies=self._post_replies,
        )
        yield Run("fire", job)


def not_fired(why: CodedError | None) -> Over:
    """Return the end of a tap that was not fired; the tapper is at rest."""
    # If the board has already used the shot's number, the shot may have been fired before this node
    # restarted.
    is_spent = why is not None and why[0] == ErrorCode.TAPPER_SPENT
    outcome = TapperState.UNKNOWN if is_spent else TapperState.NOT_FIRED
    code, sentence = why or (ErrorCode.NONE, "")
    return Over(Event.ENDED, outcome, (code, sentence if code else ""))


def _token(at: Charged) -> Token:
    return "hold", at.tap.tap_id, at.attempts
