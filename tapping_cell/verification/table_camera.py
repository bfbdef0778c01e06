"""Model of the camera and its node for several objects; publishes them as ``camera_pose`` does."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from tapping_cell.logic.clock import to_nanoseconds, to_stamp
from tapping_cell.messages import ObjectState, ObjectStates, PlanState
from tapping_cell.se2 import Pose
from tapping_cell.verification.camera import CAMERA_SILENT, Camera
from tapping_cell.verification.network import Network
from tapping_cell.verification.scheduler import Scheduler
from tapping_cell.vision.other_objects import RoundRobin
from tapping_cell.vision.rest_detection import RestSettings, Track

SETTLED_FRAMES = 30
"""Until this number of frames of an object at rest are fused, it is measured in every frame."""
NODE = "camera_pose"


class TableCamera(Camera):
    """Publishes ``object_state``, ``other_objects`` and ``object_states``.

    ``observe_other`` returns the true pose of another object at a time, or None while something
    covers it.
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
    ) -> None:
        self.others_hidden_until = dict.fromkeys(others, -math.inf)
        self._network = network
        self._others = tuple(others)
        self._true_pose_of = observe_other
        super().__init__(
            scheduler,
            rng,
            observe,
            ros_now,
            lambda state: network.publish(NODE, "object_state", state),
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
        self._network.subscribe(NODE, "plan_state", self._on_plan_state)

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
        return state

    def _observe_other(self, name: str, stamp: int, now: float) -> ObjectState:
        state = ObjectState(object_id=name)
        state.header.stamp, state.header.frame_id = to_stamp(stamp), "table"
        hidden = now < self.others_hidden_until[name]
        true = None if hidden else self._true_pose_of(name, now)
        if true is not None:
            self._measure(state, self._tracks[name], np.array(true), now)
        self._states[name] = state
        return state

    def _send(self, state: ObjectState) -> None:
        super()._send(state)
        if not self.alive or state.error_code == CAMERA_SILENT:
            return
        for other in self._found.pop(to_nanoseconds(state.header.stamp), []):
            self._sent[other.object_id] = other
            self._network.publish(NODE, "other_objects", other)
        states = ObjectStates(header=state.header, objects=[state, *self._sent.values()])
        self._network.publish(NODE, "object_states", states)
