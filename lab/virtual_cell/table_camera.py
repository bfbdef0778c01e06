"""Model of the camera and its node for several objects; publishes them as ``camera_pose`` does."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence, Set

import numpy as np

from lab.virtual_cell.camera import Camera
from lab.virtual_cell.network import Network
from lab.virtual_cell.scheduler import Scheduler
from lab.virtual_cell.table_cell import Outline
from tapping_cell.logic.clock import to_nanoseconds, to_stamp
from tapping_cell.messages import (
    ArmState,
    ErrorCode,
    ObjectState,
    ObjectStates,
    PlanState,
    Point32,
    Polygon,
    UnknownObjects,
)
from tapping_cell.se2 import Pose
from tapping_cell.vision.other_objects import RoundRobin
from tapping_cell.vision.rest_detection import RestSettings, Track

SETTLED_FRAMES = 30
"""Until this number of frames of an object at rest are fused, it is measured in every frame."""
NODE = "camera_pose"
# As in the node; they are written here because the simulation does not import nodes.
PERIOD_S, AWAITED_PERIOD_S = 0.5, 0.15
"""Time between two searches for objects without an object file, normally and while the planner
waits for an observation, s."""


class TableCamera(Camera):
    """Publishes ``object_states`` and ``unknown_objects``.

    ``observe_other`` returns the true pose of another object at a time, or None while the arm
    covers it. ``absent``: names of the objects that are not on the table. ``find_unknown`` returns
    the outlines of the objects without an object file.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        rng: np.random.Generator,
        observe: Callable[[float], Pose | None],
        ros_now: Callable[[], int],
        network: Network,
        object_id: str,
        sigma: tuple[float, float, float],
        others: Sequence[str],
        observe_other: Callable[[str, float], Pose | None],
        absent: Set[str],
        find_unknown: Callable[[], Sequence[Outline]],
    ) -> None:
        self.others_hidden_until = dict.fromkeys(others, -math.inf)
        self._network = network
        self._others = tuple(others)
        self._true_pose_of = observe_other
        self._absent = absent
        self._find_unknown = find_unknown
        super().__init__(
            scheduler,
            rng,
            observe,
            ros_now,
            lambda states: network.publish(NODE, "object_states", states),
            object_id,
            sigma,
        )
        self._begin()

    def restart(self) -> None:
        """Restart the process with an empty state."""
        super().restart()
        self._begin()

    def _begin(self) -> None:
        self._turns = RoundRobin(len(self._others))
        self._tracks = {name: Track(RestSettings()) for name in self._others}
        self._states = {name: ObjectState(object_id=name) for name in self._others}
        self._sent = dict(self._states)
        self._found: dict[int, list[ObjectState]] = {}
        self._plan = PlanState()
        self._view_is_clear = False
        self._searched_at = 0
        self._unknown: UnknownObjects | None = None
        self._network.subscribe(NODE, "plan_state", self._on_plan_state)
        self._network.subscribe(NODE, "arm_state", self._on_arm_state)

    def _on_arm_state(self, _: str, message: ArmState) -> None:
        self._view_is_clear = message.clear_of_camera and message.state == ArmState.IDLE

    def _on_plan_state(self, _: str, message: PlanState) -> None:
        self._plan = message

    def _observe(self, true: Pose | None, now: float) -> ObjectState:
        state = super()._observe(true, now)
        stamp = to_nanoseconds(state.header.stamp)
        awaited = self._plan.state == PlanState.LOOKING
        busy = self._plan.state not in (PlanState.IDLE, PlanState.CANCELED)
        always = [
            number
            for number, name in enumerate(self._others)
            if awaited
            or (busy and name == self._plan.object_id)
            or (self._states[name].visible and self._states[name].frames_fused < SETTLED_FRAMES)
        ]
        self._found[stamp] = [
            self._observe_other(self._others[number], stamp, now)
            for number in self._turns.due(1e-9 * stamp, always)
        ]
        self._search(stamp, [state, *self._states.values()], awaited)
        return state

    def _search(self, stamp: int, states: Sequence[ObjectState], awaited: bool) -> None:
        """Search for objects without an object file under the same conditions as the node."""
        period = AWAITED_PERIOD_S if awaited else PERIOD_S
        due = not 0.0 <= 1e-9 * (stamp - self._searched_at) < period
        still = all(state.at_rest or not state.visible for state in states)
        measured = all(state.header.stamp.sec for state in states)
        if self._view_is_clear and still and measured and due:
            self._searched_at = stamp
            self._unknown = UnknownObjects(
                header=states[0].header,
                outlines=[
                    Polygon(points=[Point32(x=x, y=y) for x, y in outline])
                    for outline in self._find_unknown()
                ],
            )

    def _observe_other(self, name: str, stamp: int, now: float) -> ObjectState:
        state = ObjectState(object_id=name)
        state.header.stamp, state.header.frame_id = to_stamp(stamp), "table"
        hidden = now < self.others_hidden_until[name] or name in self._absent
        true = None if hidden else self._true_pose_of(name, now)
        if true is not None:
            self._measure(state, self._tracks[name], np.array(true), now)
        elif hidden:
            state.error_code = ErrorCode.OBJECT_NOT_SEEN
            state.error_msg = f"{name} is not seen; uncover it"
        else:
            state.hidden_by_arm = True
        self._states[name] = state
        return state

    def _send(self, state: ObjectState) -> None:
        for other in self._found.pop(to_nanoseconds(state.header.stamp), []):
            self._sent[other.object_id] = other
        super()._send(state)
        if self.alive and self._unknown is not None:
            self._network.publish(NODE, "unknown_objects", self._unknown)
            self._unknown = None

    def _states_with(self, own: ObjectState) -> ObjectStates:
        return ObjectStates(
            header=own.header,
            objects=[own, *self._sent.values()],
            searches_unknown_objects=True,
        )
