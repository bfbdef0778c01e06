"""The recorder writes one folder for each goal, or reports why it cannot."""

from __future__ import annotations

import errno
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from harness import Bench, bench
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header, String
from tapping_cell_msgs.msg import (
    ArmState,
    ArrangementState,
    ErrorCode,
    GoalReport,
    ObjectContact,
    ObjectProgress,
    ObjectState,
    ObjectStates,
    PlanState,
    TapRecord,
)

from tapping_cell.nodes.camera import images
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.conversions import to_message
from tapping_cell.nodes.page.runs import Runs
from tapping_cell.nodes.recorder import run_recorder
from tapping_cell.nodes.recorder.recording import CannotRecord, Recording
from tapping_cell.nodes.recorder.retention import REFUSALS
from tapping_cell.nodes.recorder.run_recorder import RunRecorder
from tapping_cell.report.bag import read_bag
from tapping_cell.report.recorded import BagError
from tapping_cell.report.run import Run
from tapping_cell.report.run_folder import read_run
from tapping_cell.report.run_reader import read_illustrated_run
from tapping_cell.se2 import Pose

START, GOAL = Pose(0.0, 0.0, 0.0), Pose(0.02, 0.0, 0.1)


class FakeCell:
    """Publishes the messages of planner, camera and arm."""

    def __init__(self, made: Bench, plan: str = "plan_state") -> None:
        self.bench = made
        node = made.probe
        assert node is not None
        self.node = node
        self.plans = node.create_publisher(PlanState, plan, LATCHED)
        self.reports = node.create_publisher(GoalReport, "goal_report", LATCHED)
        self.objects = node.create_publisher(ObjectStates, "object_states", LATCHED)
        self.truths = node.create_publisher(PoseStamped, "ground_truth", 10)
        self.arms = node.create_publisher(ArmState, "arm_state", LATCHED)
        self.pictures = node.create_publisher(
            CompressedImage, images.ANNOTATED_COMPRESSED, images.COMPRESSED_PICTURES
        )
        self.runs = made.listen(String, "last_run", LATCHED)
        self.diagnostics = made.listen(DiagnosticArray, "/diagnostics")
        listened = (self.plans, self.reports, self.objects, self.truths, self.pictures)
        made.wait(
            lambda: all(topic.get_subscription_count() == 1 for topic in listened),
            "the recorder listens",
        )
        made.wait(lambda: self.health()[1] not in ("", "not configured"), "the recorder is active")

    def health(self) -> tuple[bytes, str]:
        """Return the level and the message of the recorder's last diagnostics."""
        for message in reversed(self.diagnostics):
            for status in message.status:
                if status.name in ("/run_recorder", "/notes"):
                    return status.level, status.message
        return DiagnosticStatus.STALE, ""

    def stamp(self, message: Any) -> Any:
        """Return the message with the current time as its stamp."""
        message.header.stamp = self.node.get_clock().now().to_msg()
        message.header.frame_id = "table"
        return message

    def see(self, pose: Pose) -> None:
        seen = self.stamp(ObjectState(visible=True, at_rest=True))
        seen.pose.pose = to_message(pose)
        self.objects.publish(ObjectStates(header=seen.header, objects=[seen]))
        self.truths.publish(PoseStamped(header=seen.header, pose=to_message(pose)))

    def goal(self, pose: Pose = GOAL) -> PoseStamped:
        return self.stamp(PoseStamped(pose=to_message(pose)))

    def plan(self, goal: PoseStamped, state: int, planner: str = "optimal", taps: int = 0) -> None:
        plan = PlanState(state=state, goal=goal, planner=planner, taps=taps)
        plan.position_tolerance, plan.angle_tolerance = 0.001, 0.02
        self.plans.publish(self.stamp(plan))

    def report(self, goal: PoseStamped, state: int = PlanState.REACHED, **values: Any) -> None:
        report = GoalReport(state=state, goal=goal, planner="optimal", **values)
        report.position_tolerance, report.angle_tolerance = 0.001, 0.02
        self.reports.publish(self.stamp(report))

    def follow(self, goal: PoseStamped) -> None:
        """Publish a goal of one tap from beginning to end."""
        self.see(START)
        time.sleep(0.2)
        self.plan(goal, PlanState.LOOKING)
        time.sleep(0.3)
        self.plan(goal, PlanState.PLACING)
        grey = np.full((96, 128, 3), 80, dtype=np.uint8)
        self.pictures.publish(self.stamp(images.compress_colour(grey, 128, 85, Header())))
        record = TapRecord(tap_id=9, number=1, planner="optimal", object_pose=to_message(START))
        record.measured_pose.pose = to_message(GOAL)
        record.at_rest_at = self.node.get_clock().now().to_msg()
        self.see(GOAL)
        time.sleep(0.2)
        self.report(goal, taps=1, records=[record])
        self.plan(goal, PlanState.REACHED, taps=1)

    def recorded(self, number: int) -> list[Run]:
        """Return the runs as soon as there are ``number`` of them."""
        self.bench.wait(lambda: len(self.runs) >= number, f"{number} runs are recorded")
        return [read_run(Path(message.data)) for message in self.runs]


@contextmanager
def cell(tmp_path: Path, **parameters: object) -> Iterator[FakeCell]:
    values = {"folder": tmp_path / "runs", "pictures": False, "least_free": 0.0, **parameters}
    with bench(lambda: [RunRecorder()], {"run_recorder": values}) as made:
        yield FakeCell(made)


def is_written(runs: Path) -> bool:
    """Return whether a bag contains data. A recorder that is stopped while it still opens its bag
    may not have enough time to close it."""
    return any(file.stat().st_size > 0 for file in runs.glob("*/bag/*"))


def test_a_goal_produces_a_folder_whose_bag_begins_before_it(tmp_path: Path) -> None:
    with cell(tmp_path, seed=3, pictures=True) as fake:
        fake.arms.publish(fake.stamp(ArmState(state=ArmState.IDLE)))
        # Wait for longer than the time that is recorded before a goal. The bag must nevertheless
        # contain the latched messages.
        time.sleep(2.5)
        fake.follow(fake.goal())
        (run,) = fake.recorded(1)
        folder = Path(fake.runs[0].data)
    assert folder.parent == tmp_path / "runs" and folder.name.endswith("to_20_0_6")
    assert run.reached and run.seed == 3 and len(run.taps) == 1
    assert run.first.start == START and run.taps[0].true_pose is not None
    bag = read_bag(folder / "bag")
    assert bag.whole
    names = {topic.name for topic in bag.topics}
    assert {"/arm_state", "/goal_report", "/plan_state", "/object_states", "/run_notes"} <= names
    assert "/camera/image_annotated/compressed" in names
    first = next(stamp for stamp, _ in bag.of("plan_state"))
    assert min(stamp for stamp, _ in bag.of("object_states")) < first
    # The bag begins before the first state of the planner even for topics that the recorder
    # subscribes to only during a goal.
    assert min(stamp for stamp, _ in bag.of("ground_truth")) < first
    stamps = [message.stamp for message in bag.messages]
    assert stamps == sorted(stamps)
    assert (folder / "cell.png").stat().st_size > 10_000
    assert "Goal reached in 1 tap" in (folder / "report.html").read_text()
    assert "cell.yaml" in json.dumps(json.loads((folder / "summary.json").read_text())["files"])


def test_without_rosbags_a_run_has_everything_but_its_bag(tmp_path: Path, monkeypatch) -> None:
    runs = {}
    for bags in (True, False):
        if not bags:
            for module in ("bag", "message_types"):
                monkeypatch.setitem(sys.modules, f"tapping_cell.report.{module}", None)
        with cell(tmp_path / str(bags), seed=3, pictures=True) as fake:
            fake.arms.publish(fake.stamp(ArmState(state=ArmState.IDLE)))
            fake.follow(fake.goal())
            (runs[bags],) = fake.recorded(1)
            folder = Path(fake.runs[0].data)
        assert (folder / "bag").exists() == bags
        assert "Goal reached in 1 tap" in (folder / "report.html").read_text()
    assert runs[False].reached and len(runs[False].activities) == len(runs[True].activities) > 0
    for kept in ("objects", "seed", "files", "planner"):
        assert getattr(runs[False], kept) == getattr(runs[True], kept)
    (tap,), (other,) = runs[False].taps, runs[True].taps
    assert repr(replace(tap, at_rest_at=0.0)) == repr(
        replace(other, at_rest_at=0.0)
    )  # some are NaN
    with pytest.raises(BagError, match="rosbags is missing or damaged"):
        read_illustrated_run(folder / "bag")


PLACES = {"disk": (Pose(0.0, 0.0, 0.0), Pose(0.02, 0.0, 0.1)), "bar": (START, Pose(0.0, 0.1, 0.0))}


class FakeArrangement:
    """Publishes the messages of planner, camera and simulated world during an arrangement."""

    def __init__(self, fake: FakeCell) -> None:
        self.fake = fake
        create = fake.node.create_publisher
        self.progress = create(ArrangementState, "arrangement_state", LATCHED)
        self.states = create(ObjectStates, "object_states", LATCHED)
        self.truths = create(ObjectStates, "true_states", 10)
        self.contacts = create(ObjectContact, "true_contacts", 10)
        listened = (self.progress, self.states, self.truths, self.contacts)
        fake.bench.wait(
            lambda: all(topic.get_subscription_count() == 1 for topic in listened),
            "the recorder listens to the topics of several objects",
        )

    def see(self, **poses: Pose) -> None:
        message = self.fake.stamp(ObjectStates())
        for name, pose in poses.items():
            one = self.fake.stamp(ObjectState(object_id=name, visible=True, at_rest=True))
            one.pose.pose = to_message(pose)
            message.objects.append(one)
        self.states.publish(message)
        self.truths.publish(message)

    def report(self, active: bool, taps: int = 0, code: int = 0, **poses: Pose) -> None:
        state = self.fake.stamp(ArrangementState(active=active, taps=taps, error_code=code))
        for name, pose in poses.items():
            done = ObjectProgress.REACHED if not active and not code else ObjectProgress.ACTIVE
            one = ObjectProgress(object_id=name, state=done, has_goal=True, taps=1)
            one.goal_pose, one.pose.pose = to_message(PLACES[name][1]), to_message(pose)
            one.pose.covariance[0] = 1e-9
            state.objects.append(one)
        self.progress.publish(state)


def test_an_arrangement_is_one_run_with_its_objects_taps_and_contacts(tmp_path: Path) -> None:
    """Each move is a goal of the planner, but the arrangement is recorded in a single folder."""
    with cell(tmp_path, pictures=True) as fake:
        both = FakeArrangement(fake)
        starts = {name: start for name, (start, _) in PLACES.items()}
        goals = {name: goal for name, (_, goal) in PLACES.items()}
        both.see(**starts)
        time.sleep(0.2)
        both.report(True, **starts)
        fake.plan(fake.goal(goals["disk"]), PlanState.PLACING)
        records = []
        for number, (name, (start, goal)) in enumerate(PLACES.items(), start=1):
            plan = PlanState(state=PlanState.PLACING, goal=fake.goal(goal), planner="optimal")
            plan.planned_tap.tap_id = number
            plan.planned_tap.reason = f"'{name}' goes to its goal: its goal is free"
            fake.plans.publish(fake.stamp(plan))
            record = TapRecord(tap_id=number, number=number, object_id=name)
            record.object_pose = to_message(start)
            record.predicted_pose = record.measured_pose.pose = to_message(goal)
            record.at_rest_at = fake.node.get_clock().now().to_msg()
            records.append(record)
            time.sleep(0.2)
        both.contacts.publish(fake.stamp(ObjectContact(object_id="disk", other_id="bar")))
        both.see(**goals)
        time.sleep(0.2)
        # The last states of the planner are received together with the end of the arrangement.
        fake.plan(fake.goal(goals["bar"]), PlanState.PLANNING, taps=2)
        both.report(False, taps=2, **goals)
        fake.report(fake.goal(goals["bar"]), taps=2, records=records)
        fake.plan(fake.goal(goals["bar"]), PlanState.REACHED, taps=2)
        fake.bench.wait(lambda: len(fake.runs) >= 1, "the arrangement is recorded")
        folder = Path(fake.runs[0].data)
        # The next goal has its own folder again.
        fake.follow(fake.goal(Pose(0.03, 0.0, 0.0)))
        fake.bench.wait(lambda: len(fake.runs) >= 2, "the next goal is recorded")
    assert folder.name.endswith("arrange_2_objects")
    assert len(list((tmp_path / "runs").iterdir())) == 2
    run = read_run(folder)
    known = {one.name: one for one in run.objects}
    for name, (start, goal) in PLACES.items():
        one = known[name]
        assert one.start is not None and one.start.distance_to(start) < 1e-9
        assert one.goal is not None and one.goal.distance_to(goal) < 1e-9
        assert one.end is not None and one.end_true is not None and one.outcome == "reached"
        assert one.end.distance_to(goal) < 1e-9 and one.end_true.distance_to(goal) < 1e-9
    assert [(tap.object_name, tap.purpose) for tap in run.taps] == [
        (name, f"'{name}' goes to its goal: its goal is free") for name in PLACES
    ]
    assert run.contacts == (("disk", "bar"),) and run.error_code == 0
    assert "Arrangement reached: 2 objects, 2 taps" in (folder / "report.html").read_text()
    rows = {str(row["name"]): row for row in Runs(tmp_path / "runs").rows()}
    row = rows[folder.name]
    assert (row["objects"], row["taps"], row["outcome"], row["report"]) == (2, 2, "reached", True)
    (other,) = (row for name, row in rows.items() if name != folder.name)
    assert other["goal"] == [30.0, 0.0, 0.0]


def test_a_goal_after_an_arrangement_of_a_crashed_planner_has_its_own_folder(
    tmp_path: Path,
) -> None:
    with cell(tmp_path) as fake:
        both = FakeArrangement(fake)
        starts = {name: start for name, (start, _) in PLACES.items()}
        both.see(**starts)
        time.sleep(0.2)
        both.report(True, **starts)
        fake.plan(fake.goal(PLACES["disk"][1]), PlanState.PLACING)
        time.sleep(0.3)
        both.progress.publish(fake.stamp(ArrangementState()))  # the restarted planner
        fake.plan(fake.goal(), PlanState.IDLE)
        fake.bench.wait(lambda: len(fake.runs) >= 1, "the arrangement is recorded")
        fake.follow(fake.goal(Pose(0.03, 0.0, 0.0)))
        fake.bench.wait(lambda: len(fake.runs) >= 2, "the next goal is recorded")
        first, second = (Path(run.data) for run in fake.runs)
    run = read_run(first)
    assert run.error_code == ErrorCode.NOT_READY and "restarted" in run.error_msg
    assert second != first


def test_a_report_is_made_when_the_topics_are_remapped(tmp_path: Path) -> None:
    values = {"folder": tmp_path / "runs", "pictures": False, "least_free": 0.0}
    rules = ("notes:plan_state:=other/plan", "run_recorder:__node:=notes")
    with bench(lambda: [RunRecorder()], {"notes": values}, rules) as made:
        fake = FakeCell(made, plan="other/plan")
        fake.follow(fake.goal())
        (run,) = fake.recorded(1)
    assert run.reached and len(run.taps) == 1


def test_refused_replaced_and_lost_goals_are_reported_correctly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_recorder, "SILENCE_S", 5.0)
    with cell(tmp_path) as fake:
        off = fake.goal(Pose(0.9, 0.0, 0.0))
        for _ in range(3):  # a refusal that is published repeatedly makes only one entry
            fake.report(
                off,
                PlanState.FAILED,
                refused=True,
                error_code=ErrorCode.GOAL_OFF_TABLE,
                error_msg="off",
            )
            time.sleep(0.2)
        entries = tmp_path / "runs" / REFUSALS
        fake.bench.wait(entries.exists, "the refusal is listed")
        first, second = fake.goal(), fake.goal(Pose(-0.02, 0.0, 0.0))
        fake.plan(first, PlanState.PLACING)
        time.sleep(0.3)
        fake.report(
            first, PlanState.CANCELED, error_code=ErrorCode.GOAL_REPLACED, error_msg="newer"
        )
        fake.plan(second, PlanState.WAITING_FOR_CELL)
        runs = fake.recorded(2)  # the planner publishes nothing more about the second goal
    assert [run.outcome for run in runs] == ["canceled", "unfinished"]
    assert runs[0].error_code == ErrorCode.GOAL_REPLACED
    assert runs[1].error_code == ErrorCode.SHUTTING_DOWN
    (entry,) = [json.loads(line) for line in entries.read_text().splitlines()]
    assert entry["error_code"] == ErrorCode.GOAL_OFF_TABLE and entry["goal"]["x"] == 0.9


def test_a_refused_goal_has_a_folder_if_the_folder_was_named(tmp_path: Path) -> None:
    with cell(tmp_path, name="mine") as fake:
        off = fake.goal(Pose(0.9, 0.0, 0.0))
        code = ErrorCode.GOAL_OFF_TABLE
        fake.report(off, PlanState.FAILED, refused=True, error_code=code, error_msg="off")
        (run,) = fake.recorded(1)
    assert run.outcome == "refused" and run.error_code == code


def test_a_disk_that_is_nearly_full_is_a_warning_before_nothing_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)
    with cell(tmp_path, least_free=500.0) as fake:
        fake.bench.wait(lambda: fake.health()[0] == DiagnosticStatus.OK, "it is well")
        low = usage._replace(free=900_000_000)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: low)
        fake.bench.wait(lambda: fake.health()[0] == DiagnosticStatus.WARN, "it warns")
        assert "900 MB free; nothing is recorded below 500 MB" in fake.health()[1]
        fake.follow(fake.goal())
        assert fake.recorded(1)[0].reached


def test_stopping_the_recorder_writes_the_tables_of_the_active_goal(tmp_path: Path) -> None:
    with cell(tmp_path, pictures=True) as fake:
        fake.see(START)
        fake.plan(fake.goal(), PlanState.PLACING)
        fake.bench.wait(lambda: is_written(tmp_path / "runs"), "it records")
    (folder,) = (tmp_path / "runs").iterdir()
    assert read_run(folder).outcome == "unfinished"
    assert read_bag(folder / "bag").whole


def test_ctrl_c_during_a_goal_writes_the_tables_without_a_traceback(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tapping_cell.nodes.recorder.run_recorder", "--ros-args"]
    for value in (f"folder:={tmp_path / 'runs'}", "pictures:=false", "least_free:=0.0"):
        command += ["-p", value]
    with bench(lambda: [], {}) as made:
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            fake = FakeCell(made)
            fake.see(START)
            fake.plan(fake.goal(), PlanState.PLACING)
            fake.bench.wait(lambda: is_written(tmp_path / "runs"), "it records")
            process.send_signal(signal.SIGINT)
            _, output = process.communicate(timeout=120)
        finally:
            process.kill()
    assert process.returncode == 0 and "Traceback" not in output, output
    (folder,) = (tmp_path / "runs").iterdir()
    assert read_run(folder).outcome == "unfinished"
    assert read_bag(folder / "bag").whole


@pytest.mark.parametrize("cause", ["disk space", "write", "everything"])
def test_a_recording_that_cannot_continue_is_closed_and_gets_a_summary(
    cause: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def small(folder: Path, least_free: float) -> None:
        raise CannotRecord(f"the disk of {folder} is nearly full")

    with cell(tmp_path, pictures=True) as fake:
        fake.see(START)
        goal = fake.goal()
        fake.plan(goal, PlanState.PLACING)
        fake.bench.wait(lambda: is_written(tmp_path / "runs"), "it records")
        with monkeypatch.context() as patch:
            if cause == "disk space":
                patch.setattr(run_recorder, "check_disk_space", small)
            else:
                patch.setattr(Recording, "write", full)
            if cause == "everything":
                patch.setattr(Recording, "close", full)
                patch.setattr(Recording, "write_report", full)
            fake.bench.wait(lambda: fake.health()[0] == DiagnosticStatus.ERROR, "it says so")
        sentence = fake.health()[1]
        assert "was stopped: " in sentence
        assert ("nearly full" if cause == "disk space" else "No space left") in sentence
        fake.bench.wait(lambda: len(fake.runs) == 1, "the run is announced")
        folder = Path(fake.runs[0].data)
        if cause != "everything":
            assert read_bag(folder / "bag").whole
            assert read_run(folder).outcome == "unfinished"
            assert not (folder / "report.html").exists()
        # The rest of the goal is not recorded, but the next goal is.
        fake.report(goal, taps=0)
        fake.plan(goal, PlanState.REACHED)
        time.sleep(2.0)
        fake.follow(fake.goal())
        fake.bench.wait(lambda: len(fake.runs) == 2, "the next goal is recorded")
        fake.bench.wait(lambda: fake.health()[0] == DiagnosticStatus.OK, "it is well again")
    assert read_run(Path(fake.runs[1].data)).reached
    assert len(list((tmp_path / "runs").iterdir())) == 2


def test_the_diagnostics_name_the_folder_in_which_runs_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    with cell(tmp_path, folder="~/runs") as fake:
        (shown,) = {
            value.value
            for message in fake.diagnostics
            for status in message.status
            for value in status.values
            if value.key == "folder"
        }
        fake.follow(fake.goal())
        fake.recorded(1)
        assert shown == str(Path(fake.runs[0].data).parent) == str(tmp_path / "runs")


def test_single_taps_create_no_run_folder(tmp_path: Path) -> None:
    with cell(tmp_path) as fake:
        fake.plan(fake.goal(), PlanState.PLACING, planner="prescribed")
        time.sleep(1.0)
        fake.follow(fake.goal())
        assert len(fake.recorded(1)) == 1
    assert len(list((tmp_path / "runs").iterdir())) == 1


def test_a_run_name_is_never_used_twice(tmp_path: Path) -> None:
    with cell(tmp_path, name="mine") as fake:
        fake.follow(fake.goal())
        fake.recorded(1)
        fake.follow(fake.goal())
        names = [run.name for run in fake.recorded(2)]
    assert names == ["mine", "mine_2"]


def test_a_report_received_after_the_end_of_its_goal_starts_no_run(tmp_path: Path) -> None:
    with cell(tmp_path) as fake:
        goal = fake.goal()
        late = fake.stamp(PlanState(state=PlanState.LOOKING, goal=goal, planner="optimal"))
        time.sleep(0.1)
        fake.plan(goal, PlanState.LOOKING)
        time.sleep(0.3)
        fake.report(goal)
        time.sleep(0.3)
        fake.plans.publish(late)
        fake.recorded(1)
        fake.plans.publish(late)
        time.sleep(1.0)
    assert len(list((tmp_path / "runs").iterdir())) == 1


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"folder": "/proc/nowhere"}, "no run folder can be made"),
        ({"least_free": 1e7}, "move old runs to another disk"),
        ({"most_runs": 1, "folder": "FULL"}, "nothing is deleted"),
    ],
    ids=["folder", "room", "number"],
)
def test_a_recorder_that_cannot_write_reports_it_and_continues(
    parameters: dict[str, object], words: str, tmp_path: Path
) -> None:
    if parameters.get("folder") == "FULL":
        (tmp_path / "runs" / "old").mkdir(parents=True)
        summary = tmp_path / "runs" / "old" / "summary.json"
        summary.write_text('{"outcome": "reached", "began": 1.0}')
        parameters = {**parameters, "folder": tmp_path / "runs"}
    with cell(tmp_path, **parameters) as fake:
        fake.follow(fake.goal())
        fake.bench.wait(lambda: fake.health()[0] == DiagnosticStatus.ERROR, "it says so")
        sentence = fake.health()[1]
        assert sentence.startswith(f"({ErrorCode.RECORDING_FAILED})") and words in sentence
        assert fake.runs == []
    assert [p.name for p in (tmp_path / "runs").glob("*")] in ([], ["old"])


@pytest.mark.parametrize("topic", ["plans", "reports", "arrangements"])
def test_messages_of_another_version_are_reported_and_do_not_end_the_recorder(
    topic: str, tmp_path: Path
) -> None:
    """The middleware matches messages by the name of their type, regardless of its definition."""
    with cell(tmp_path) as fake:
        fake.arrangements = fake.node.create_publisher(
            ArrangementState, "arrangement_state", LATCHED
        )
        fake.bench.wait(lambda: fake.arrangements.get_subscription_count() == 1, "a third topic")
        publisher = getattr(fake, topic)
        # A message with fewer fields, as in an older version of the definition.
        publisher.publish(serialize_message(Header(frame_id="table")))
        fake.bench.wait(lambda: fake.health()[0] == DiagnosticStatus.WARN, "it says so")
        sentence = fake.health()[1]
        assert sentence.startswith(f"({ErrorCode.OTHER_VERSION})")
        assert publisher.topic_name in sentence and "\n" not in sentence
        goal = fake.goal()
        fake.follow(goal)
        (run,) = fake.recorded(1)
        assert run.reached and len(run.taps) == 1
