"""What the planner must know of camera and tapper before it plans a tap."""

from __future__ import annotations

import numpy as np
import pytest
from logic_parts import alone

from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.messages import ErrorCode, ObjectState, TapperState

LIMIT_S, T = 0.5, 100.0


def at(time: float) -> Now:
    return Now(time, round(1e9 * time))


def seen_at(exposed: float) -> ObjectState:
    state = ObjectState(object_id="disk", visible=True, at_rest=True, frames_fused=9)
    state.header.stamp = to_stamp(round(1e9 * exposed))
    covariance = np.zeros((6, 6))
    covariance[0, 0] = covariance[1, 1] = covariance[5, 5] = 1e-10
    state.pose.covariance = covariance.ravel().tolist()
    return state


@pytest.mark.parametrize(("age", "usable"), [(0.05, True), (0.45, True), (0.55, False)])
def test_a_tap_is_not_planned_on_an_image_that_arrives_late(age: float, usable: bool) -> None:
    monitor = CellMonitor(LIMIT_S)
    for step in range(20):  # the camera's clock is known from images without delay
        monitor.on_objects(alone(seen_at(T + 0.1 * step)), at(T + 0.1 * step))
    now = T + 2.0 + age
    monitor.on_objects(alone(seen_at(T + 2.0)), at(now))
    assert monitor.usable(after=T, frames=5, now=at(now)) is usable


@pytest.mark.parametrize("closed", [True, False])
def test_an_open_guard_is_named_before_a_tap_is_planned(closed: bool) -> None:
    monitor = CellMonitor(LIMIT_S)
    monitor.expect(has_arm=False, name="disk")
    tapper = TapperState(
        state=TapperState.SAFE, fixed_mounts=True, mounts_proven=True, interlock_closed=closed
    )
    tapper.header.stamp = to_stamp(round(1e9 * T))
    monitor.on_tapper(tapper, at(T))
    monitor.on_objects(alone(seen_at(T)), at(T))
    missing = monitor.why_not_ready(at(T))
    assert (missing is None) is closed
    assert missing is None or missing[0] == ErrorCode.TAPPER_INTERLOCK_OPEN
