"""Client that sends an arrangement of several objects and monitors it.

The verbs `goal` and `demo` use this client. There is no separate executable for it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from tapping_cell_msgs.action import ArrangeObjects
from tapping_cell_msgs.msg import (
    ArrangementState,
    ObjectProgress,
    ObjectStates,
)

from tapping_cell.configuration.layout_file import LayoutFile
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.clients.action_follower import ActionFollower
from tapping_cell.nodes.conversions import from_message, object_goal
from tapping_cell.report.words import PROGRESS, word
from tapping_cell.se2 import Pose


@dataclass(frozen=True, slots=True)
class ObjectEnd:
    """Remaining error of one object, in m and rad, NaN if unknown."""

    name: str
    state: str
    has_goal: bool
    taps: int
    residual_distance: float
    residual_rotation: float
    pose: Pose | None
    """Last measured pose; None if the object was never seen."""


@dataclass(frozen=True, slots=True)
class ObjectTapped:
    """Event: the result of a tap was measured."""

    number: int
    name: str
    objects: tuple[ObjectEnd, ...]


@dataclass(frozen=True, slots=True)
class ArrangementEnded:
    """Event: the arrangement ended; error_code 0 means success."""

    error_code: int
    error_msg: str
    taps: int
    objects: tuple[ObjectEnd, ...] = field(default=())


Event = ObjectTapped | ArrangementEnded


class ArrangeClient(ActionFollower[Event]):
    """Client that sends an arrangement and monitors its progress. Use as a context manager."""

    last_event = ArrangementEnded

    def __init__(self, name: str = "arrange_client", namespace: str = "") -> None:
        super().__init__(name, namespace, ArrangeObjects, "arrange_objects")
        self.poses: dict[str, Pose] = {}
        """Measured poses of the objects at rest, by name."""
        self._taps = 0
        self._objects: tuple[ObjectEnd, ...] = ()
        subscribe = self.node.create_subscription
        subscribe(ObjectStates, "object_states", self._on_states, LATCHED)
        subscribe(ArrangementState, "arrangement_state", self._on_arrangement_state, LATCHED)

    def missing(self, names: frozenset[str] = frozenset()) -> list[str]:
        """Return the conditions that still prevent the cell from arranging these objects, as
        text."""
        reasons = []
        if not self.accepts_goals() or not self.planner_active:
            reasons.append("the planner is not running")
        reasons += self._missing_devices()
        reasons += [f"'{name}' is not seen at rest" for name in sorted(names - self.poses.keys())]
        return reasons

    def send(self, layout: LayoutFile) -> None:
        """Send an arrangement."""
        message = ArrangeObjects.Goal(
            goals=[
                object_goal(
                    each.object, Pose(*each.pose), (each.position_tolerance, each.angle_tolerance)
                )
                for each in layout.goals
            ],
            in_order=layout.in_order,
            may_move=list(layout.may_move),
            max_taps=layout.max_taps,
            time_limit=layout.time_limit,
        )
        self._taps, self._objects = 0, ()
        self._send_goal(message, None)

    def _event_of_silence(self) -> ArrangementEnded | None:
        """Return the end of an arrangement whose result can no longer arrive."""
        ended = self._end_without_result()
        return None if ended is None else ArrangementEnded(ended.code, ended.sentence, self._taps)

    def _on_arrangement_state(self, message: ArrangementState) -> None:
        if self._under_way and message.active and message.taps > self._taps:
            before, self._objects = self._objects, _ends(message.objects)
            self._taps = message.taps
            known = {one.name: one.taps for one in before}
            tapped = [one.name for one in self._objects if one.taps > known.get(one.name, 0)]
            self._events.put(ObjectTapped(message.taps, ", ".join(tapped), self._objects))

    def _on_result(self, result: ArrangeObjects.Result) -> None:
        self._events.put(
            ArrangementEnded(
                result.error_code, result.error_msg, result.taps, _ends(result.objects)
            )
        )

    def _on_states(self, message: ObjectStates) -> None:
        self.poses = {
            state.object_id: from_message(state.pose.pose)
            for state in message.objects
            if state.visible and state.at_rest
        }


def _ends(objects: list[ObjectProgress]) -> tuple[ObjectEnd, ...]:
    return tuple(
        ObjectEnd(
            one.object_id,
            word(PROGRESS, one.state),
            one.has_goal,
            one.taps,
            one.residual_distance,
            one.residual_rotation,
            from_message(one.pose.pose) if any(one.pose.covariance) else None,
        )
        for one in objects
    )
