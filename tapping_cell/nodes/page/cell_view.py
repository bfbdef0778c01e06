"""State of the cell for the page: the last message of every node, as JSON in mm and degrees."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from tapping_cell_msgs.msg import (
    ArmState,
    ErrorCode,
    GoalReport,
    ObjectStates,
    PlannedTap,
    PlanState,
    StopState,
    TapperState,
    TapRecord,
)

from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now
from tapping_cell.logic.goal_watch import FINAL_STATES
from tapping_cell.logic.poses import covariance_from_message
from tapping_cell.logic.stops import TOPIC
from tapping_cell.nodes.conversions import from_message, seconds
from tapping_cell.nodes.page.recovery import Recovery, Step
from tapping_cell.planning.prescribed import METHOD as PRESCRIBED
from tapping_cell.report.error_codes import hint
from tapping_cell.report.words import PHASES, counted, expected_effort
from tapping_cell.se2 import Pose

SILENCE_LIMIT_S = 1.5
LOG_LENGTH = 200
ONE_STOP_S = 3.0
"""Time within which the reports of a stop from page, devices and planner belong together."""
STOPS = (ErrorCode.ARM_STOPPED, ErrorCode.TAPPER_STOPPED, ErrorCode.EMERGENCY_STOP)
OUTCOMES = {TapperState.FIRED: "fired", TapperState.NOT_FIRED: "not fired"}

ARM_TEXTS = {
    ArmState.DISCONNECTED: "not connected",
    ArmState.NOT_HOMED: "not homed",
    ArmState.HOMING: "homing",
    ArmState.IDLE: "idle",
    ArmState.MOVING: "moving",
    ArmState.IN_POSITION: "in position",
    ArmState.WITHDRAWING: "withdrawing",
    ArmState.FAULT: "fault",
    ArmState.STOPPED: "stopped",
}
TAPPER_TEXTS = {
    TapperState.DISCONNECTED: "not connected",
    TapperState.SAFE: "safe",
    TapperState.CHARGING: "charging",
    TapperState.CHARGED: "charged",
    TapperState.FIRING: "firing",
    TapperState.FAULT: "fault",
    TapperState.STOPPED: "stopped",
}
ARM_BUSY = (ArmState.HOMING, ArmState.MOVING, ArmState.IN_POSITION, ArmState.WITHDRAWING)
TAPPER_BUSY = (TapperState.CHARGING, TapperState.CHARGED, TapperState.FIRING)

Numbers = list["float | None"]
Topic = tuple[type, str, Callable[[Any], None]]
"""Type and name of a topic, and the function that processes its messages."""


def _now() -> Now:
    return Now(time.monotonic(), time.time_ns())


def triple(pose: Pose) -> Numbers:
    """Convert a pose or displacement to [mm, mm, degrees], with None for values that are not
    finite."""
    angle = math.remainder(pose.theta, math.tau) if math.isfinite(pose.theta) else math.nan
    return [shown(1e3 * pose.x), shown(1e3 * pose.y), shown(math.degrees(angle))]


def shown(value: float, digits: int = 2) -> float | None:
    """Round a number for the page; None if it is not finite."""
    return round(value, digits) if math.isfinite(value) else None


def error_pair(distance: float, rotation: float, digits: int = 2) -> Numbers:
    """Convert a distance and an angle to [mm, degrees], with None for values that are not
    finite."""
    return [shown(1e3 * distance, digits), shown(math.degrees(rotation), digits)]


def pose_text(pose: Pose) -> str:
    """Format a pose as text."""
    return f"x {1e3 * pose.x:.1f} mm, y {1e3 * pose.y:.1f} mm, {math.degrees(pose.theta):.1f} deg"


class Mode(NamedTuple):
    """Mode of the whole cell: stopped, fault, waiting for a person, moving, not ready, ready."""

    word: str
    sentence: str
    code: int = ErrorCode.NONE


@dataclass
class Halt:
    """The last stop in the log: its entry, time (s), text, and the goal that it ended."""

    entry: dict[str, object]
    at: float
    text: str
    ended: str = ""


def with_code(sentence: str, code: int) -> str:
    """Append the error code to a message; return the message unchanged if the code is 0."""
    return f"{sentence} ({code})" if code else sentence


class CellView:
    """Collect the topics that the page displays. Called only in the executor's thread."""

    def __init__(self) -> None:
        self._monitor = CellMonitor(SILENCE_LIMIT_S)
        self._plan: PlanState | None = None
        self._plan_received = -math.inf
        self._taps: list[dict[str, object]] = []
        self._own_goal: Pose | None = None
        self._report: GoalReport | None = None
        self._log: deque[dict[str, object]] = deque(maxlen=LOG_LENGTH)
        self._halt: Halt | None = None
        self._expected: int | None = None
        self._mode = ""
        self.recovery = Recovery()
        self.names: list[str] = []
        """Names of the objects in a cell that can arrange several."""
        self.emergency_stop = False
        self.held_by_page = False
        self.stops: dict[str, tuple[str, ...]] = {}
        """Causes of each actor's latched stop; empty if the actor is not stopped."""
        self.simulated = False

    @property
    def has_arm(self) -> bool:
        """Whether the cell has an arm, according to the last tapper state."""
        return self._monitor.has_arm

    def device_topics(self) -> list[Topic]:
        """Return the topics of camera_pose and of the devices, except for ``~/stop_state``."""
        return [
            (ObjectStates, "object_states", self._on_objects),
            (ArmState, "arm_state", self._on_arm),
            (TapperState, "tapper_state", self._on_tapper),
        ]

    def _on_objects(self, states: ObjectStates) -> None:
        self._monitor.on_objects(states, _now())

    def _on_arm(self, state: ArmState) -> None:
        self._monitor.on_arm(state, _now())

    def _on_tapper(self, state: TapperState) -> None:
        self._monitor.on_tapper(state, _now())

    def on_stop(self, actor: str, message: StopState) -> None:
        """Process ``stop_state`` of an actor."""
        self.stops[actor] = tuple(message.sources) if message.stopped else ()

    def forget(self) -> None:
        """Discard the received states when no page is open. The taps and the log are kept."""
        self._monitor = CellMonitor(SILENCE_LIMIT_S)
        self._mode = ""

    def note(self, text: str, kind: str = "", at: float | None = None) -> None:
        """Add a log entry. ``kind`` is "good", "bad" or empty, ``at`` is the time in s."""
        self._log.append({"time": round(at or time.time(), 1), "text": text, "kind": kind})

    def note_halt(
        self, text: str, *, pressed: bool = False, ended: str = "", at: float | None = None
    ) -> None:
        """Log a stop. Reports of one stop from several sources become one entry: the button that
        was ``pressed``, else the first report, and the goal that it ``ended``."""
        at = at or time.time()
        halt = self._halt
        if halt is None or not abs(at - halt.at) < ONE_STOP_S:
            self.note(text, "bad", at)
            halt = self._halt = Halt(self._log[-1], at, text)
        elif pressed:
            halt.text = text
        halt.ended = ended or halt.ended
        halt.entry["text"] = halt.text + (f"; the {halt.ended} ended" if halt.ended else "")

    def note_own_goal(self, goal: Pose, who: str, name: str = "") -> None:
        """Log that a page sends a goal."""
        self._own_goal = goal
        self.note(f"{self._goal_of(name)} {pose_text(goal)} sent from the page ({who})")

    def _goal_of(self, name: str) -> str:
        """Return "goal", with the name of its object in a cell that can arrange several."""
        return f"goal of {name}" if name and self.names else "goal"

    def on_plan(self, message: PlanState) -> None:
        """Process ``plan_state``: a new goal, a tap, an end."""
        before, self._plan = self._plan, message
        self._plan_received = time.monotonic()
        tap = message.last_tap
        if not tap.tap_id and message.state not in FINAL_STATES:
            self._taps.clear()
        elif tap.tap_id and all(tap.tap_id != row["tap_id"] for row in self._taps):
            if tap.number == 1:
                self._taps.clear()
            self._taps.append(tap_row(tap, from_message(message.goal.pose)))
        was_busy = before is not None and before.state not in (PlanState.IDLE, *FINAL_STATES)
        if self.busy and (before is None or not was_busy or before.goal != message.goal):
            goal = from_message(message.goal.pose)
            own, self._own_goal = self._own_goal, None
            if own is None or own.distance_to(goal) > 1e-6:
                self.note(f"{self._goal_of(message.object_id)} {pose_text(goal)}")
        planned = message.planned_tap
        if not self.busy:
            self._expected = None
        elif planned.tap_id and planned.expected_taps > 0.0:
            self._expected = planned.number - 1 + max(1, round(planned.expected_taps))

    def on_report(self, message: GoalReport) -> None:
        """Process ``goal_report``: the end of a goal, including a refused goal."""
        if message == self._report:
            return
        self._report = message
        sentence, kind = with_code(message.error_msg, message.error_code), "bad"
        goal = self._goal_of(message.object_id)
        if len({record.object_id for record in message.records}) > 1:
            goal = "arrangement"
        if message.refused:
            sentence = f"{goal} refused: {sentence}"
        elif not message.error_code:
            sentence, kind = f"{goal} reached after {counted(message.taps, 'tap')}", "good"
        elif message.error_code in STOPS:
            self.note_halt(sentence, ended=goal, at=seconds(message.header.stamp))
            return
        elif message.state == PlanState.CANCELED:
            kind = ""
        # The last report is sent again to every new subscriber, so the log entry has the report's
        # stamp.
        self.note(sentence, kind, seconds(message.header.stamp))

    def loses_goal(self, message: PlanState) -> bool:
        """Return whether a new state of the planner drops a goal without a report of its end, as
        after a crash. A prescribed tap ends without a report, too."""
        before = self._plan
        if before is None or before.planner == PRESCRIBED:
            return False
        return self.busy and message.state == PlanState.IDLE

    @property
    def busy(self) -> bool:
        """Whether a goal is active."""
        plan = self._plan
        return plan is not None and plan.state not in (PlanState.IDLE, *FINAL_STATES)

    def mode(self) -> Mode:
        """Return the mode of the whole cell with a message and, if there is an error code, this
        code."""
        arm, tapper = self._monitor.arm, self._monitor.tapper
        # The text after the semicolon recommends ROS services; the page shows its own recovery
        # steps instead.
        stopped = [
            state.error_msg.partition(";")[0]
            for state, value in ((arm, ArmState.STOPPED), (tapper, TapperState.STOPPED))
            if state is not None and state.state == value
        ]
        if stopped:
            return Mode("stopped", "; ".join(dict.fromkeys(stopped)), ErrorCode.EMERGENCY_STOP)
        if self.emergency_stop and self._monitor.is_disconnected(_now()):
            devices = "the arm or the tapper" if self.has_arm else "the tapper"
            sentence = f"the emergency stop is pressed, and {devices} does not respond"
            return Mode("stopped", sentence, ErrorCode.EMERGENCY_STOP)
        fault = self._monitor.fault()
        if fault is not None:
            return Mode("fault", fault[1], fault[0])
        silence = time.monotonic() - self._plan_received
        planner_silent = self._plan is None or silence > 2 * SILENCE_LIMIT_S
        if self.busy and not planner_silent:
            assert self._plan is not None
            if self._plan.state == PlanState.CONFIRMING:
                return Mode("waiting", f"{self._tap_words()} waits for your confirmation")
            missing = self._monitor.why_not_ready(_now())
            if self._plan.state == PlanState.WAITING_FOR_CELL and missing is not None:
                return Mode("not ready", f"the goal waits: {missing[1]}", missing[0])
            return Mode("moving", f"{self._tap_words()}: {PHASES[self._plan.state]}")
        if arm is not None and arm.state in ARM_BUSY and not self._monitor.silent("arm", _now()):
            return Mode("moving", f"the arm is {ARM_TEXTS[arm.state]}")
        if tapper is not None and tapper.state in TAPPER_BUSY:
            return Mode("moving", f"the tapper is {TAPPER_TEXTS[tapper.state]}")
        missing = self._monitor.why_not_ready(_now())
        if missing is not None:
            return Mode("not ready", missing[1], missing[0])
        seen = self._monitor.object
        if seen is not None and seen.error_code:
            return Mode("not ready", seen.error_msg, seen.error_code)
        if planner_silent:
            return Mode("not ready", "the planner sends no messages; start tap_planner")
        return Mode("ready", "the cell accepts goals")

    def _tap_words(self) -> str:
        """Name the present tap, as in "disk 3, tap 2 of about 3"."""
        assert self._plan is not None
        number = self._plan.planned_tap.number or self._plan.taps + 1
        whose = f"{self._plan.object_id}, " if self.names and self._plan.object_id else ""
        about = "" if self._expected is None else f" of about {max(number, self._expected)}"
        return f"{whose}tap {number}{about}"

    def state(self) -> dict[str, object]:
        """Return the current state of the cell, as the page displays it."""
        mode = self.mode()
        sentence = with_code(mode.sentence, mode.code)
        if mode.word != self._mode:
            if mode.word == "stopped":
                self.note_halt(sentence)
            elif mode.word == "fault" and mode.code not in STOPS:  # a stop that is being cleared
                self.note(sentence, "bad")
            self._mode = mode.word
        return {
            "mode": mode.word,
            "sentence": sentence,
            "code": int(mode.code),
            "hint": hint(mode.code),
            "recovery": [step._asdict() for step in self._recovery_steps()],
            "blocked": self._blocked(mode),
            "set_up": self._set_up_state(),
            "object": self._object_state(),
            "plan": self._plan_state(),
            "taps": self._taps,
            "arm": self._arm_state() if self.has_arm else None,
            "tapper": self._device("tapper", TAPPER_TEXTS),
            "log": list(self._log),
        }

    def _recent(self, who: str) -> Any:
        """Return the last state of the arm, tapper or object; None if it is silent."""
        state = getattr(self._monitor, who)
        return None if state is None or self._monitor.silent(who, _now()) else state

    def _recovery_steps(self) -> list[Step]:
        holders = sorted({source for sources in self.stops.values() for source in sources})
        if self.held_by_page:  # the devices report it as the topic, too
            holders = ["this page's STOP", *(each for each in holders if each != TOPIC)]
        arm, tapper = self._recent("arm"), self._recent("tapper")
        return self.recovery.steps(
            arm, tapper, holders, self.simulated, self.has_arm, time.monotonic()
        )

    def _blocked(self, mode: Mode) -> str:
        """Return the reason why no goal can be sent now, or an empty text."""
        arm = self._recent("arm")
        if mode.word in ("stopped", "fault"):
            what = "is stopped" if mode.word == "stopped" else "has a fault"
            return f"No goal can be sent: the cell {what}."
        if arm is not None and not arm.homed:
            return "No goal can be sent: the arm is not homed."
        return ""

    def _set_up_state(self) -> dict[str, object]:
        """Return whether the cell is in set-up mode, whether an enabling device is held, and why
        the arm cannot be jogged (None: it can, or the cell has no arm)."""
        arm, tapper = self._monitor.arm, self._monitor.tapper
        on = (arm is not None and arm.set_up) or (tapper is not None and tapper.set_up)
        enabled = arm is not None and arm.enabled
        return {"on": on, "enabled": enabled, "jog_blocked": self._jog_blocked()}

    def _jog_blocked(self) -> str | None:
        """Return why the page does not offer to jog the arm; None if it does."""
        arm = self._recent("arm")
        if arm is None or arm.state in (ArmState.STOPPED, ArmState.FAULT, ArmState.DISCONNECTED):
            return "The arm is not ready."
        if not arm.homed:
            return "The arm is not homed."
        if self.busy:
            return "A goal or a single tap is under way."
        if not arm.enabled:
            return "Hold the key first."
        return None

    def _object_state(self) -> dict[str, object]:
        seen = self._recent("object")
        if seen is None:
            return {
                "visible": False,
                "sentence": "camera_pose sends no messages; start it",
                "code": 303,
            }
        answer: dict[str, object] = {
            "visible": seen.visible,
            "at_rest": seen.at_rest,
            "sentence": seen.error_msg,
            "code": seen.error_code,
        }
        if seen.visible:
            answer["pose"] = triple(from_message(seen.pose.pose))
        return answer

    def _plan_state(self) -> dict[str, object]:
        plan = self._plan
        if plan is None:
            return {
                "state": "",
                "busy": False,
                "object": "",
                "goal": None,
                "taps": 0,
                "code": 0,
                "sentence": "",
                "ask": False,
                "planned": None,
            }
        distance, rotation = error_pair(plan.residual_distance, plan.residual_rotation)
        has_goal = plan.state != PlanState.IDLE and bool(plan.goal.header.frame_id)
        return {
            "state": PHASES[plan.state],
            "busy": self.busy,
            "object": plan.object_id,
            "goal": triple(from_message(plan.goal.pose)) if has_goal else None,
            "distance": distance,
            "rotation": rotation,
            "tolerance": error_pair(plan.position_tolerance, plan.angle_tolerance),
            "taps": plan.taps,
            "code": plan.error_code,
            "sentence": plan.error_msg,
            "ask": plan.ask,
            "planned": planned_row(plan),
        }

    @property
    def planned(self) -> PlannedTap | None:
        """Tap that is planned or in progress; None if there is none."""
        tap = self._plan.planned_tap if self._plan is not None else None
        return tap if tap is not None and tap.tap_id else None

    @property
    def planned_object(self) -> str:
        """Name of the object that the planner moves; empty if unknown."""
        return "" if self._plan is None else str(self._plan.object_id)

    @property
    def blocked(self) -> str:
        """Reason why no goal can be sent now, or an empty text."""
        return self._blocked(self.mode())

    def _arm_state(self) -> dict[str, object]:
        """Return the state of the arm, and its tip as x, y, z (mm) and yaw (degrees) if known."""
        arm = self._monitor.arm
        tip = None
        if arm is not None and arm.homed:
            x, y, yaw = triple(from_message(arm.tip_pose))
            tip = [x, y, shown(1e3 * arm.tip_pose.position.z), yaw]
        return {**self._device("arm", ARM_TEXTS), "tip": tip}

    def _device(self, who: str, texts: dict[int, str]) -> dict[str, object]:
        state = self._recent(who)
        if state is None:
            return {"state": "silent", "sentence": "", "code": 0}
        sentence, code = state.error_msg, state.error_code
        return {"state": texts[state.state], "sentence": sentence, "code": code}


def planned_row(plan: PlanState) -> dict[str, object] | None:
    """Return the planned tap in mm and degrees, and whether it waits for confirmation; None if no
    tap is planned."""
    tap = plan.planned_tap
    if not tap.tap_id:
        return None
    before, after = from_message(tap.object_pose), from_message(tap.predicted_pose.pose)
    covariance = covariance_from_message(tap.predicted_pose.covariance)
    position, angle = float(covariance[0, 0] + covariance[1, 1]), float(covariance[2, 2])
    distance, turn = error_pair(before.distance_to(after), before.rotation_to(after), 1)
    deviations = math.sqrt(max(position, 0.0)), math.sqrt(max(angle, 0.0))
    deviation, turn_deviation = error_pair(*deviations, 1)
    goal = from_message(plan.goal.pose)
    left = seconds(tap.answer_by) - time.time()
    return {
        "tap_id": tap.tap_id,
        "number": tap.number,
        "waiting": plan.state == PlanState.CONFIRMING,
        "speed": shown(1e3 * tap.striker_speed, 0),
        "to": triple(after),
        "distance": distance,
        "deviation": deviation,
        "turn": turn,
        "turn_deviation": turn_deviation,
        "remaining": error_pair(after.distance_to(goal), after.rotation_to(goal), 1),
        "expected": expected_effort(tap.expected_taps, tap.expected_seconds),
        "reason": tap.reason,
        "seconds_left": max(0, round(left)) if plan.state == PlanState.CONFIRMING else None,
    }


def tap_row(tap: TapRecord, goal: Pose) -> dict[str, object]:
    """Return one tap: displacements in mm and degrees, in table axes, and the distances and angles
    to the goal before and after the tap."""
    before, predicted = from_message(tap.object_pose), from_message(tap.predicted_pose)
    measured = from_message(tap.measured_pose.pose)
    seen = math.isfinite(measured.x)
    after = error_pair(measured.distance_to(goal), measured.rotation_to(goal)) if seen else None
    return {
        "tap_id": tap.tap_id,
        "object": tap.object_id,
        "number": tap.number,
        "method": tap.planner,
        "commanded": triple(Pose(tap.dx, tap.dy, tap.dtheta)),
        "predicted": triple(displacement(before, predicted)),
        "measured": triple(displacement(before, measured)) if seen else [None, None, None],
        "before": error_pair(before.distance_to(goal), before.rotation_to(goal)),
        "remaining": after or [None, None],
        "speed": shown(1e3 * tap.striker_speed, 0),
        "outcome": OUTCOMES.get(tap.outcome, "outcome unknown"),
    }


def displacement(before: Pose, after: Pose) -> Pose:
    """Return the displacement between two poses, in table axes."""
    return Pose(after.x - before.x, after.y - before.y, before.rotation_to(after))
