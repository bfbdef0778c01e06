"""Send messages with extreme numbers during a tap: all message types, and all numeric fields.

Other publishers may send any values. No state machine may raise an exception, nothing unsafe may
happen, and the cell must work afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

import pytest

from lab.trial import Trial
from lab.virtual_cell.host import Process, copy_of
from tapping_cell.hardware.scara import Joints
from tapping_cell.logic.poses import to_message
from tapping_cell.messages import (
    ErrorCode,
    HoldStill,
    JointTrajectory,
    JointTrajectoryPoint,
    PoseStamped,
    PositionObject,
    SingleTap,
)
from tapping_cell.se2 import Pose

TOPICS = ("tap_command", "arm_state", "tapper_state", "plan_state", "object_states", "camera/pose")
FLOATS = (math.nan, math.inf, -math.inf, 1e200, -1e200, 5e-324)
INTEGERS = {
    "sec": (-(2**31), 2**31 - 1),
    "nanosec": (2**32 - 1,),
    "tap_id": (0, 1, 2**31, 2**32 - 1),
}
SPACING_S = 0.004
Setter = Callable[[Any], None]


def changes(message: Any) -> Iterator[Setter]:
    """Yield functions, each of which sets one number in a message of this type to an extreme
    value."""
    if isinstance(message, list):
        for index, item in enumerate(message[:4]):
            if isinstance(item, float):
                yield from (partial(_set_item, index=index, value=value) for value in FLOATS)
            elif is_dataclass(item):
                for change in changes(item):
                    yield lambda m, i=index, change=change: change(m[i])
        return
    for field in fields(message):
        value = getattr(message, field.name)
        if isinstance(value, float):
            yield from (partial(_set, name=field.name, value=number) for number in FLOATS)
        elif isinstance(value, int) and not isinstance(value, bool):
            numbers = INTEGERS.get(field.name, (0, 255))
            yield from (partial(_set, name=field.name, value=number) for number in numbers)
        elif isinstance(value, list) or is_dataclass(value):
            for change in changes(value):
                yield lambda m, name=field.name, change=change: change(getattr(m, name))


def _set(message: Any, name: str, value: object) -> None:
    setattr(message, name, value)


def _set_item(message: list[Any], index: int, value: object) -> None:
    message[index] = value


REQUESTS: dict[str, tuple[str, Any]] = {
    "hold_still": ("scara_arm", HoldStill.Request(tap_id=1, duration=0.1)),
    "position_object": ("tap_planner", PositionObject.Goal(time_limit=5.0, max_taps=1)),
    "single_tap": ("tap_planner", SingleTap.Goal(striker_speed=0.2)),
}
COMMANDS: dict[str, Any] = {
    "goal_pose": PoseStamped(),
    "joint_trajectory": JointTrajectory(
        joint_names=list(Joints._fields),
        points=[JointTrajectoryPoint(positions=[0.1, 1.0, 0.0, 0.0])],
    ),
}


@pytest.mark.parametrize(
    "names", [TOPICS, (*COMMANDS, *REQUESTS)], ids=["topics", "commands and requests"]
)
def test_no_number_in_a_message_disturbs_the_cell(
    names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    trial = Trial(seed=31, faults=False)
    trial.bring_up()
    # Otherwise the cell would refuse every tap because of the second publisher alone.
    monkeypatch.setattr(trial.network, "conflict", lambda: "")
    trial.physical.world.place(Pose(0.0, 0.0, 0.0))
    trial.send_goal(Pose(0.03, -0.02, 0.3))
    trial.scheduler.run(trial.scheduler.now + 1.0)
    lasting = 0.0
    for name in names:
        send: Callable[[Any], object] = partial(trial.network.publish, "stranger", name)
        if name in REQUESTS:
            node, model = REQUESTS[name]
            send = partial(request, trial.processes[node], name)
        else:
            model = COMMANDS[name] if name in COMMANDS else trial.network.history[name][-1]
        for change in changes(model):
            lasting += SPACING_S
            forged = copy_of(model)
            change(forged)
            trial.scheduler.after(lasting, partial(send, forged))
    assert lasting > 0
    trial.scheduler.run(trial.scheduler.now + lasting + 1.0)
    assert [process.defects for process in trial.processes.values() if process.defects] == []
    assert trial.oracle.violations == []
    # A forged stamp affects the estimates of the clock differences for 10 s.
    trial.scheduler.run(trial.scheduler.now + 12.0)
    results: list[Any] = []
    pose = Pose(-0.02, 0.02, 0.0)
    trial.oracle.on_goal_sent({trial.cell.object.name: pose}, trial.cell.tolerance)
    goal = PositionObject.Goal(goal_pose=PoseStamped(pose=to_message(pose)))
    goal.goal_pose.header.frame_id = "table"
    trial.recover()
    trial.processes["tap_planner"].request("position_object", goal, "last", results.append)
    trial.scheduler.run(trial.scheduler.now + 120.0, lambda: bool(results))
    assert trial.oracle.violations == []
    assert [result.error_code for result in results] == [ErrorCode.NONE]


def request(process: Process, service: str, message: Any) -> None:
    process.request(service, message, object(), lambda _: None)
