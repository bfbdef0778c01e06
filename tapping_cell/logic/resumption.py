"""Resumption of a goal by a planner that was restarted after a crash.

While a goal is under way, the planner stores it. A planner that starts soon afterwards loads it and
pursues it further, unless the arm or the tapper was stopped meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from tapping_cell.logic.cell_monitor import CellMonitor, CodedError
from tapping_cell.logic.clock import Now
from tapping_cell.logic.confirmation import Confirmations
from tapping_cell.logic.effects import Content, Effect, KeepGoal, Log, LogLevel
from tapping_cell.logic.goal_handling import Request
from tapping_cell.logic.poses import to_message
from tapping_cell.logic.task import Task
from tapping_cell.messages import PoseStamped
from tapping_cell.se2 import Pose


@dataclass(frozen=True, slots=True)
class KeptGoal:
    """The goal of a planner that crashed. Times in s of the steady clock."""

    request: Request
    ask_always: bool
    """Whether that planner was to ask before every tap."""
    stops: Mapping[str, Sequence[int]]
    """Stops that it knew (see ``CellMonitor.known_stops``)."""
    loaded_at: float
    until: float
    """Time until which the goal may be resumed."""

    def remaining(self, now: Now) -> Request:
        """Return the goal with the time that is left of its time limit."""
        left = self.request.time_limit - (now.steady - self.loaded_at)
        return replace(self.request, time_limit=max(left, 1.0))


class Resumption:
    """Stores the goal under way, and resumes the goal of a planner that crashed."""

    def __init__(self, within: float, monitor: CellMonitor, confirmations: Confirmations) -> None:
        """``within``: maximum time from a crash to the resumption, s; 0: never."""
        self._within = within
        self._monitor = monitor
        self._confirmations = confirmations
        self._kept: KeptGoal | None = None
        self._stop: CodedError | None = None

    def keep(self, task: Task, now: Now, *, is_tapping: bool) -> Iterator[Effect]:
        """Store a goal. ``is_tapping``: whether a tap is under way; it counts, because its outcome
        is not known after a crash."""
        if task.resumable and self._within > 0:
            content = {
                "goal": list(task.goal),
                "tolerance": list(task.tolerance),
                "max_taps": task.max_taps,
                "taps": task.taps + is_tapping,
                "time_left": task.expires - now.steady,
                "kept_at": now.steady,
                "ask": task.ask,
                "ask_always": self._confirmations.always,
                "probe": task.probe,
                "object_id": task.object_id,
                "stops": self._monitor.known_stops(),
            }
            yield KeepGoal(content)

    def load(self, content: Content, age: float, now: Now) -> Iterator[Effect]:
        """Load the goal of a planner that crashed ``age`` s ago, to resume it."""
        yield KeepGoal(None)
        if age < 0:
            yield Log(
                LogLevel.WARNING,
                "the goal saved before the planner's crash is not resumed: this computer's clock "
                f"was set back since, by more than {-age:.1f} s, so the age of the "
                "goal is unknown; send the goal again",
            )
            return
        try:
            kept = _read(content, age, now, now.steady + self._within - age)
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
            yield Log(
                LogLevel.WARNING,
                "the goal saved before the planner's crash cannot be read; send the goal again",
            )
            return
        self._kept = kept
        self._confirmations.resume(kept.ask_always)

    def take(self) -> KeptGoal | None:
        """Return the loaded goal, once; None if there is none."""
        kept, self._kept = self._kept, None
        return kept

    def expiry_message(self, kept: KeptGoal, now: Now) -> str:
        """Return why a goal is not resumed any more; an empty text if it is not too late."""
        late = now.steady - kept.until
        if late <= 0:
            return ""
        return (
            f"the goal of a planner that crashed is not resumed: {self._within + late:.1f} s have "
            f"passed since the crash (resume_within is {self._within:g} s); send the goal again"
        )

    def note_stop(self, stop: CodedError | None) -> None:
        """Store the first stop or fault that was reported since the start of this planner."""
        self._stop = self._stop or stop

    def note_earlier_stops(self, kept: KeptGoal) -> None:
        """Also count the stops that were reported while no planner ran."""
        self.note_stop(self._monitor.recall_stops(kept.stops))

    @property
    def stop(self) -> CodedError | None:
        """A stop or fault that ends the resumed goal, as it would have ended that of the planner
        that crashed; None if there was none."""
        return self._stop


def _read(kept: Content, age: float, now: Now, until: float) -> KeptGoal:
    """Return a stored goal; ``age``: time since the crash, s."""
    message = PoseStamped(pose=to_message(Pose(*map(float, kept["goal"]))))
    message.header.frame_id = "table"
    position, angle = (float(value) for value in kept["tolerance"])
    # After the goal was stored, only the time of the file was updated. The difference is negative
    # after a start of the computer, because the steady clock then starts anew.
    passed = now.steady - float(kept.get("kept_at", now.steady))
    left = float(kept["time_left"]) - max(passed, age)
    most, taps = int(kept["max_taps"]), int(kept.get("taps", 0))
    if not 0 <= taps <= most:
        raise ValueError(taps)
    # Earlier versions stored neither `taps` nor `ask_always` and `probe`.
    request = Request(
        message,
        position,
        angle,
        most,
        left,
        probe=bool(kept.get("probe")),
        ask=bool(kept["ask"]),
        object_id=str(kept["object_id"]),
        earlier_taps=taps,
    )
    stops = {name: [int(one) for one in known] for name, known in kept["stops"].items()}
    return KeptGoal(request, bool(kept.get("ask_always")), stops, now.steady, until)
