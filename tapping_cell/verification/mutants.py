"""Mutation tests: defects that are inserted into the product's code. The invariants must detect
each defect.

If a mutant is not detected, either the guard that the mutant disables has no effect, or no
invariant checks this effect. A mutant is a small replacement in the source of one module, applied
while the module is imported. The files on disk are not changed.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType


@dataclass(frozen=True, slots=True)
class Mutant:
    """A replacement of ``old`` by ``new``; ``old`` occurs exactly once in the module's source."""

    name: str
    module: str
    old: str
    new: str
    finding: str = ""
    """Number of the review finding in docs/safety.md whose correction this mutant removes, at least
    in part; empty if there is none."""
    also: Mutant | None = None
    """Another mutant that must be applied together with this one to remove the correction."""
    kinds: tuple[str, ...] = ()
    """Kinds of faults against which the guard protects. A hunt for this mutant injects only these
    kinds."""
    fixed: bool = False
    """Whether the hunt runs the cell with fixed tappers."""
    several: bool = False
    """Whether the hunt runs only cells with several objects."""
    set_up: bool = False
    """Whether the hunt runs the cell in set-up mode."""
    ask: bool = False
    """Whether the hunt runs a cell that asks a person before every tap."""


MUTANTS: tuple[Mutant, ...] = (
    Mutant(
        "fires after the arm's promise has ended",
        "tapping_cell.logic.tapper",
        "if end > promise.until:",
        "if False:",
        "S1",
        kinds=("freeze at a write", "freeze at a shot"),
    ),
    Mutant(
        "fires without asking the arm",
        "tapping_cell.logic.tapper",
        '        token = ("hold", self._tap.tap_id, self._attempts)\n'
        '        self._effects.append(Call("hold_still", request, token, HOLD_TIMEOUT_S))\n',
        "        shot = request.tap_id\n"
        "        self._permit = Permit(shot, math.inf)\n"
        "        self._machine.move(Event.HELD, S.FIRING)\n"
        '        self._run("fire", partial(tapper_jobs.fire, shot=shot, '
        "check=self.check_firing))\n",
        "S1",
        kinds=("foreign withdrawal", "received by one", "freeze at a shot"),
    ),
    Mutant(
        "counts the promise from its answer",
        "tapping_cell.logic.tapper",
        "until = self._asked_at + permit.hold(tap.flight)",
        "until = now.steady + permit.hold(tap.flight)",
        "S1",
        kinds=("slow answer", "freeze at a write"),
    ),
    Mutant(
        "fires although the arm refuses to hold still",
        "tapping_cell.logic.tapper",
        "if response is not None and not response.granted:",
        "if False:",
        "S1",
        kinds=("foreign outcome", "foreign withdrawal", "received by one"),
    ),
    Mutant(
        "reports an unknown outcome as not fired",
        "tapping_cell.logic.tapper",
        "FireOutcome.UNKNOWN: TapperState.UNKNOWN",
        "FireOutcome.UNKNOWN: TapperState.NOT_FIRED",
        kinds=("cable at a shot", "line at a shot"),
    ),
    Mutant(
        "reports every shot as fired",
        "tapping_cell.logic.tapper",
        "FireOutcome.NOT_FIRED: TapperState.NOT_FIRED",
        "FireOutcome.NOT_FIRED: TapperState.FIRED",
        kinds=("guard", "line at a shot", "cancel"),
    ),
    Mutant(
        "serves a tap id twice",
        "tapping_cell.logic.tap_commands",
        "if command.tap_id <= last_tap_id:",
        "if False:",
        kinds=("repeated command",),
    ),
    Mutant(
        "accepts a second tap during a tap",
        "tapping_cell.logic.tapper",
        "        if self.state is not S.SAFE:\n            serving =",
        "        if False:\n            serving =",
        "S7",
        kinds=("foreign command",),
    ),
    Mutant(
        "fires at an object that was moved",
        "tapping_cell.logic.tapper_peers",
        "            or self._disturbance(planned, now)\n",
        "",
        kinds=("object moved",),
    ),
    Mutant(
        "checks the object's position only",
        "tapping_cell.logic.tapper_peers",
        "if moved <= limits.moved and turned <= limits.turned:",
        "if moved <= limits.moved:",
        "S11",
        kinds=("object turned",),
    ),
    Mutant(
        "fires without a planner",
        "tapping_cell.logic.tapper_peers",
        "            or self._silence(now)\n",
        "",
        kinds=("kill", "freeze", "camera"),
    ),
    Mutant(
        "fires although the planner no longer waits for the tap",
        "tapping_cell.logic.tapper_peers",
        "if self._planners_tap and self._phase not in TAPPING:",
        "if False:",
        kinds=("restart", "deactivate", "foreign state", "received by one", "slow topic"),
    ),
    Mutant(
        "fires although the clocks differ",
        "tapping_cell.logic.tapper_peers",
        "        if skewed is None:\n",
        "        if True:\n",
        kinds=("clock step",),
    ),
    Mutant(
        "accepts a command from the future",
        "tapping_cell.logic.tap_commands",
        "if ahead > CLOCK_TOLERANCE_S:",
        "if False:",
    ),
    Mutant(
        "fires although the object is no longer visible",
        "tapping_cell.logic.tapper_peers",
        "if seen is None or unseen > limits.unseen:",
        "if seen is None:",
        "S11",
        kinds=("camera",),
    ),
    Mutant(
        "ignores the last check before FIRE",
        "tapping_cell.logic.tapper_jobs",
        "refusal = context.ask(lambda now: check(release_by, now))\n"
        "        return refusal is None and not context.abandoned()",
        "refusal = context.ask(lambda now: check(release_by, now))\n"
        "        refusal = None\n"
        "        return True",
        "S1",
        kinds=("freeze at a write", "freeze at a shot"),
    ),
    Mutant(
        "does not send a stop on the serial line",
        "tapping_cell.logic.device",
        "                self._stop_sent_at = now.steady\n"
        "                self._effects.append(StopWire())\n",
        "                self._stop_sent_at = now.steady\n",
        "S4",
        kinds=("emergency stop",),
    ),
    Mutant(
        "forgets a stop at a restart",
        "tapping_cell.logic.device",
        "        self._stops.recall(content)\n",
        "",
        "S5",
        kinds=("emergency stop", "kill", "restart"),
    ),
    Mutant(
        "does not keep a stop on disk",
        "tapping_cell.logic.device",
        "self._effects.append(KeepStop(self._stops.content()))",
        "pass",
        "S5",
        kinds=("emergency stop", "kill", "restart"),
    ),
    Mutant(
        "does not receive the emergency stop",
        "tapping_cell.logic.stops",
        "            changed = self._add(TOPIC) or changed\n",
        "",
        "S4",
        kinds=("emergency stop",),
    ),
    Mutant(
        "resets while the emergency stop is held",
        "tapping_cell.logic.stops",
        "        if levels.asserted:\n            self._asserted = True\n",
        "        if False:\n            self._asserted = True\n",
        "S4",
        kinds=("emergency stop",),
    ),
    Mutant(
        "clears a stop that was pressed during the request to clear",
        "tapping_cell.logic.stops",
        "if self._received != request.stops:",
        "if False:",
    ),
    Mutant(
        "clears a stop of unknown level without a confirmation",
        "tapping_cell.logic.stops",
        "        if doubt and not request.confirms:\n",
        "        if False:\n",
        kinds=("further panel",),
    ),
    Mutant(
        "keeps a confirmation when a new stop arrives",
        "tapping_cell.logic.stops",
        "        self._received += 1\n        self._confirm_until = -math.inf\n",
        "        self._received += 1\n",
        kinds=("further panel",),
    ),
    Mutant(
        "keeps a confirmation without a limit",
        "tapping_cell.logic.stops",
        "now.steady <= self._confirm_until",
        "math.isfinite(self._confirm_until)",
        kinds=("further panel",),
    ),
    Mutant(
        "counts a request made before the refusal as a confirmation",
        "tapping_cell.logic.stops",
        "if doubt and not request.confirms:",
        "if doubt and not now.steady <= self._confirm_until:",
        kinds=("further panel",),
    ),
    Mutant(
        "ignores publishers that do not repeat their level",
        "tapping_cell.logic.stops",
        "        if levels.silent:\n",
        "        if False:\n",
        kinds=("further panel",),
    ),
    Mutant(
        "ignores publishers that have vanished",
        "tapping_cell.logic.stops",
        "if self._asserted or levels.gone:",
        "if self._asserted:",
        kinds=("further panel",),
    ),
    Mutant(
        "ignores the last level if its publisher is not known",
        "tapping_cell.logic.stops",
        "if self._asserted or levels.gone:",
        "if levels.gone:",
        kinds=("further panel", "freeze", "slow topic"),
    ),
    Mutant(
        "forgets at a restart that the publishers of a stop are not known",
        "tapping_cell.logic.stops",
        "        self._publishers_unknown = TOPIC in names or RESTART in names\n",
        "",
        kinds=("further panel", "kill"),
    ),
    Mutant(
        "does not notice a stop that was cleared while the planner was frozen",
        "tapping_cell.logic.cell_monitor",
        "        if stamp in known:\n",
        "        if True:\n",
        kinds=("freeze", "stop and reset", "stop and reset"),
    ),
    Mutant(
        "an outdated job changes the state",
        "tapping_cell.logic.device",
        "        elif event.job == self._job:\n            self._job = None\n",
        "        elif True:\n            self._job = None\n",
        "S8",
        kinds=("emergency stop", "stop service", "freeze before a write"),
    ),
    Mutant(
        "does not promise to stand still",
        "tapping_cell.logic.arm",
        "        self._promise_end = max(self._promise_end, end)\n",
        "",
        "S1",
        kinds=("foreign withdrawal", "cancel", "received by one"),
    ),
    Mutant(
        "promises while it moves",
        "tapping_cell.logic.arm",
        "if not self._active or self.state is not S.IN_POSITION or request.tap_id != self._tap_id:",
        "if not self._active:",
        kinds=("foreign hold",),
    ),
    Mutant(
        "moves during the flight of the striker",
        "tapping_cell.logic.tapper",
        "self._release_arm(permit.RELEASED_S + struck.flight)",
        "self._release_arm(permit.RELEASED_S)",
        kinds=("foreign withdrawal", "cancel", "received by one"),
    ),
    Mutant(
        "moves for a withdrawal of no tap",
        "tapping_cell.logic.arm",
        "            elif command.tap_id != 0 and command.tap_id == self._last_tap_id:\n",
        "            elif True:\n",
        "S6",
        kinds=("foreign command",),
    ),
    Mutant(
        "a read under way overwrites the state",
        "tapping_cell.logic.tapper",
        "        self._on_switch(result.reply, now)\n        self._see_stop(result.reply)\n",
        "        if result.reply.state.value == 'SAFE':\n"
        "            self._machine._state = S.SAFE\n",
        "S7",
        Mutant(
            "uses the result of a status read although a job is running",
            "tapping_cell.logic.device",
            "            if (self._job is None or is_defect) and not self._stops.stopped:\n",
            "            if not self._stops.stopped:\n",
        ),
        kinds=("freeze before a write", "foreign command"),
    ),
    Mutant(
        "the board homes without moving",
        "tapping_cell.simulation.spring_drive",
        "        self._begin(Phase.LEAVING, now, wake)\n",
        "        self._count = 0\n        self._begin(Phase.HOLDING, now, wake)\n",
        "S2",
        kinds=("power at a shot", "loss of power", "motors off"),
    ),
    Mutant(
        "fires at the strike pose of another tap with its id",
        "tapping_cell.logic.tapper_peers",
        "        if not _above(arm, strike):\n",
        "        if False:\n",
        kinds=("duplicates",),
    ),
    Mutant(
        "ignores the ids that its board has used",
        "tapping_cell.logic.tapper",
        "max(self._last_tap_id, self._used or 0)",
        "self._last_tap_id",
        "",
        Mutant(
            "reports a used id as not fired",
            "tapping_cell.logic.tapper",
            "        spent = why is not None and why[0] == ErrorCode.TAPPER_SPENT\n",
            "        spent = False\n",
        ),
        kinds=("kill", "restart", "repeated command"),
    ),
    Mutant(
        "reports an old tap as not fired before the board was read",
        "tapping_cell.logic.tapper",
        "            if self._used is not None:\n",
        "            if True:\n                self._used = self._used or 0\n",
        kinds=("kill", "restart", "repeated command"),
    ),
    Mutant(
        "reports an open guard as a fault of the tapper",
        "tapping_cell.hardware.tapper",
        "                FaultReason.INTERLOCK,\n",
        "                FaultReason.REJECTED,\n",
        kinds=("guard",),
    ),
    Mutant(
        "leaves before its promise is over",
        "tapping_cell.logic.arm",
        "not_before = self._free_at(now)",
        "not_before = 0.0",
        "S1",
        Mutant(
            "withdraws before its promise is over",
            "tapping_cell.logic.arm",
            "free_at=self._free_at",
            "free_at=lambda now: 0.0",
        ),
        kinds=("freeze at a shot", "received by one"),
    ),
    Mutant(
        "lets any requester end the arm's promise",
        "tapping_cell.logic.arm",
        "if requester == self._promised_to and is_shorter and self._is_of_tapper(request.key):",
        "if is_shorter:",
        "",
        kinds=("foreign outcome",),
    ),
    Mutant(
        "lets the first requester end the arm's promise, whether or not it is the tapper",
        "tapping_cell.logic.arm",
        "return key > 0 and self._key_digests == {permit.key_digest(key)}",
        "return key > 0",
        "",
        kinds=("foreign hold",),
    ),
    Mutant(
        "accepts the promise of another arm",
        "tapping_cell.logic.tapper",
        "elif response is not None and (error := self._peers.other_arm(response.arm_key)):",
        "elif response is not None and (error := None):",
        "",
        kinds=("second arm", "kill"),
    ),
    Mutant(
        "a second promise replaces the first one",
        "tapping_cell.logic.arm",
        "        if now.steady < self._promise_end and requester != self._promised_to:\n",
        "        if False:\n",
        "",
        kinds=("foreign hold",),
    ),
    Mutant(
        "stays at the strike pose of an expired tap",
        "tapping_cell.logic.arm",
        "if self.state is S.IN_POSITION and now.ros > self._expiry:",
        "if False:",
    ),
    Mutant(
        "leaves with a charged striker",
        "tapping_cell.logic.arm",
        "return max(self._promise_end, min(self._charged_until, now.steady + LONGEST_WAIT_S))",
        "return self._promise_end",
        "",
        Mutant(
            "withdraws with a charged striker",
            "tapping_cell.logic.arm",
            "if now.steady < min(self._charged_until, self._leaving_since + LONGEST_WAIT_S):",
            "if False:",
        ),
        kinds=("foreign withdrawal", "received by one", "cancel"),
    ),
    Mutant(
        "believes every publisher's report that the striker is discharged",
        "tapping_cell.logic.arm",
        "        if ours and not released and message.state in CHARGED:\n",
        "        if ours and message.state not in CHARGED:\n"
        "            self._charged_until = -math.inf\n"
        "        elif ours:\n",
        kinds=("foreign flood",),
    ),
    Mutant(
        "accepts a trajectory while a tap is pending",
        "tapping_cell.logic.arm",
        "        if not self._active or self.state is not S.IDLE:\n"
        "            code = ErrorCode.ARM_BUSY",
        "        if not self._active:\n            code = ErrorCode.ARM_BUSY",
        kinds=("foreign trajectory",),
    ),
    Mutant(
        "homes by itself when activated",
        "tapping_cell.logic.arm",
        "alone = self._options.home_on_activate and not",
        "alone = not",
        "S5",
        kinds=("kill", "restart", "deactivate"),
    ),
    Mutant(
        "trusts an arm that was not homed",
        "tapping_cell.logic.arm",
        "        elif self._homed():\n            self._machine.move(event, S.IDLE)",
        "        elif True:\n            self._machine.move(event, S.IDLE)",
        kinds=("loss of power", "motors off", "kill"),
    ),
    Mutant(
        "accepts a tap while it is busy",
        "tapping_cell.logic.arm",
        "        if self.state is not S.IDLE:\n            return ErrorCode.ARM_BUSY",
        "        if False:\n            return ErrorCode.ARM_BUSY",
        kinds=("foreign command",),
    ),
    Mutant(
        "never aborts a goal",
        "tapping_cell.logic.planner",
        "        if now.steady > task.expires:",
        "        if False:",
        kinds=("camera", "guard"),
    ),
    Mutant(
        "waits for the arm without a limit",
        "tapping_cell.logic.planner",
        "        elif self._late(now):\n            device =",
        "        elif False:\n            device =",
        kinds=("unreported trajectory",),
    ),
    Mutant(
        "decides on an object that still slides",
        "tapping_cell.logic.cell_monitor",
        "            and seen.at_rest\n            and seen.error_code",
        "            and seen.error_code",
        kinds=("object moved",),
    ),
    Mutant(
        "does not withdraw a tap after its outcome",
        "tapping_cell.logic.planner",
        "        self._withdraw(shot.tap_id, now)\n"
        "        if shot.outcome == TapperState.NOT_FIRED and",
        "        if shot.outcome == TapperState.NOT_FIRED and",
        kinds=("camera",),
    ),
    Mutant(
        "commands the same tap id again",
        "tapping_cell.logic.planner",
        "max(self._last_tap_id + 1, now.ros // NANOSECONDS, used + 1)",
        "max(self._last_tap_id, now.ros // (100 * NANOSECONDS), used)",
        kinds=("restart", "kill"),
    ),
    Mutant(
        "samples the board's time after the last check",
        "tapping_cell.hardware.tapper",
        "        sample = self._request(Command.STATUS)\n"
        "        sampled_at = self._transport.now()\n"
        "        if sample",
        "        asked_at = self._transport.now()\n"
        "        allowed = still_allowed(self._latest_release(asked_at, window))\n"
        "        sample = self._request(Command.STATUS)\n"
        "        sampled_at = self._transport.now()\n"
        "        still_allowed = lambda _: allowed  # noqa: E731\n"
        "        if sample",
        "S1",
        kinds=("freeze after the last check",),
    ),
    Mutant(
        "a missing reply to FIRE counts as not fired",
        "tapping_cell.hardware.tapper",
        '            return self._unknown(shot, release_by, "the tapper does not answer")',
        '            return self._not_fired(shot, "the tapper does not answer")',
        kinds=("cable at a shot", "line at a shot"),
    ),
    Mutant(
        "accepts a restarted board's report for the shot",
        "tapping_cell.hardware.tapper",
        "        if reply.boot != boot:\n"
        "            self._boot = None\n"
        "            return self._unknown(shot, release_by",
        "        if False:\n"
        "            self._boot = None\n"
        "            return self._unknown(shot, release_by",
        kinds=("power at a shot", "cable at a shot"),
    ),
    Mutant(
        "a move counts as done wherever it ended",
        "tapping_cell.hardware.arm",
        "            if not reading.moving and self._agrees(goal, reading.joints):",
        "            if True:",
        kinds=("motors off", "serial line", "loss of power"),
    ),
    Mutant(
        "homing is kept over a reset of the board",
        "tapping_cell.hardware.arm",
        "if not (firmware.continued and held and not reading.alarm):",
        "if False:",
        kinds=("loss of power",),
    ),
    Mutant(
        "a reset continues the goal",
        "tapping_cell.logic.planner",
        "            if stop is not None and self._task is not None:\n"
        "                self._fail(*stop, now)\n",
        "",
        kinds=("stop and reset",),
    ),
    Mutant(
        "accepts a goal while the tapper is stopped",
        "tapping_cell.logic.cell_monitor",
        "FAULTED = (TapperState.FAULT, TapperState.STOPPED)\n",
        "FAULTED = (TapperState.FAULT,)\n",
        kinds=("stop service", "second client"),
    ),
    Mutant(
        "does not end the goal at an emergency stop",
        "tapping_cell.logic.planner",
        '        elif topic == "emergency_stop" and message.data:\n',
        "        elif False:\n",
        kinds=("emergency stop",),
    ),
    Mutant(
        "accepts goals after its deactivation",
        "tapping_cell.logic.planner",
        "            self._active = False\n            self._resumed = None\n",
        "            self._resumed = None\n",
        kinds=("deactivate", "second client"),
    ),
    Mutant(
        "taps more often than the goal allows",
        "tapping_cell.logic.planner",
        "        if task.taps >= task.max_taps:\n",
        "        if False:\n",
        kinds=("kill",),
    ),
    Mutant(
        "ignores a cancellation",
        "tapping_cell.logic.planner",
        "if self._task is not None and self._task.token == token:",
        "if False:",
        kinds=("cancel",),
    ),
    Mutant(
        "ignores the service that ends the present goal",
        "tapping_cell.logic.planner",
        "        if self._task is not None:\n            self._cancel(now)\n        else:\n",
        "        if True:\n",
        kinds=("cancel by service",),
    ),
    Mutant(
        "resumes a goal that was cancelled after a crash",
        "tapping_cell.logic.planner",
        "        crashed, self._resumed = self._resumed, None\n        if self._task",
        "        crashed = self._resumed\n        if self._task",
        kinds=("cancel by service",),
    ),
    Mutant(
        "resumes a goal that was cancelled before the planner was configured",
        "tapping_cell.logic.planner",
        "            # Before the node is configured, the stored goal is still on disk.\n"
        "            self._effects.append(KeepGoal(None))\n",
        "",
        kinds=("cancel by service",),
    ),
    Mutant(
        "does not withdraw the tap of a cancelled goal",
        "tapping_cell.logic.planner",
        "        self._end_tap(now)\n        self._finish(S.CANCELED, ErrorCode.GOAL_CANCELED",
        "        self._finish(S.CANCELED, ErrorCode.GOAL_CANCELED",
        kinds=("cancel by service", "cancel"),
    ),
    Mutant(
        "calls a failed goal a success",
        "tapping_cell.logic.planner",
        "                self._fail(*stop, now)\n",
        "                self._fail(ErrorCode.NONE, stop[1], now)\n",
        kinds=("stop service", "emergency stop"),
    ),
    Mutant(
        "keeps the goal that has ended",
        "tapping_cell.logic.planner",
        "        self._park(now)\n        self._effects.append(KeepGoal(None))\n",
        "        self._park(now)\n",
        kinds=("kill",),
    ),
    Mutant(
        "resumes a goal of any age",
        "tapping_cell.logic.planner",
        "        if late > 0:\n",
        "        if False:\n",
        kinds=("kill",),
    ),
    Mutant(
        "resumes a goal although the clock was set back",
        "tapping_cell.logic.planner",
        "        if event.kept_goal_age < 0:\n",
        "        if False:\n",
        kinds=("kill",),
    ),
    Mutant(
        "does not store the number of taps",
        "tapping_cell.logic.planner",
        "self._keep_goal(self._task, now)  # before",
        "# before",
        kinds=("kill",),
    ),
    Mutant(
        "leaves the last tap of a failed goal out of its result",
        "tapping_cell.logic.task",
        "if shot.outcome in (TapperState.FIRED, TapperState.UNKNOWN) and not recorded:",
        "if False:",
        kinds=("cancel", "emergency stop"),
    ),
    Mutant(
        "connects as if no stop was stored",
        "tapping_cell.logic.device",
        "            if self._stops.stopped:\n"
        "                self._effects.append(StopWire())\n"
        "                self._stop(now)\n"
        "            else:\n"
        "                self._connected(event.connected, now)\n",
        "            self._connected(event.connected, now)\n",
        kinds=("emergency stop", "kill", "restart", "stop service"),
    ),
    Mutant(
        "does not latch a stop of the service",
        "tapping_cell.logic.device",
        "            if self._stops.press():\n"
        "                self._keep_stops(now)\n"
        "            self._stop(now)\n"
        '            self._answer(token, True, "stopped',
        '            self._stop(now)\n            self._answer(token, True, "stopped',
        kinds=("stop service", "kill", "restart"),
    ),
    Mutant(
        "promises again after the outcome of the tap",
        "tapping_cell.logic.arm",
        "        if self._outcome_received == request.tap_id:",
        "        if False:",
        kinds=("foreign outcome", "foreign hold", "foreign flood", "received by one"),
    ),
    Mutant(
        "completes its motion when it is deactivated",
        "tapping_cell.logic.arm",
        "            self._abandon()\n            self._halting = True",
        "            self._halting = True",
        kinds=("deactivate",),
    ),
    Mutant(
        "withdraws to any pose",
        "tapping_cell.logic.withdrawal",
        "        free = tried[_is_free(cell, geometry, scene, tried)]\n",
        "        free = tried\n",
        kinds=("cancel",),
    ),
    Mutant(
        "takes the outcome of another tap",
        "tapping_cell.logic.cell_monitor",
        "return tapper if tapper is not None and tapper.tap_id == tap_id else None",
        "return tapper",
        kinds=("slow topic", "foreign command", "foreign outcome"),
    ),
    Mutant(
        "accepts clocks that are ahead",
        "tapping_cell.logic.peer_clock",
        "if abs(skew) > SKEW_LIMIT_S:",
        "if skew > SKEW_LIMIT_S:",
        kinds=("clock step",),
    ),
    Mutant(
        "never forgets the smallest delay",
        "tapping_cell.logic.peer_clock",
        "        while self._delays[0][0] < now.steady - WINDOW_S:\n"
        "            self._delays.popleft()\n",
        "",
        kinds=("clock step",),
    ),
    Mutant(
        "does not count the taps before a crash",
        "tapping_cell.logic.task",
        "return self.earlier_taps + len(self.records)",
        "return len(self.records)",
        kinds=("kill",),
    ),
    Mutant(
        "plans on an image that was taken before the last tap",
        "tapping_cell.logic.cell_monitor",
        "            and self.observed_at(now) > after + QUICKEST_IMAGE_S\n",
        "",
        kinds=("camera",),
    ),
    Mutant(
        "gives a resumed goal its whole time limit again",
        "tapping_cell.logic.planner",
        'left = float(kept["time_left"]) - max(passed, event.kept_goal_age)',
        "left = self._settings.goal_time_limit",
        kinds=("kill",),
    ),
    Mutant(
        "reports every arm that is not ready as busy",
        "tapping_cell.logic.cell_monitor",
        "            return arm.error_code or ErrorCode.ARM_BUSY, "
        'arm.error_msg or f"the arm is {doing}"\n',
        '            return ErrorCode.ARM_BUSY, f"the arm is {doing}"\n',
        kinds=("serial line", "motors off", "cable at a shot", "loss of power"),
    ),
    Mutant(
        "loses an activation that arrives before the abandoned motion has ended",
        "tapping_cell.logic.arm",
        "        self._error = INACTIVE_ERROR\n        if self._active:\n"
        "            self._activated(now)\n",
        "        self._error = INACTIVE_ERROR\n",
        kinds=("deactivate",),
    ),
    Mutant(
        "takes the planner's state after the last tap for that of the new tap",
        "tapping_cell.logic.tapper_peers",
        "        self._planners_tap = False\n        self._arm_keys = set()",
        "        self._arm_keys = set()",
        kinds=("slow topic", "freeze", "foreign command"),
    ),
    Mutant(
        "resumes a goal although the cell was stopped while no planner ran",
        "tapping_cell.logic.planner",
        "        stop = self._monitor.recall_stops(self._recalled_stops)\n",
        "        stop = None\n",
        kinds=("kill", "stop service", "stop and reset", "emergency stop"),
    ),
    Mutant(
        "commands taps while the guard is open",
        "tapping_cell.logic.cell_monitor",
        "        if not tapper.interlock_closed:\n",
        "        if False:\n",
        kinds=("guard",),
    ),
    Mutant(
        "moves on to the strike pose after a withdrawal",
        "tapping_cell.logic.arm",
        "        self._leaving_since = now.steady\n        self._abandon()\n",
        "        self._leaving_since = now.steady\n",
        kinds=("cancel", "object moved", "foreign withdrawal"),
    ),
    Mutant(
        "plans on an image of any age",
        "tapping_cell.logic.cell_monitor",
        "            and now.steady - self.observed_at(now) <= self._silence_limit\n",
        "",
        kinds=("camera",),
    ),
)


class MutantError(Exception):
    """A mutant does not match the source that it changes, or cannot be applied any more."""


class _Loader(importlib.machinery.SourceFileLoader):
    """Loader of a module with its mutants."""

    def __init__(self, name: str, path: str, mutants: Sequence[Mutant]) -> None:
        super().__init__(name, path)
        self._mutants = mutants

    def get_code(self, fullname: str):  # type: ignore[no-untyped-def]
        """Return the code of the changed source, never from a cache."""
        return compile(_changed(self._mutants), self.path, "exec", dont_inherit=True)


class _Finder(importlib.abc.MetaPathFinder):
    """Finder for the modules of mutants. It takes precedence over all other finders."""

    def __init__(self, mutants: Sequence[Mutant]) -> None:
        self._mutants = mutants

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return the specification of a module with mutants, or None for any other module."""
        here = [mutant for mutant in self._mutants if mutant.module == name]
        if not here:
            return None
        loader = _Loader(name, str(_source_of(name)), here)
        return importlib.util.spec_from_loader(name, loader)


def _source_of(module: str) -> Path:
    # Not resolved: exceptions are planted by the path of the code, so a mutant must not change it.
    package = Path(__file__).parents[1]
    return package.joinpath(*module.split(".")[1:]).with_suffix(".py")


def parts_of(mutant: Mutant) -> tuple[Mutant, ...]:
    """Return a mutant and the mutants that must be applied with it (``also``)."""
    return (mutant,) if mutant.also is None else (mutant, *parts_of(mutant.also))


def mutated(mutant: Mutant) -> str:
    """Return the source of a mutant's module with the replacement.

    Raises:
        MutantError: the text to be replaced does not occur exactly once in the source.
    """
    return _changed([mutant])


def _changed(mutants: Sequence[Mutant]) -> str:
    """Apply mutants of one module to its source, and return the changed source."""
    source = _source_of(mutants[0].module).read_text(encoding="utf-8")
    for mutant in mutants:
        count = source.count(mutant.old)
        if count != 1:
            raise MutantError(
                f"mutant '{mutant.name}': its text occurs {count} times in {mutant.module}; it"
                " must occur once"
            )
        source = source.replace(mutant.old, mutant.new)
    return source


def plant(mutant: Mutant) -> None:
    """Apply a mutant in this process, before its module is imported.

    Raises:
        MutantError: the module was already imported, or the mutant does not match its source.
    """
    parts = parts_of(mutant)
    for part in parts:
        mutated(part)
        if part.module in sys.modules:
            raise MutantError(f"{part.module} was imported before mutant '{part.name}' was applied")
    sys.meta_path.insert(0, _Finder(parts))
