"""Recorder: writes a run folder with bag, tables, image and page for every goal and every
arrangement of several objects. This node moves nothing.

It writes in a separate thread. A write failure is published on /diagnostics, and the goal
continues. Messages of the last seconds are buffered, so that a bag starts before its goal.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, JointState
from std_msgs.msg import Bool, String
from tapping_cell_msgs.msg import (
    ArmState,
    ArrangementState,
    ErrorCode,
    GoalReport,
    ObjectContact,
    ObjectStates,
    PlanState,
    TapCommand,
    TapperState,
)
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from tapping_cell.configuration.schema import ConfigurationError, quantity, text
from tapping_cell.logic.goal_watch import FINAL_STATES
from tapping_cell.nodes import computer
from tapping_cell.nodes.camera import images
from tapping_cell.nodes.cell_node import LATCHED, CellNode, run
from tapping_cell.nodes.cell_parameters import ObjectParameters
from tapping_cell.nodes.conversions import from_message, seconds
from tapping_cell.nodes.own_joints import OwnJoints
from tapping_cell.nodes.polled_topics import PolledTopics
from tapping_cell.nodes.recorder.reception import MessageBuffer, MessageReader
from tapping_cell.nodes.recorder.recording import (
    MEGABYTE,
    CannotRecord,
    ReceivedMessage,
    RecordedTopic,
    Recording,
    arrangement_name,
    cell_notes,
    check_disk_space,
    is_own_goal,
    new_folder,
    run_name,
    same_goal,
)
from tapping_cell.nodes.recorder.retention import Retention, list_refusal
from tapping_cell.nodes.recorder.run_names import LONGEST_NAME, is_run_name
from tapping_cell.nodes.worker import Worker
from tapping_cell.report.recorded import NO_BAGS, BagError, Quality
from tapping_cell.report.run_reader import NOTES, PICTURES

if TYPE_CHECKING:
    from tapping_cell.report.message_types import MessageTypes

LEAD_S = 2.0
"""Time by which the start of a bag precedes its goal."""
TAIL_S = 1.0
"""Time from the end of a goal to the end of its bag. The bag thus contains the final
observation."""
SILENCE_S = 30.0
"""Time without a message of the planner after which the recording ends, even if the goal has not
ended."""
END_TIMEOUT_S = 4.0
WRITE_PERIOD_S = 0.5
POLL_PERIOD_S = 0.1
REPEATED_WITHIN_S = 10.0
"""Time within which a repeated refusal gets no folder of its own."""
WARNING_FACTOR = 2.0
"""Multiple of least_free below which the free disk space is a warning."""
RATE_SHARE = 0.8
"""Minimum interval between recorded images, as a share of the requested period. Intervals vary, and
a full period would drop images that are slightly early."""
USELESS_WAIT_S = 3600.0
"""Time without deletions for free space after deletions that freed none."""
LONGEST_PATH = 1024
DEPTH = 200
"""Queue depth of a topic between two polls. Images at 30 Hz fill it in 6.7 s."""

_STREAM = QoSProfile(
    depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE
)
_STATE = QoSProfile(
    depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)

STATES: dict[str, type] = {
    "arm_state": ArmState,
    "goal_report": GoalReport,
    "markers": MarkerArray,
    "object_states": ObjectStates,
    "plan_state": PlanState,
    "tapper_state": TapperState,
    "arrangement_state": ArrangementState,
}
"""Latched topics, in the order in which they are read. arrangement_state must be the last of these
topics: the planner publishes arrangement_state before the corresponding plan_state. Once a
plan_state has been read, the corresponding arrangement_state has therefore arrived too."""
STREAMS: dict[str, type] = {
    "/diagnostics": DiagnosticArray,
    "emergency_stop": Bool,
    "joint_states": JointState,
    "joint_trajectory": JointTrajectory,
    "tap_command": TapCommand,
    "true_contacts": ObjectContact,
}
"""Topics that are not latched. goal_pose is missing on purpose: ``ros2 topic pub --once`` publishes
as soon as one subscription is connected and then ends, so the planner must be the only subscriber.
plan_state and goal_report contain the goal."""
FRAMES: dict[str, type] = {
    "camera/camera_info": CameraInfo,
    "ground_truth": PoseStamped,
    "object_pose": PoseWithCovarianceStamped,
    "true_states": ObjectStates,
}
"""Topics with a message per image: read only while a goal is active."""


@dataclass(frozen=True, slots=True)
class Parameters(ObjectParameters):
    """Parameters of run_recorder."""

    folder: str = text("folder in which a subfolder is created for each run", default="runs")
    name: str = text("name of the run's folder; if empty, made from time and goal", default="")
    picture_rate: float = quantity(
        "maximum rate at which images of camera/image_annotated/compressed are recorded; 0 for "
        "none; the parameter compressed_rate of camera_pose limits it too",
        "Hz",
        0.0,
        10.0,
        default=1.0,
    )
    pictures: bool = text("draw cell.png and report.html at the end of a run", default=True)
    least_free: float = quantity(
        "free disk space below which nothing is recorded", "MB", 0.0, 1e7, default=500.0
    )
    most_runs: int = quantity(
        "maximum number of run folders, beyond which nothing is recorded, or with keep_free or "
        "keep_days the oldest runs are deleted",
        "",
        1,
        1_000_000,
        default=10_000,
    )
    keep_free: float = quantity(
        "share of the disk that is kept free by deleting the oldest runs; 0: nothing is deleted",
        "",
        0.0,
        0.9,
        default=0.0,
    )
    keep_days: float = quantity(
        "age from which runs are deleted; 0: nothing is deleted because of its age",
        "days",
        0.0,
        36_500.0,
        default=0.0,
    )
    seed: int = quantity(
        "random seed of the simulated world, stored in the run's summary; negative for none",
        "",
        -1,
        2**31 - 1,
        default=-1,
    )


def checked_folder(folder: str) -> str:
    """Check the parameter ``folder``. Raises ValueError with a message."""
    if not folder or not folder.isprintable() or len(folder) > LONGEST_PATH:
        raise ValueError(
            f"folder has {len(folder)} characters; give a path of 1 to {LONGEST_PATH} "
            "printable characters"
        )
    return folder


def refusal_entry(report: GoalReport) -> dict[str, object]:
    """Return the entry of a refused goal in the list: time in s, goal in m and rad, and reason."""
    pose = from_message(report.goal.pose)
    values = {"x": pose.x, "y": pose.y, "theta": pose.theta}
    return {
        "at": seconds(report.header.stamp),
        "frame": report.goal.header.frame_id,
        "goal": {key: value if isfinite(value) else None for key, value in values.items()},
        "error_code": report.error_code,
        "error_msg": report.error_msg,
    }


def checked_name(name: str) -> str:
    """Check the parameter ``name``. Raises ValueError with a message."""
    if name and not is_run_name(name):
        raise ValueError(
            f"name is '{name[:40]}' with {len(name)} characters; give at most {LONGEST_NAME} "
            "printable characters without / and without a dot at the beginning, or leave it empty"
        )
    return name


class RunRecorder(CellNode[Parameters]):
    """See the module's docstring.

    The executor's thread polls the topics and queues their messages; ``_worker`` writes them, and
    ``_reporter`` draws the report.
    """

    changeable = ("folder", "name", "picture_rate")

    def __init__(self) -> None:
        super().__init__("run_recorder", Parameters)
        self._notes: dict[str, Any] = {}
        self._buffer = MessageBuffer(LEAD_S)
        self._plan: PlanState | None = None
        """Goal that is being recorded; None if there is no recording."""
        self._ends_at: float | None = None
        self._end: PlanState | GoalReport | None = None
        self._arranging = False
        self._recording: Recording | None = None
        self._error = ""
        self._runs = 0
        self._refusal: tuple[int, str, float] = (0, "", 0.0)
        self._picture_at = 0
        self._planner_received = 0.0
        self._reader = MessageReader(self.get_logger().warning)
        self._polled = PolledTopics(self)
        self._joints = OwnJoints(())
        self._folder, self._name = self.settings.folder, self.settings.name
        self._picture_rate = self.settings.picture_rate
        self._retention = Retention(self.settings.most_runs)
        self._no_space_before = -inf
        """Monotonic time until which no run is deleted for free space."""
        self._worker: Worker | None = None
        self._reporter: Worker | None = None
        self._types: MessageTypes | None = None
        self._last_run = self.create_publisher(String, "last_run", LATCHED)
        self._topics: dict[str, RecordedTopic] = {}
        self._kinds: dict[str, type] = {}
        self._processed: dict[str, Callable[[Any], None]] = {
            "plan_state": self._on_plan_state,
            "goal_report": self._on_goal_report,
            "arrangement_state": self._on_arrangement_state,
        }
        for name, kind in STATES.items():
            self._subscribe(name, kind, Quality(1, latched=True), _STATE)
        for name, kind in STREAMS.items():
            self._subscribe(name, kind, Quality(), _STREAM)
        for name, kind in FRAMES.items():
            reliable = kind is not CameraInfo
            profile = _STREAM if reliable else images.PICTURES
            self._subscribe(name, kind, Quality(reliable=reliable), profile)
        self._subscribe(PICTURES, CompressedImage, Quality(), images.COMPRESSED_PICTURES)
        self._notes_topic = self._register(NOTES, String, Quality(1, latched=True))
        self.create_timer(POLL_PERIOD_S, self._tick)

    def _recorded_name(self, name: str) -> str:
        """Return a topic's name in the bag: with this namespace, but without remappings, so that
        the report finds the topic in every bag."""
        return self.resolve_topic_name(name, only_expand=True)

    def _subscribe(self, name: str, kind: type, quality: Quality, profile: QoSProfile) -> None:
        self._register(name, kind, quality)
        self._polled.add(kind, name, profile)

    def _register(self, name: str, kind: type, quality: Quality) -> str:
        """Register a topic of the bag, and return its name there."""
        recorded, package = self._recorded_name(name), kind.__module__.partition(".")[0]
        self._topics[recorded] = RecordedTopic(f"{package}/msg/{kind.__name__}", quality)
        self._kinds[recorded] = kind
        return recorded

    # Life cycle

    def configure(self) -> None:
        """Read the files that a run records, and start the worker."""
        try:
            self._folder = checked_folder(self.settings.folder)
            self._name = checked_name(self.settings.name)
        except ValueError as error:
            raise ConfigurationError(f"parameters of run_recorder: {error}") from error
        cell = self.settings.load_cell()
        self._joints = OwnJoints(cell.arm.joint_names if cell.file.arm is not None else ())
        self._notes = cell_notes(cell, self.settings.seed)
        self._worker = Worker("recorder", lambda: self._write(self._buffer.take()), WRITE_PERIOD_S)
        self._worker.start()
        settings = self.settings
        self._retention = Retention(settings.most_runs, settings.keep_free, settings.keep_days)
        self._reporter = Worker("teller")
        self._reporter.start()
        self._delete_later()
        try:
            from tapping_cell.report.message_types import MessageTypes
        except ModuleNotFoundError:
            self.get_logger().warning(f"runs are recorded without bags: {NO_BAGS}")
            return
        self._types = MessageTypes()
        for topic in self._topics.values():
            # The definition is loaded here in advance, so that it does not delay the first messages
            # of a goal.
            self._types.definition(topic.kind)

    def deactivate(self) -> None:
        """End the current recording."""
        self._conclude(pictures=False)

    def cleanup(self) -> None:
        """End the current recording without drawing, because the node may be killed after a short
        time."""
        if self._worker is not None:
            self._conclude(pictures=False)
            # Wait for the queued jobs, because closing discards them. The wait is short, because a
            # launcher kills a stopping node after 5 s.
            written = threading.Event()
            self._worker.submit(written.set)
            written.wait(END_TIMEOUT_S)
            for worker in (self._worker, self._reporter):
                if worker is not None:
                    worker.close(patience=0.2)
            self._worker = self._reporter = None

    def check(self, name: str, value: object) -> None:
        """Check folder and name."""
        if name == "folder":
            checked_folder(str(value))
        elif name == "name":
            checked_name(str(value))

    def change(self, name: str, value: object) -> None:
        """Change folder, name or rate for the next run."""
        if name == "picture_rate":
            self._picture_rate = float(str(value))
        elif name == "folder":
            self._folder = str(value)
        else:
            self._name = str(value)

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Report the current recording and any error that prevents it."""
        recording = self._recording
        values: dict[str, object] = {
            "folder": str(self._run_parent),
            "recording": recording.folder if recording is not None else "",
            "runs": self._runs,
            "error code": ErrorCode.RECORDING_FAILED if self._error else ErrorCode.NONE,
        }
        if self._worker is not None and self._worker.error is not None:
            return DiagnosticStatus.ERROR, f"a defect: {self._worker.error!r}", values
        if self._error:
            return DiagnosticStatus.ERROR, self._error, values
        if warning := self._reader.warning:
            values["error code"] = ErrorCode.OTHER_VERSION
            return DiagnosticStatus.WARN, warning, values
        least = MEGABYTE * self.settings.least_free
        if (degrees := computer.temperature()) is not None:
            values["temperature (degrees C)"] = degrees
        with contextlib.suppress(OSError):
            free, _ = computer.disk_space(self._run_parent)
            values["free disk space (MB)"] = free // MEGABYTE
            if free < WARNING_FACTOR * least:
                values["error code"] = ErrorCode.RECORDING_FAILED
                sentence = (
                    f"({ErrorCode.RECORDING_FAILED}) the disk of {self._run_parent} has only"
                    f" {free / MEGABYTE:.0f} MB free; nothing is recorded below"
                    f" {self.settings.least_free:.0f} MB, and goals continue: move old runs away"
                )
                return DiagnosticStatus.WARN, sentence, values
        return DiagnosticStatus.OK, "ok", values

    @property
    def _run_parent(self) -> Path:
        """Folder in which the folder of the next run is created."""
        return Path(os.path.abspath(os.path.expanduser(self._folder)))

    # Reception: the executor's thread

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _receive(self, names: Iterable[str]) -> None:
        """Process the waiting messages: arrangement_state first, then the others in the order of
        their reception."""
        now, clock = self._now(), time.time_ns()
        waiting = [
            (now - max(0, clock - received) if received else now, name, data)
            for name, data, received in self._polled.take(names)
        ]
        # At the beginning of an arrangement, plan_state can be assigned to the arrangement only if
        # arrangement_state is processed before plan_state.
        waiting.sort(key=lambda entry: -inf if entry[1] == "arrangement_state" else entry[0])
        for stamp, name, data in waiting:
            if name == PICTURES and not self._is_picture_due(stamp):
                continue
            if name == "joint_states" and not self._joints.may_be_in(data):
                continue
            received = ReceivedMessage(self._recorded_name(name), stamp, data)
            process = self._processed.get(name)
            if process is None:
                self._note(name, received)
            elif (message := self._read(received)) is not None:
                self._note(name, received)
                if self.active:
                    process(message)

    def _read(self, message: ReceivedMessage) -> Any | None:
        """Return the deserialised message; None if it is of another version."""
        return self._reader.read(message.topic, self._kinds[message.topic], message.data)

    def _is_picture_due(self, stamp: int) -> bool:
        rate = self._picture_rate
        due = rate > 0 and abs(stamp - self._picture_at) >= 1e9 * RATE_SHARE / rate
        if due:
            self._picture_at = stamp
        return due

    def _note(self, name: str, message: ReceivedMessage) -> None:
        seldom = name == "camera/camera_info"
        self._buffer.add(message, latched=name in STATES, seldom=seldom)

    def _on_plan_state(self, plan: PlanState) -> None:
        self._planner_received = time.monotonic()
        ending = self._ends_at is not None
        if (self._arranging and not ending) or self._is_late(plan):
            return
        known = self._plan is not None and not ending and same_goal(self._plan, plan)
        if is_own_goal(plan):
            if not known:
                self._conclude(pictures=True)
                self._begin(plan, refused=False)
        elif known and plan.state in FINAL_STATES:
            self._end_after(plan)

    def _on_arrangement_state(self, report: ArrangementState) -> None:
        """Begin or end the recording of an arrangement. Each move of an arrangement is a goal of
        the planner."""
        if self._arranging and self._ends_at is None:
            self._planner_received = time.monotonic()
            if not report.active:
                self._end_after(PlanState(header=report.header))
        elif report.active:
            self._conclude(pictures=True)
            self._begin(PlanState(header=report.header), refused=False, arrangement=report)

    def _end_after(self, end: PlanState) -> None:
        """End the recording soon, because its goal has ended."""
        self._end = end
        self._ends_at = time.monotonic() + TAIL_S

    def _is_late(self, plan: PlanState) -> bool:
        """Return whether a ``plan_state`` is older than the end of its goal, although this end has
        already been received. Such late messages occur because the order of messages of different
        topics is not guaranteed."""
        end = self._end
        if end is None or not (self._arranging or same_goal(plan, end)):
            return False
        return seconds(plan.header.stamp) <= seconds(end.header.stamp)

    def _on_goal_report(self, report: GoalReport) -> None:
        """End the recording of a goal that has ended, or list a goal that was refused. A refused
        goal has a run folder only if the parameter ``name`` asks for this folder."""
        if report.refused:
            if not self._is_new_refusal(report):
                return
            if not self._name:
                entry, folder = refusal_entry(report), self._run_parent
                self._submit(lambda: self._list(folder, entry))
            elif self._plan is None:
                self._begin(PlanState(header=report.header, goal=report.goal), refused=True)
                self._ends_at = time.monotonic()
            return
        self._end = report
        if self._plan is not None and not self._arranging and same_goal(self._plan, report):
            self._ends_at = time.monotonic() + TAIL_S

    def _is_new_refusal(self, report: GoalReport) -> bool:
        """Return whether a refusal is neither old nor a repetition of the last one, and remember
        it. The topic is latched, so the last report is sent again to every new subscriber."""
        code, sentence, at = self._refusal
        self._refusal = (report.error_code, report.error_msg, time.monotonic())
        if 1e-9 * self._now() - seconds(report.header.stamp) > LEAD_S:
            return False
        repeated = (code, sentence) == (report.error_code, report.error_msg)
        return not repeated or time.monotonic() - at >= REPEATED_WITHIN_S

    def _begin(
        self, plan: PlanState, refused: bool, arrangement: ArrangementState | None = None
    ) -> None:
        """Start a recording with the messages of the last seconds."""
        began = seconds(plan.header.stamp)
        self._arranging = arrangement is not None
        if arrangement is not None:
            name = self._name or arrangement_name(began, self.get_namespace(), arrangement)
        else:
            name = self._name or run_name(began, self.get_namespace(), plan.goal)
        this_run = {"began": began, "refused": refused, "arrangement": self._arranging}
        text = serialize_message(String(data=json.dumps(self._notes | this_run)))
        folder = self._run_parent
        # Messages that are taken from the buffer while no folder is open are lost, so the worker
        # opens the folder before the buffer contains messages to write.
        self._submit(lambda: self._open(folder, name))
        self._buffer.begin(self._now(), self._notes_topic, text)
        self._plan = plan
        self._ends_at = None
        self._planner_received = time.monotonic()

    def _tick(self) -> None:
        self._receive((*STATES, *STREAMS, PICTURES))
        if self._plan is not None:
            self._receive(FRAMES)
        now = time.monotonic()
        over = self._ends_at is not None and now >= self._ends_at
        if over or (self._plan is not None and now - self._planner_received > SILENCE_S):
            self._conclude(pictures=True)

    def _conclude(self, pictures: bool) -> None:
        """End the current recording, if any."""
        if self._plan is None:
            return
        self._plan = self._ends_at = None
        self._arranging = False
        rest = self._buffer.take(end=True)
        self._submit(lambda: self._close(rest, pictures and self.settings.pictures))

    def _submit(self, job: Callable[[], None]) -> None:
        if self._worker is not None:
            self._worker.submit(job)

    # Writing: the worker's thread

    def _list(self, folder: Path, entry: dict[str, object]) -> None:
        try:
            list_refusal(folder, entry)
        except OSError as error:
            self._report_failure(
                f"a refused goal could not be listed in {folder} ({error.strerror})"
            )

    def _delete_later(self) -> None:
        """Delete old runs in the thread of the reports, so that no messages of a goal wait."""
        if self._reporter is not None:
            self._reporter.submit(self._delete_old_runs)

    def _delete_old_runs(self) -> None:
        parent, rule = self._run_parent, self._retention
        if time.monotonic() < self._no_space_before:
            rule = replace(rule, free_share=0.0)
        try:
            done = rule.apply(parent)
        except OSError as error:
            self._report_failure(f"old runs in {parent} cannot be deleted ({error})")
            return
        if done.deleted:
            self.get_logger().info(f"deleted old runs: {', '.join(done.deleted)}")
        if done.useless:
            self._no_space_before = time.monotonic() + USELESS_WAIT_S
            self.get_logger().warning(
                f"deleting runs does not free the disk of {parent}; no run is deleted for its free "
                f"space for {USELESS_WAIT_S / 3600:.0f} h: find out which program fills it"
            )
        if done.failed:
            self._report_failure(f"in {parent} cannot be deleted: {', '.join(done.failed)}")

    def _open(self, folder: Path, name: str) -> None:
        try:
            least_free = MEGABYTE * self.settings.least_free
            prepared = bool(self._name)
            made = new_folder(folder, name, self.settings.most_runs, least_free, prepared)
            self._recording = Recording(made, self._topics, self._types)
        except CannotRecord as error:
            self._report_failure(str(error))
            self._delete_later()
            return
        self._error = ""
        self.get_logger().info(f"recording to {made}")

    def _write(self, messages: list[ReceivedMessage]) -> None:
        recording = self._recording
        if recording is None:
            return
        try:
            recording.write([one for one in messages if self._read(one) is not None])
            check_disk_space(recording.folder, MEGABYTE * self.settings.least_free / 2)
        except (OSError, CannotRecord) as error:
            self._recording = None
            self._finish(recording)
            self._announce(recording, pictures=False)
            # Reported last, because /diagnostics shows the last failure.
            self._report_failure(f"recording to {recording.folder} was stopped: {error}")
            self._delete_later()

    def _close(self, rest: list[ReceivedMessage], pictures: bool) -> None:
        self._write(rest)
        recording, self._recording = self._recording, None
        if recording is None:
            return
        self._finish(recording)
        if pictures and self._reporter is not None:
            self._reporter.submit(lambda: self._announce(recording, pictures=True))
        else:
            self._announce(recording, pictures=False)
        self._delete_later()

    def _finish(self, recording: Recording) -> None:
        """Close the bag and write the tables. The tables are written immediately, but drawing takes
        seconds, during which the next goal may start."""
        try:
            recording.close()
        except OSError as error:
            self._report_failure(f"the bag in {recording.folder} was not closed: {error}")
        self._write_report(recording, pictures=False)

    def _write_report(self, recording: Recording, pictures: bool) -> None:
        try:
            recording.write_report(pictures)
        except (OSError, BagError, ValueError) as error:
            self._report_failure(
                f"the summary of the run in {recording.folder} is incomplete: {error}"
            )

    def _announce(self, recording: Recording, pictures: bool) -> None:
        """Publish that a run folder is complete."""
        if pictures:
            self._write_report(recording, pictures=True)
        self._runs += 1
        try:
            self._last_run.publish(String(data=str(recording.folder)))
        except RuntimeError:
            # Ctrl-C has shut down the context, so nothing can be published, but the folder is
            # complete.
            if self.context.ok():
                raise
        self.get_logger().info(f"recorded {recording.folder}")

    def _report_failure(self, sentence: str) -> None:
        self._error = f"({ErrorCode.RECORDING_FAILED}) {sentence}"
        self.get_logger().error(self._error)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node with a slightly lower priority than the other nodes."""
    os.nice(5)
    return run(RunRecorder, arguments)


if __name__ == "__main__":
    sys.exit(main())
