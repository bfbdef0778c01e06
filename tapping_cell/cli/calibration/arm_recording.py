"""Recording for `calibrate arm` with the running cell: moves the arm and measures the held
marker."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from rich.console import Console

from tapping_cell.calibration.arm import RECORD_COLUMNS
from tapping_cell.calibration.arm_places import arm_places
from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.csv_table import read_csv
from tapping_cell.calibration.growing_csv import GrowingCsv
from tapping_cell.cli import session
from tapping_cell.cli.signals import end_on_signals
from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.scara import Joints
from tapping_cell.nodes.clients.arm_pose_client import ArmPoseClient, ArmRefused
from tapping_cell.nodes.conversions import from_message
from tapping_cell.se2 import Pose

HEADER = ("shoulder", "elbow", "tool", "x", "y", "theta")
SPEED = 0.6
"""Speed of the fastest joint, rad/s."""
SPARE = 2
"""Number of candidate postures per required pose. One candidate would not be enough, because in
some postures the marker is outside the image."""
BLIND = 6
"""Number of consecutive postures without a visible marker after which the recording is aborted."""
READY_TIMEOUT_S = 30.0
_SAME_TIP = 0.001
"""Maximum distance in m between the tip position computed with the given cell file and the tip
position reported by the running cell."""
_SAME = 0.03
"""A posture counts as already recorded if each joint is within this angle, in rad, of a recorded
posture."""


def record(arguments: argparse.Namespace, cell: Cell, console: Console) -> bool:
    """Record poses until the requested number is reached. Return False if interrupted.

    Raises:
        CalibrationRefused: the cell or the camera is unsuitable; the message states why.
        RecordError: the existing file cannot be continued.
    """
    own = cell.arm.ros2_control
    if own is not None and own.chain is not None:
        raise CalibrationRefused(
            "no poses are recorded for an arm with arm.ros2_control.chain, because its own driver "
            "calibrates its joints; measure only arm.base and arm.ros2_control.chain.tool, and "
            "write them into the cell file"
        )
    end_on_signals()
    growing = GrowingCsv(arguments.record, HEADER, arguments.resume)
    try:
        with ArmPoseClient(arguments.namespace, cell.arm.ros2_control) as client:
            session.wait_until_ready(client, READY_TIMEOUT_S, lambda: None, console)
            _visit(arguments, cell, client, growing, console)
    except KeyboardInterrupt:
        console.print("interrupted; continue with --resume")
        return False
    except (ArmRefused, session.NotReadyInTime) as error:
        raise CalibrationRefused(str(error)) from error
    return True


def _visit(
    arguments: argparse.Namespace,
    cell: Cell,
    client: ArmPoseClient,
    growing: GrowingCsv,
    console: Console,
) -> None:
    here = client.joints()
    assert here is not None
    corners = cell.references.corners().reshape(-1, 2)
    half = np.minimum(np.abs(corners).max(axis=0), [cell.file.table.length, cell.file.table.width])
    geometry = cell.arm.geometry()
    _check_same_arm(cell, client, here)
    places = arm_places(
        geometry,
        cell.arm_base,
        tuple((0.8 * half).tolist()),
        geometry.forward(here).z,
        SPARE * arguments.poses,
    )
    done = _recorded(growing, arguments.record)
    left = [joints for joints in places if not _among(joints, done)]
    number, blind = len(done), 0
    console.print(
        "the arm moves to postures above the table, with the tip at its current height, until "
        f"{arguments.poses - number} poses are recorded; Ctrl-C stops the arm after the current "
        "move"
    )
    for joints in left:
        if number >= arguments.poses:
            return
        seen = client.visit(joints, SPEED, lambda: None)
        if seen is None:
            blind += 1
            console.print("not recorded: the camera does not see the marker at rest in this pose")
            if blind >= BLIND:
                raise CalibrationRefused(
                    f"the camera did not see the marker at rest in {blind} consecutive postures; "
                    "check that the marker is uncovered and that camera_pose was started "
                    "with the object file of the marker on the arm"
                )
            continue
        blind = 0
        number += 1
        at = seen.pose
        growing.append((seen.joints.shoulder, seen.joints.elbow, seen.joints.tool, *at))
        console.print(
            f"pose {number} of {arguments.poses}: {session.pose_text(at)}", highlight=False
        )
    if number < arguments.poses:
        raise CalibrationRefused(
            f"the camera saw the marker in only {number} postures ({arguments.poses} requested); "
            "they are recorded: calibrate with them, or move the camera"
        )


def _check_same_arm(cell: Cell, client: ArmPoseClient, here: Joints) -> None:
    """Check that the tip position computed from the cell file agrees with the tip position that the
    running cell reports. With the file of another cell, the arm would move to wrong postures."""
    assert client.arm_state is not None
    tip = cell.arm.geometry().forward(here)
    computed = cell.arm_base @ Pose(tip.x, tip.y, tip.yaw)
    reported = from_message(client.arm_state.tip_pose)
    if computed.distance_to(reported) > _SAME_TIP:
        raise CalibrationRefused(
            f"the tip is at {session.pose_text(computed)} according to {cell.path}, but at "
            f"{session.pose_text(reported)} according to the running cell; give the running cell's "
            "own file with --cell"
        )


def _recorded(growing: GrowingCsv, path: Path) -> list[tuple[float, ...]]:
    """Return the positions of shoulder, elbow and tool (rad) for every recorded pose."""
    if not growing.rows:
        return []
    table = read_csv(path, RECORD_COLUMNS)
    return [tuple(row) for row in table.columns("shoulder", "elbow", "tool").tolist()]


def _among(joints: Joints, done: list[tuple[float, ...]]) -> bool:
    here = (joints.shoulder, joints.elbow, joints.tool)
    return any(
        max(abs(math.remainder(a - b, math.tau)) for a, b in zip(here, row, strict=True)) < _SAME
        for row in done
    )
