"""Bags of artificial runs, with the messages that the cell's nodes would publish."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed; it has no Debian package")

from rosbags.interfaces import Nodetype

from tapping_cell.report.bag import BagWriter
from tapping_cell.report.message_types import MessageTypes
from tapping_cell.report.run_reader import NOTES, PICTURES
from tapping_cell.se2 import Pose

GOAL = Pose(0.03, 0.01, 0.4)
BEGAN = 1_700_000_000.0
TYPES = MessageTypes()
OURS = "tapping_cell_msgs/msg/"
KINDS = {
    NOTES: "std_msgs/msg/String",
    PICTURES: "sensor_msgs/msg/CompressedImage",
    "arm_state": OURS + "ArmState",
    "goal_report": OURS + "GoalReport",
    "ground_truth": "geometry_msgs/msg/PoseStamped",
    "object_state": OURS + "ObjectState",
    "object_states": OURS + "ObjectStates",
    "plan_state": OURS + "PlanState",
    "tap_command": OURS + "TapCommand",
}


def blank(kind: str) -> Any:
    """Return a message with all fields zero."""
    store = TYPES._store_with(kind)
    values = {}
    for name, (node, content) in store.fielddefs[kind][1]:
        if node == Nodetype.NAME:
            values[name] = blank(content)
        elif node == Nodetype.BASE:
            values[name] = "" if content[0] == "string" else (False if content[0] == "bool" else 0)
        else:
            (element, inner), size = content
            plain = element == Nodetype.BASE and inner[0] != "string"
            values[name] = np.zeros(size or 0, dtype=inner[0]) if plain else []
    return store.types[kind](**values)


def set_stamp(stamp: Any, at: float) -> None:
    stamp.sec = int(BEGAN + at)
    stamp.nanosec = round(1e9 * (BEGAN + at - stamp.sec))


def set_pose(message: Any, pose: Pose) -> None:
    message.position.x, message.position.y = pose.x, pose.y
    message.orientation.z = math.sin(pose.theta / 2)
    message.orientation.w = math.cos(pose.theta / 2)


@dataclass
class MadeRun:
    """An artificial run: ``stops`` are the poses at which the object rests, the first one before
    any tap."""

    stops: list[Pose]
    goal: Pose = GOAL
    state: int = 7
    code: int = 0
    sentence: str = ""
    refused: bool = False
    end_reported: bool = True
    truth_off: float = 0.0001
    truth: bool = True
    namespace: str = ""
    old_topic: bool = False
    """Whether the object's states are on the topic of version 0.1."""
    seen_before: bool = True
    """Whether the recorder received an observation before the first tap."""
    errors: list[tuple[float, int, str]] = field(default_factory=list)
    tolerance: tuple[float, float] = (0.001, math.radians(1.0))

    def write(self, folder: Path) -> Path:
        """Write the bag into a new run folder."""
        self.bag = BagWriter(folder / "bag", TYPES)
        for name, kind in KINDS.items():
            self.bag.add_topic(f"{self.namespace}/{name}", kind)
        angles = np.linspace(0, 2 * math.pi, 36, endpoint=False)
        notes = {
            "began": BEGAN,
            "refused": self.refused,
            "seed": 5,
            "versions": {"tapping_cell": "0.1"},
            "object": "made disk",
            "outline": [[0.048 * math.cos(a), 0.048 * math.sin(a)] for a in angles],
            "table_size": [0.6, 0.44],
            "files": {"/cells/cell.yaml": "name: <made> & cell\n"},
        }
        text = blank(KINDS[NOTES])
        text.data = json.dumps(notes)
        self.write_message(NOTES, -2.0, text)
        if self.seen_before:
            self.see(self.stops[0], -1.0)
        records = []
        if not self.refused:
            self.plan(0.0, 1, [])
            for index, (before, after) in enumerate(
                zip(self.stops, self.stops[1:], strict=False), start=1
            ):
                records.append(self.tap(index, before, after))
        for at, code, sentence in self.errors:
            arm = blank(KINDS["arm_state"])
            set_stamp(arm.header.stamp, at)
            arm.error_code, arm.error_msg = code, sentence
            self.write_message("arm_state", at, arm)
        end = 10.0 * len(records) + 1.0
        self.see(self.stops[-1], end - 0.1)
        if self.end_reported:
            if not self.refused:
                self.plan(end, self.state, records)
            self.write_message("goal_report", end, self.report(end, records))
        self.bag.close()
        return folder

    def write_message(self, name: str, at: float, message: Any) -> None:
        data = TYPES._store_with(KINDS[name]).serialize_cdr(message, KINDS[name])
        self.bag.write(f"{self.namespace}/{name}", round(1e9 * (BEGAN + at)), bytes(data))

    def see(self, pose: Pose, at: float) -> None:
        seen = blank(KINDS["object_state"])
        set_stamp(seen.header.stamp, at)
        seen.visible = seen.at_rest = True
        set_pose(seen.pose.pose, pose)
        if self.old_topic:
            self.write_message("object_state", at, seen)
        else:
            states = blank(KINDS["object_states"])
            states.header, states.objects = seen.header, [seen]
            self.write_message("object_states", at, states)
        if self.truth:
            true = blank(KINDS["ground_truth"])
            set_stamp(true.header.stamp, at + 0.01)
            set_pose(true.pose, Pose(pose.x + self.truth_off, pose.y, pose.theta))
            self.write_message("ground_truth", at, true)
        picture = blank(KINDS[PICTURES])
        set_stamp(picture.header.stamp, at)
        image = np.full((768, 960, 3), 90, dtype=np.uint8)
        cv2.circle(
            image, (480 + round(1000 * pose.x), 384 - round(1000 * pose.y)), 80, (200,) * 3, -1
        )
        picture.format, picture.data = "jpeg", cv2.imencode(".jpg", image)[1].reshape(-1)
        self.write_message(PICTURES, at, picture)

    def plan(self, at: float, state: int, records: list[Any]) -> None:
        plan = blank(KINDS["plan_state"])
        set_stamp(plan.header.stamp, at)
        plan.state, plan.planner, plan.taps = state, "optimal", len(records)
        plan.goal.header.frame_id = "table"
        set_pose(plan.goal.pose, self.goal)
        plan.position_tolerance, plan.angle_tolerance = self.tolerance
        if records:
            plan.last_tap = records[-1]
        if state > 6:
            plan.error_code, plan.error_msg = self.code, self.sentence
        self.write_message("plan_state", at, plan)

    def tap(self, number: int, before: Pose, after: Pose) -> Any:
        at = 10.0 * (number - 1)
        command = blank(KINDS["tap_command"])
        set_stamp(command.header.stamp, at + 2.0)
        command.tap_id = 100 + number
        self.write_message("tap_command", at + 2.0, command)
        for offset, state in ((1.0, 2), (2.0, 4), (4.0, 5), (5.0, 6), (7.0, 2)):
            self.plan(at + offset, state, [])
        record = blank(OURS + "TapRecord")
        record.tap_id, record.number, record.planner = 100 + number, number, "optimal"
        set_pose(record.object_pose, before)
        record.dx, record.dy = after.x - before.x, after.y - before.y
        record.dtheta = before.rotation_to(after)
        set_pose(
            record.predicted_pose, Pose(after.x + 0.0012, after.y - 0.0005, after.theta + 0.05)
        )
        set_pose(record.measured_pose.pose, after)
        record.striker_speed, record.measured_speed, record.outcome = 0.25, math.nan, 1
        along = math.atan2(record.dy, record.dx)
        back = Pose(before.x - 0.07 * math.cos(along), before.y - 0.07 * math.sin(along), along)
        set_pose(record.strike_pose, back)
        record.learnt.distance, record.learnt.distance_deviation = 1.25, 0.04
        record.learnt.direction = math.radians(2.0)
        record.predicted_covariance = np.diag([4e-6, 1e-6, 4e-4]).reshape(-1)
        record.reason = "a detour, with a comma"
        for offset, arm_state, height in (
            (2.0, 4, 0.05),
            (3.2, 4, 0.01),
            (4.0, 5, 0.01),
            (5.6, 6, 0.01),
            (6.5, 3, 0.05),
        ):
            arm = blank(KINDS["arm_state"])
            set_stamp(arm.header.stamp, at + offset)
            arm.state, arm.tip_pose.position.z = arm_state, height
            self.write_message("arm_state", at + offset, arm)
        set_stamp(record.fired_at, at + 4.5)
        set_stamp(record.at_rest_at, at + 5.5)
        self.see(after, at + 5.5)
        self.plan(at + 8.0, 2, [record])
        return record

    def report(self, at: float, records: list[Any]) -> Any:
        report = blank(KINDS["goal_report"])
        set_stamp(report.header.stamp, at)
        report.refused, report.state = self.refused, self.state
        report.goal.header.frame_id = "table"
        set_pose(report.goal.pose, self.goal)
        report.position_tolerance, report.angle_tolerance = self.tolerance
        report.planner, report.taps, report.records = "optimal", len(records), records
        report.error_code, report.error_msg = self.code, self.sentence
        return report


STOPS = [Pose(-0.04, 0.02, 0.35), Pose(0.01, 0.012, 0.2), Pose(0.0305, 0.0103, 0.405)]
