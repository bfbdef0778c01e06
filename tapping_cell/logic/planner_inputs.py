"""What the planner knows of the cell from the messages of camera, arm and tapper."""

from __future__ import annotations

from tapping_cell.logic.arm_in_view import may_hide
from tapping_cell.logic.cell_monitor import CellMonitor, CodedError
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import Message
from tapping_cell.logic.goal_handling import GoalHandling


class PlannerInputs:
    """Passes each message on to the monitor and to the objects on the table. Notes which
    objects the arm may hide from the camera."""

    def __init__(self, silence_limit: float) -> None:
        self.monitor = CellMonitor(silence_limit)
        self._goals: GoalHandling | None = None
        self._lens: tuple[float, float, float] | None = None
        """Position of the camera's lens in ``table``, m."""

    def configure(self, goals: GoalHandling) -> None:
        """Use the cell of this goal handling."""
        self._goals = goals
        self.monitor.expect(goals.cell.file.arm is not None, goals.cell.object.name)

    def receive(self, topic: str, message: Message, now: Now) -> CodedError | None:
        """Process a message. Return the error of a stop since the device's last message, or
        None."""
        if topic == "arm_state":
            return self.monitor.on_arm(message, now)
        if topic == "tapper_state":
            return self.monitor.on_tapper(message, now)
        if topic == "object_states":
            self.monitor.on_objects(message, now)
            self._note_others(message, now)
        elif topic == "unknown_objects" and self._goals is not None:
            self._goals.objects.on_unknown(message, self.monitor.camera_clock, now)
        elif topic == "camera/pose":
            place = message.pose.position
            self._lens = (place.x, place.y, place.z)
        return None

    def _note_others(self, message: Message, now: Now) -> None:
        if self._goals is None:
            return
        goals, others = self._goals, self._goals.objects
        others.search(message.searches_unknown_objects)
        for state in message.objects:
            name = state.object_id
            covered = not state.visible and self._may_be_covered(goals, name)
            if covered:
                self.monitor.note_covered(name, now)
            others.on_object(state, self.monitor.camera_clock, now, covered)

    def _may_be_covered(self, goals: GoalHandling, name: str) -> bool:
        """Return whether the arm may hide an object of the cell where it was last seen."""
        if not self.monitor.has_arm:
            return False
        pose, tip, lens = self.monitor.place(name), self.monitor.tip, self._lens
        if pose is None or tip is None or lens is None:
            return False
        found = next((one for one in goals.objects.files if one.name == name), None)
        if found is None:
            return False
        place = (pose.x, pose.y, found.height)
        return may_hide(goals.cell, lens, tip, place, found.shape.reach())
