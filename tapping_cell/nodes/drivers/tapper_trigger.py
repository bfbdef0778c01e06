"""The tapper's node: draws and fires once a tap, only while the arm is in position for it."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.time import Time
from tapping_cell_msgs.msg import (
    ArmState,
    ErrorCode,
    ObjectState,
    PlanState,
    TapCommand,
    TapperState,
)

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.schema import quantity, text
from tapping_cell.hardware.energy import EnergyCurve
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.hardware.tapper import FireOutcome, FireResult, TapperDriver
from tapping_cell.hardware.tapper_protocol import Reply, State
from tapping_cell.logic.error_codes import of_tapper
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.drivers import tap_commands
from tapping_cell.nodes.drivers.driver_node import DriverNode, run_driver
from tapping_cell.nodes.drivers.peer_watch import PeerWatch

READ_PERIOD_S = 0.1
WINDOW_S = 0.05
"""How long after the last check the board may release."""
OUTCOMES = {
    FireOutcome.FIRED: TapperState.FIRED,
    FireOutcome.NOT_FIRED: TapperState.NOT_FIRED,
    FireOutcome.UNKNOWN: TapperState.UNKNOWN,
}


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of tapper_trigger."""

    autostart: bool = text("configure and activate without being asked", default=True)
    cell_file: str = text("path of the cell file; empty for the package's own", default="")
    port: str = text("path of the tapper's serial port; empty for the cell file's", default="")
    state_rate: float = quantity("rate of tapper_state", "Hz", 1.0, 200.0, default=20.0)
    arm_freshness: float = quantity(
        "greatest age of the arm's read-back at the moment of firing", "s", 0.02, 2.0, default=0.3
    )
    silence_limit: float = quantity(
        "longest silence of planner and camera with which a tap is drawn and fired",
        "s",
        0.1,
        5.0,
        default=0.45,
    )


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What the worker knows and the executor publishes."""

    state: int = TapperState.DISCONNECTED
    tap_id: int = 0
    outcome: int = TapperState.NONE
    measured_speed: float = math.nan
    shots_fired: int = 0
    boot_number: int = 0
    interlock_closed: bool = False
    error_code: int = ErrorCode.TAPPER_NOT_CONNECTED
    error_msg: str = "the tapper is not connected yet"


@dataclass(frozen=True, slots=True)
class Pending:
    """A tap that waits for the arm."""

    tap_id: int
    energy: float
    expiry: Time


class TapperTrigger(DriverNode[Parameters, TapperDriver, Snapshot]):
    """See the module's docstring."""

    stopped_state = TapperState.STOPPED
    stopped_trouble = (
        ErrorCode.TAPPER_STOPPED,
        "the tapper was stopped; make the cell safe, then call clear_fault",
    )
    fault_states: ClassVar[dict[FaultReason, int]] = {
        FaultReason.DISCONNECTED: TapperState.DISCONNECTED,
        FaultReason.PORT_MISSING: TapperState.DISCONNECTED,
        FaultReason.PORT_BUSY: TapperState.DISCONNECTED,
        FaultReason.TIMEOUT: TapperState.DISCONNECTED,
        FaultReason.BOARD_RESET: TapperState.DISCONNECTED,
        FaultReason.STOPPED: TapperState.STOPPED,
        FaultReason.NEEDS_PERSON: TapperState.STOPPED,
    }
    fault_state = TapperState.FAULT
    healthy_states = frozenset(
        {TapperState.SAFE, TapperState.CHARGING, TapperState.CHARGED, TapperState.FIRING}
    )
    told_at_once = ("state", "tap_id", "outcome", "error_code")
    idle_period = READ_PERIOD_S

    def __init__(self) -> None:
        super().__init__("tapper_trigger", Parameters, Snapshot())
        self._curve: EnergyCurve | None = None
        self._pending: Pending | None = None
        self._heard: tuple[ArmState | None, float] = (None, 0.0)
        self._peers = PeerWatch(self.settings.silence_limit)
        self._last_tap_id = 0
        self._publisher = self.create_publisher(TapperState, "tapper_state", LATCHED)
        self.create_subscription(TapCommand, "tap_command", self._on_tap_command, COMMAND)
        self.create_subscription(ArmState, "arm_state", self._on_arm_state, LATCHED)
        self.create_subscription(PlanState, "plan_state", self._on_plan_state, LATCHED)
        self.create_subscription(ObjectState, "object_state", self._on_object_state, LATCHED)
        self.create_timer(1.0 / self.settings.state_rate, self._tick)

    # Life cycle

    def configure(self) -> None:
        """Read the cell file, open the port, open a session, which disarms the tapper."""
        cell = load_cell(self.settings.cell_file or None)
        tapper = cell.file.tapper
        port = str(self.port_path(self.settings.port or tapper.port))
        reply = self.connect(TapperDriver(SerialTransport(port, tapper.baud)), port)
        self._curve = tapper.curve()
        self._set_safe(reply)

    def deactivate(self) -> None:
        """Give up the tap under way, unless it was fired."""
        self._abandon("the node was deactivated", ErrorCode.NOT_ACTIVE)

    def code_of(self, fault: HardwareFault) -> int:
        """The ErrorCode of a fault of the tapper."""
        return of_tapper(fault)

    def give_up(self) -> None:
        """A stop ends the tap that waits."""
        pending, self._pending = self._pending, None
        if pending is not None:
            self.set(outcome=TapperState.NOT_FIRED)

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Port, firmware and counters."""
        driver, now = self.driver, self.snapshot
        if driver is None:
            return DiagnosticStatus.WARN, now.error_msg, {}
        counters = driver.counters
        values: dict[str, object] = {
            "hardware_id": "tapper",
            "port": self.port,
            "firmware": driver.version,
            "shots fired": counters.fired,
            "outcome unknown": counters.unknown,
            "retries": counters.retries,
            "timeouts": counters.timeouts,
            "bad frames": counters.bad_frames,
            "reconnects": counters.reconnects,
            "stops": counters.stops,
            "last error": counters.last_error,
        }
        if self.defect is not None:
            return DiagnosticStatus.ERROR, f"defect: {self.defect!r}", values
        if now.error_code:
            return DiagnosticStatus.ERROR, now.error_msg, values
        return DiagnosticStatus.OK, "ok", values

    # Commands

    def _on_tap_command(self, command: TapCommand) -> None:
        if command.request == TapCommand.WITHDRAW:
            if command.tap_id == self.snapshot.tap_id:
                self._abandon("the tap was abandoned", ErrorCode.NONE)
            return
        refusal = self._refusal(command)
        if refusal is not None:
            code, sentence = refusal
            self.get_logger().error(f"tap {command.tap_id} refused: {sentence}")
            # While another tap is under way the state tells of that one, and of no other.
            if command.tap_id > self._last_tap_id and not self._serving():
                self._last_tap_id = command.tap_id
                self.set(
                    tap_id=command.tap_id,
                    outcome=TapperState.NOT_FIRED,
                    error_code=code,
                    error_msg=sentence,
                )
            return
        assert self._curve is not None
        self._last_tap_id = command.tap_id
        self.abandoned.clear()
        self._peers.begin_tap()
        self._pending = Pending(
            command.tap_id,
            self._curve.energy_for(command.striker_speed),
            Time.from_msg(command.expiry),
        )
        self.set(
            tap_id=command.tap_id,
            outcome=TapperState.NONE,
            measured_speed=math.nan,
            error_code=0,
            error_msg="",
        )

    def _serving(self) -> bool:
        """Whether a tap waits or is under way."""
        return self._pending is not None or self.snapshot.state in (
            TapperState.CHARGING,
            TapperState.CHARGED,
            TapperState.FIRING,
        )

    def _refusal(self, command: TapCommand) -> tuple[int, str] | None:
        """Why a tap command is not taken; None when it is."""
        now = self.get_clock().now()
        if not self.active or self._curve is None:
            return ErrorCode.NOT_ACTIVE, "the node is not active; activate it first"
        if self._serving():
            return ErrorCode.TAPPER_BUSY, f"it serves tap {self.snapshot.tap_id}"
        if self.stopped or self.snapshot.state != TapperState.SAFE:
            return ErrorCode.TAPPER_BUSY, f"the tapper is not at rest: {self.snapshot.error_msg}"
        if tap_commands.expired(command, now):
            return ErrorCode.TAPPER_COMMAND_EXPIRED, "its expiry has passed"
        speed = command.striker_speed
        if math.isfinite(speed) and not self._curve.slowest <= speed <= self._curve.fastest:
            return (
                ErrorCode.TAPPER_SPEED_OUT_OF_RANGE,
                f"a striker speed of {1000 * speed:.1f} mm/s is outside the tapper's "
                f"{1000 * self._curve.slowest:.1f} to {1000 * self._curve.fastest:.1f} mm/s",
            )
        return tap_commands.refusal(command, now, self._last_tap_id)

    def _on_plan_state(self, message: PlanState) -> None:
        self._peers.on_plan(message)
        gone = self._peers.given_up()
        if self._pending is not None and gone is not None:
            code, sentence = gone
            self._abandon(sentence, code)

    def _on_object_state(self, message: ObjectState) -> None:
        self._peers.on_object(message, self.get_clock().now())

    def _on_arm_state(self, message: ArmState) -> None:
        # One assignment, because the worker reads it in the moment before it fires.
        self._heard = (message, time.monotonic())
        pending = self._pending
        if pending is not None and self._doubt(pending.tap_id) is None:
            self._pending = None
            self.set(state=TapperState.CHARGING)
            self.submit(lambda: self._shoot(pending))

    def _abandon(self, why: str, code: int) -> None:
        """Give up the tap that waits; one under way in the worker sees the flag before it fires."""
        self.abandoned.set()
        pending, self._pending = self._pending, None
        if pending is not None:
            self.set(outcome=TapperState.NOT_FIRED, error_code=code, error_msg=why if code else "")

    # The interlock with the arm

    def _arm_refusal(self, tap_id: int) -> str | None:
        """Why the arm does not allow to fire this tap now; None when it does."""
        arm, heard = self._heard
        limit = self.settings.arm_freshness
        if arm is None:
            return "the arm has not reported yet"
        if arm.state != ArmState.IN_POSITION or arm.tap_id != tap_id:
            return (
                f"the arm is not in position for tap {tap_id} (state {arm.state}, tap {arm.tap_id})"
            )
        age = (self.get_clock().now() - Time.from_msg(arm.header.stamp)).nanoseconds * 1e-9
        if not 0 <= age <= limit or time.monotonic() - heard > limit:
            return f"the arm's read-back is {age:.2f} s old, more than {limit:.2f} s"
        return None

    def _doubt(self, tap_id: int) -> tuple[int, str] | None:
        """What arm, planner or camera say, or fail to say, against this tap; None for nothing."""
        sentence = self._arm_refusal(tap_id)
        if sentence is not None:
            return ErrorCode.TAPPER_ARM_NOT_IN_POSITION, sentence
        return self._peers.given_up() or self._peers.missing()

    # Jobs of the worker's thread

    def _shoot(self, tap: Pending) -> None:
        driver = self.require()
        refusal: tuple[int, str] | None = None
        result: FireResult | None = None

        def go_on() -> bool:
            nonlocal refusal
            refusal = refusal or self._last_check(tap)
            return refusal is None

        def last_check(release_by: float) -> bool:
            if not go_on():
                return False
            self.set(state=TapperState.FIRING)
            return True

        try:
            if go_on():
                reply = driver.charge(tap.tap_id, tap.energy, go_on)
                if reply.state is State.CHARGED:
                    self.set(state=TapperState.CHARGED)
                    result = driver.fire(tap.tap_id, WINDOW_S, last_check)
            if refusal is not None and (result is None or result.outcome is FireOutcome.NOT_FIRED):
                code, sentence = refusal
                self.set(
                    state=TapperState.SAFE,
                    outcome=TapperState.NOT_FIRED,
                    error_code=code,
                    error_msg=sentence,
                )
                return
            assert result is not None
        except HardwareFault as fault:
            # Every fault that is raised was met before FIRE went out.
            self.fail(fault, outcome=TapperState.NOT_FIRED)
            return
        code = ErrorCode.NONE
        if result.outcome is FireOutcome.NOT_FIRED:
            code = ErrorCode.TAPPER_FAULT
        elif result.outcome is FireOutcome.UNKNOWN:
            code = ErrorCode.TAPPER_OUTCOME_UNKNOWN
        told: dict[str, object] = {"outcome": OUTCOMES[result.outcome]}
        if code != ErrorCode.NONE:
            told |= {"error_code": code, "error_msg": result.sentence}
        try:
            # The measured speed belongs to the same report as the outcome.
            self._read(**told)
        except HardwareFault as fault:
            self.fail(fault, **told)

    def _last_check(self, tap: Pending) -> tuple[int, str] | None:
        """What forbids to fire, looked at in the last moment; None when nothing does."""
        if self.abandoned.is_set() or self.stopped or not self.active:
            return ErrorCode.NONE, ""
        if self.get_clock().now() > tap.expiry:
            return ErrorCode.TAPPER_COMMAND_EXPIRED, "the tap's expiry passed while it was drawn"
        return self._doubt(tap.tap_id)

    def clear(self) -> None:
        """End a stop or a fault; after a stop the tapper wants a person at the cell as well."""
        driver = self.require()
        self._set_safe(driver.clear())

    def idle(self) -> None:
        """Between taps: read the state, notice a lost line, open it again."""
        driver = self.require()
        if self.snapshot.state == TapperState.STOPPED:
            return
        if not driver.connected:
            self._set_safe(self.reach(driver))
        else:
            self._read()

    def _read(self, **told: object) -> None:
        """Ask for the state and keep it, in one piece with what else is told."""
        reply = self.require().status()
        if reply.stop_latched:
            stopped: dict[str, object] = {
                "state": TapperState.STOPPED,
                "error_code": ErrorCode.TAPPER_STOPPED,
                "error_msg": "the tapper's stop is latched; make the cell safe, then call"
                " clear_fault",
            }
            self.set(**{**told, **stopped})
            return
        self.set(**{"state": TapperState.SAFE, **self._found(reply), **told})

    def _found(self, reply: Reply) -> dict[str, object]:
        """What a reply says, as fields of the snapshot."""
        ours = reply.last_fired == self.snapshot.tap_id and reply.speed is not None
        return {
            "measured_speed": reply.speed if ours else math.nan,
            "shots_fired": self.require().counters.fired,
            "boot_number": reply.boot,
            "interlock_closed": reply.interlock_closed,
        }

    def _set_safe(self, reply: Reply) -> None:
        found = self._found(reply)
        self.set(state=TapperState.SAFE, error_code=0, error_msg="", **found)

    def _tick(self) -> None:
        pending = self._pending
        if pending is not None and self.get_clock().now() > pending.expiry:
            doubt = self._doubt(pending.tap_id)
            why = f": {doubt[1]}" if doubt is not None else ""
            self._abandon(
                f"the tap's expiry passed before it could be fired{why}",
                ErrorCode.TAPPER_COMMAND_EXPIRED,
            )
        self.publish_state()

    def publish_state(self) -> None:
        """Publish what is known of the tapper."""
        now = self.snapshot
        message = TapperState(
            state=now.state,
            tap_id=now.tap_id,
            outcome=now.outcome,
            measured_speed=now.measured_speed,
            shots_fired=now.shots_fired,
            boot_number=now.boot_number,
            interlock_closed=now.interlock_closed,
            error_code=now.error_code,
            error_msg=now.error_msg,
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self._publisher.publish(message)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_driver(TapperTrigger, arguments)


if __name__ == "__main__":
    sys.exit(main())
