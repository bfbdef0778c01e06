"""The stage of a check: it plays all nodes but one, and records what that one publishes."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Generator
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
from typing import Any, Protocol

from tapping_cell.configuration.cell import Cell
from tapping_cell.logic.clock import NANOSECONDS, Now, to_nanoseconds, to_stamp
from tapping_cell.logic.poses import from_message, to_message
from tapping_cell.messages import (
    Bool,
    ErrorCode,
    Header,
    HoldStill,
    ObjectState,
    ObjectStates,
    PlanState,
    PoseWithCovariance,
    TapCommand,
    Time,
    Trigger,
)
from tapping_cell.messages import Pose as PoseMessage
from tapping_cell.se2 import Pose

FRAME = "table"
OBJECT = Pose(0.0, 0.0, 0.0)
"""Pose at which the played camera sees the object."""
STRANGER = "stranger"
GAP_M = 0.02
"""Distance of the striker from the object's bounding circle at a strike pose."""
AHEAD_S = 0.05
"""Maximum time by which a stamp may be in the future."""
SHOWN_S = 0.5
"""Time after which an error or a stop must be in the state of a node."""
PATIENCE_S = 60.0
"""Maximum duration of a motion of the arm or of its homing."""

Steps = Generator[None, None, str]
"""A check in steps; between two steps, time passes. It returns what was found wrong, or ''."""
Waiting = Generator[None, None, bool]


@dataclass(frozen=True, slots=True)
class Duty:
    """One duty of a node: its number in the contracts, and its check, whose docstring states it."""

    number: str
    check: Callable[[Stage], Steps]

    @property
    def text(self) -> str:
        """Return what the node must do."""
        return " ".join((self.check.__doc__ or "").split())


class Link(Protocol):
    """Connection of the stage to the node under test."""

    def now(self) -> Now:
        """Return the present time."""

    def publish(self, topic: str, message: Any, stranger: bool) -> None:
        """Publish a message. ``stranger``: as a further node, which joins for this purpose."""

    def dismiss_stranger(self) -> None:
        """Remove the further node."""

    def call(self, service: str, request: Any, on_answer: Callable[[Any], None]) -> None:
        """Call a service of the node under test; ``~/`` stands for its name."""


@dataclass(slots=True)
class _Played:
    topic: str
    period: float
    make: Callable[[], Any]
    due: float
    stranger: bool = False


class Stage:
    """All nodes of a cell but the one under test. ``step`` must be called at least every 10 ms."""

    def __init__(self, cell: Cell, link: Link) -> None:
        self.cell = cell
        self.link = link
        self.promises = True
        """Whether the played arm grants ``hold_still``."""
        self.extent = cell.object.body().bounding_radius + GAP_M
        self._played: dict[str, _Played] = {}
        self._received: dict[str, list[tuple[float, Any]]] = defaultdict(list)
        self._last_id = 0

    def now(self) -> float:
        """Return the steady time in s."""
        return self.link.now().steady

    def stamp(self, ahead: float = 0.0) -> Time:
        """Return the ROS time in ``ahead`` s."""
        return to_stamp(self.link.now().ros + round(ahead * NANOSECONDS))

    def header(self, frame: str = FRAME) -> Header:
        """Return a header with the present time."""
        return Header(stamp=self.stamp(), frame_id=frame)

    def play(self, topic: str, make: Callable[[], Any], period: float = 0.05) -> None:
        """Publish the message that ``make`` returns on a topic, every ``period`` s."""
        self._played[topic] = _Played(topic, period, make, self.now())

    def play_planner(self) -> None:
        """Play a planner that waits for a commanded tap."""
        waits = PlanState.PLACING
        self.play("plan_state", lambda: PlanState(header=self.header(), state=waits))

    def object_states(self, pose: Pose = OBJECT, visible: bool = True) -> ObjectStates:
        """Return the states of the objects: of the cell's own one, at rest or hidden."""
        state = self.object_state(pose, visible)
        return ObjectStates(header=state.header, objects=[state])

    def object_state(self, pose: Pose = OBJECT, visible: bool = True) -> ObjectState:
        """Return the state of the object at rest, or hidden."""
        state = ObjectState(
            header=self.header(), object_id=self.cell.object.name, visible=visible, at_rest=visible
        )
        if visible:
            state.frames_fused, state.pose = 30, PoseWithCovariance(pose=to_message(pose))
        else:
            state.error_code, state.error_msg = ErrorCode.OBJECT_NOT_SEEN, "the object is not seen"
        return state

    def silence(self, topic: str) -> None:
        """Publish nothing more on a topic."""
        self._played.pop(topic, None)

    def contest(self, topic: str, make: Callable[[], Any]) -> None:
        """Let a further node publish on a topic too."""
        self._played[STRANGER] = _Played(topic, 0.2, make, self.now(), stranger=True)

    def end_contest(self) -> None:
        """Remove the further node."""
        self.silence(STRANGER)
        self.link.dismiss_stranger()

    def step(self) -> None:
        """Publish what is due."""
        now = self.now()
        for played in self._played.values():
            if now >= played.due:
                played.due = now + played.period
                self.link.publish(played.topic, played.make(), played.stranger)

    def check(self, begin: Callable[[Stage], Steps], duty: Duty, wait: Callable[[], None]) -> str:
        """Check one duty; return what was found wrong, or ''. ``begin`` prepares the node under
        test, and ``wait`` lets a few ms pass."""
        for start in (begin, duty.check):
            steps = start(self)
            while True:
                try:
                    next(steps)
                except StopIteration as end:
                    if end.value:
                        return str(end.value)
                    break
                self.step()
                wait()
        return ""

    def publish(self, topic: str, message: Any) -> None:
        """Publish one message."""
        self.link.publish(topic, message, False)

    def receive(self, topic: str, message: Any) -> None:
        """Record a message of the node under test."""
        self._received[topic].append((self.now(), message))

    def received(self, topic: str, since: float = -math.inf) -> list[tuple[float, Any]]:
        """Return the messages of a topic since a steady time, each with its time."""
        kept = self._received[topic]
        return kept[bisect_left(kept, since, key=itemgetter(0)) :]

    def gap(self, topic: str, since: float) -> float:
        """Return the longest time without a message of a topic since a steady time, s."""
        times = [since, *(at for at, _ in self.received(topic, since)), self.now()]
        return max(after - before for before, after in pairwise(times))

    def last(self, topic: str) -> Any:
        """Return the last message of a topic, or None."""
        kept = self._received[topic]
        return kept[-1][1] if kept else None

    def hold_still(self, request: HoldStill.Request) -> HoldStill.Response:
        """Answer a request as the played arm."""
        if self.promises:
            return HoldStill.Response(granted=True, duration=request.duration)
        return HoldStill.Response(error_code=1, error_msg="the played arm does not promise it")

    def next_id(self) -> int:
        """Return the id of the next tap."""
        self._last_id = max(self._last_id + 1, self.link.now().ros // NANOSECONDS)
        return self._last_id

    def strike_pose(self, heading: float = 0.0) -> PoseMessage:
        """Return the strike pose from which the object is tapped in direction ``heading``, rad."""
        x, y = -self.extent * math.cos(heading), -self.extent * math.sin(heading)
        pose = OBJECT @ Pose(x, y, heading)
        return to_message(pose, self.cell.strike_height)

    def tap(self, heading: float = 0.0, valid: float = 30.0, **fields: Any) -> TapCommand:
        """Return a valid command of a new tap; ``fields`` replace those of the command."""
        command = TapCommand(
            header=self.header(),
            request=TapCommand.TAP,
            tap_id=self.next_id(),
            strike_pose=self.strike_pose(heading),
            striker_speed=1.1 * self.cell.file.tapper.curve().slowest,
            expiry=self.stamp(valid),
            object_pose=to_message(OBJECT),
            predicted_pose=to_message(OBJECT @ Pose(0.005, 0.0, 0.0)),
        )
        for name, value in fields.items():
            setattr(command, name, value)
        return command

    def send(self, command: TapCommand) -> TapCommand:
        """Publish a command and return it."""
        self.publish("tap_command", command)
        return command

    def withdraw(self, tap_id: int, age: float = 0.0) -> None:
        """Withdraw a tap; ``age`` of the stamp in s."""
        header = Header(stamp=self.stamp(-age), frame_id=FRAME)
        self.send(TapCommand(header=header, request=TapCommand.WITHDRAW, tap_id=tap_id))

    def emergency_stop(self, pressed: bool) -> None:
        """Publish an emergency stop, or its end."""
        self.publish("emergency_stop", Bool(data=pressed))

    def until(self, condition: Callable[[], object], patience: float = PATIENCE_S) -> Waiting:
        """Wait until a condition holds; return whether it did within ``patience`` s."""
        end = self.now() + patience
        while not condition():
            if self.now() > end:
                return False
            yield
        return True

    def throughout(self, condition: Callable[[], object], duration: float) -> Waiting:
        """Wait for a duration in s; return whether a condition held all the time."""
        end = self.now() + duration
        while self.now() < end:
            if not condition():
                return False
            yield
        return True

    def pause(self, duration: float) -> Waiting:
        """Let time pass, in s."""
        return self.throughout(lambda: True, duration)

    def ask(
        self, service: str, request: Any = None, patience: float = 5.0
    ) -> Generator[None, None, Any]:
        """Call a service; return its answer, or None if there is none."""
        answers: list[Any] = []
        self.link.call(service, request or Trigger.Request(), answers.append)
        yield from self.until(lambda: answers, patience)
        return answers[0] if answers else None


def check_rate(
    stage: Stage, topic: str, longest: float, oldest: float, duration: float = 3.0
) -> Steps:
    """Check that a state is published at least every ``longest`` s with stamps that are increasing
    and at most ``oldest`` s old."""
    begun = stage.now()
    yield from stage.pause(duration)
    found, gap = stage.received(topic, begun), stage.gap(topic, begun)
    if gap > longest:
        return f"no {topic} for {gap:.2f} s (limit {longest:.2f} s)"
    stamps = [1e-9 * to_nanoseconds(message.header.stamp) for _, message in found]
    if any(after < before for before, after in pairwise(stamps)):
        return f"the stamps of {topic} go back"
    now = stage.link.now()
    ages = [
        1e-9 * now.ros - (now.steady - at) - stamp
        for (at, _), stamp in zip(found, stamps, strict=True)
    ]
    if max(ages) > oldest:
        return (
            f"a stamp of {topic} was {max(ages):.2f} s old when it arrived (limit {oldest:.2f} s)"
        )
    if min(ages) < -AHEAD_S:
        return f"a stamp of {topic} was {-min(ages):.2f} s in the future"
    return ""


def far(one: PoseMessage, other: PoseMessage, distance: float, angle: float) -> bool:
    """Return whether two poses differ by more than a distance in m or an angle in rad."""
    a, b = from_message(one), from_message(other)
    height = abs(one.position.z - other.position.z)
    return max(a.distance_to(b), height) > distance or abs(a.rotation_to(b)) > angle
