"""What must never happen, checked against the truth after every event of a run."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from tapping_cell.logic.clock import to_nanoseconds
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import ArmState, ErrorCode, HoldStill, PlanState, TapCommand, TapperState
from tapping_cell.se2 import Pose
from tapping_cell.verification.host import HostClock
from tapping_cell.verification.physical_cell import PhysicalCell, Release
from tapping_cell.verification.scheduler import Scheduler

WINDOW_S = 0.1
"""A release may follow a FIRE that was on its way by so much: the board's longest window."""
STRIKE_POSITION_M = 0.0025
STRIKE_ANGLE_RAD = 0.01
"""How far the true tip may be from the commanded one at a release: errors of the arm included."""
ENERGY_SHARE = 0.03
"""How far the energy of a release may be from what was asked for."""
STRIKE_HEIGHT_M = 0.0005
BUMP_M = 0.004
BUMP_RAD = math.radians(6.0)
"""From how much on an object that was moved by hand must not be struck as planned."""
CHARGED_LIMIT_S = 12.0
"""Longest time that a striker may stay charged, whatever happened to the computers."""
CHECK_S = 0.045
"""A release follows the last check before FIRE by so much at most: the board's deadline for it."""
PULSE_S = 0.02
"""Of a release; the arm's promise lasts for it and for the striker's flight."""
SILENCE_S = 1.5
"""Longest silence of a planner with which the tapper fires, whether it speaks of the tap or not."""
ORPHAN_S = 1.5
"""A release may follow the end of its planner by so much: heartbeats must have stopped by then."""
STOP_MOTION_S = 1.5
"""An arm that was told to stop is at rest after so long, braking and delivery included."""


@dataclass(frozen=True, slots=True)
class Violation:
    """An invariant that was broken; ``time`` in s of the run."""

    name: str
    time: float
    sentence: str


@dataclass(slots=True)
class Witness:
    """Hears everything, knows the truth, and checks. Times in s of the run.

    ``stopped_at``: since when a stop that nobody has reset is held, by process; ``ended_taps``:
    when the end of a tap (withdrawal, stop, cancel) was delivered to the tapper's process.
    """

    scheduler: Scheduler
    physical: PhysicalCell
    tapper_clock: HostClock
    violations: list[Violation] = field(default_factory=list)
    commands: dict[int, TapCommand] = field(default_factory=dict)
    ended_taps: dict[int, float] = field(default_factory=dict)
    outcomes: dict[int, int] = field(default_factory=dict)
    stopped_at: dict[str, float] = field(default_factory=dict)
    word_given: bool = True
    """Whether a person has allowed motion since the last crash, stop or loss of power."""
    hidden_since: float = math.inf
    moved_by_hand: tuple[float, Pose] | None = None
    """When the object was last moved by hand, and where it lay before."""
    held_since: float = math.inf
    """Since when the panel's emergency stop is held."""
    planner_gone_since: float = math.inf
    """Since when the planner's process does not exist."""
    promises: dict[int, float] = field(default_factory=dict)
    """Until when the arm has promised to stand still, by tap."""
    last_check: tuple[float, object | None] = (-math.inf, "never asked")
    """When the tapper's machine was last asked whether it may fire, and what it had against it."""
    motor_weak_until: float = -math.inf
    """Until when the tapper's motor may have missed steps, for lack of power."""
    unseen_limit: float = 0.0
    """A release may follow a change of the scene by so much: the limit of the object's being
    unseen, of the camera's silence, and what is on its way."""
    seen_by_tapper: deque[tuple[float, Pose]] = field(default_factory=lambda: deque(maxlen=100))
    """When the tapper's process heard where the object lies, and where that is."""
    taken_by_tapper: dict[int, list[TapCommand]] = field(default_factory=dict)
    """The TAPs that the tapper's process has heard, by id: of two with one id it may strike only
    for one of its own."""
    planners: set[int] = field(default_factory=set)
    """The taps that the planner has commanded."""
    planner_heard: float = -math.inf
    """When the tapper's process heard the planner last."""
    unseen_by_tapper: float = 0.0
    """The tapper's own limit of the object's being unseen."""
    _struck_until: float = -math.inf
    """When the striker that was released last is through its stroke."""
    _asked_to_move: bool = True
    _released: int = 0
    _charged_since: float | None = None
    _moving_since: float | None = None
    _plan_state: int = PlanState.IDLE

    def violate(self, name: str, sentence: str) -> None:
        """Note a broken invariant."""
        self.violations.append(Violation(name, self.scheduler.now, sentence))

    def on_publish(self, node: str, topic: str, message: object) -> None:
        """Hear what a node publishes."""
        if isinstance(message, TapCommand):
            if message.request == TapCommand.TAP:
                self.commands[message.tap_id] = message
                if node == "tap_planner":
                    self.planners.add(message.tap_id)
        elif isinstance(message, TapperState) and node == "tapper_trigger":
            self._on_tapper_state(message)
        elif isinstance(message, ArmState) and node == "scara_arm":
            if message.state == ArmState.IDLE or message.error_code == ErrorCode.NOT_ACTIVE:
                self._asked_to_move = False
        elif isinstance(message, PlanState) and node == "tap_planner":
            self._on_plan_state(message)

    def after_event(self) -> None:
        """Check what can be seen at any moment."""
        releases = self.physical.releases
        while self._released < len(releases):
            self._check_release(releases[self._released], releases[: self._released])
            self._released += 1
        self._check_charge()
        self._check_motion()

    # Releases

    def _check_release(self, release: Release, earlier: list[Release]) -> None:
        shot = release.shot
        if any(before.shot == shot for before in earlier):
            self.violate("fired twice", f"shot {shot} was released twice")
        if release.moving:
            self.violate("arm moving", f"shot {shot} was released while the arm moved")
        command = self._command_of(release)
        if command is None:
            self.violate(
                "no such tap", f"shot {shot} was released, the tapper heard of no such tap"
            )
            return
        self._check_place(release, command)
        self._check_energy(release, command)
        self._struck_until = release.time + self.physical.flight(command.striker_speed)
        self._check_permit(release)
        self._check_time(release, command)
        gone = release.time - self.planner_gone_since
        if gone > ORPHAN_S:
            self.violate("no planner", f"shot {shot} was released {gone:.2f} s after its planner")
        silent = release.time - self.planner_heard
        if shot in self.planners and silent > SILENCE_S + WINDOW_S:
            self.violate(
                "planner silent",
                f"shot {shot} was released {silent:.2f} s after the tapper had last heard the"
                " planner that commanded it",
            )
        self._check_scene(release, command)

    def _command_of(self, release: Release) -> TapCommand | None:
        """The command that a release belongs to: where several had its id (two planners by
        mistake), the one whose strike pose is nearest."""

        def distance(command: TapCommand) -> float:
            pose = from_message(command.strike_pose)
            turn = abs(pose.rotation_to(release.tip))
            return pose.distance_to(release.tip) / STRIKE_POSITION_M + turn / STRIKE_ANGLE_RAD

        variants = self.taken_by_tapper.get(release.shot)
        return min(variants, key=distance) if variants else None

    def _check_energy(self, release: Release, command: TapCommand) -> None:
        asked = self.physical.energy_for(command.striker_speed)
        weak = release.time < self.motor_weak_until
        # A spring that its motor did not draw is weaker than asked, and nothing measures that.
        least = 0.0 if weak else 1.0 - ENERGY_SHARE
        if not least * asked <= release.energy <= (1.0 + ENERGY_SHARE) * asked:
            self.violate(
                "other energy",
                f"shot {release.shot} was released with {1e3 * release.energy:.2f} mJ, asked were"
                f" {1e3 * asked:.2f} mJ",
            )

    def _check_place(self, release: Release, command: TapCommand) -> None:
        wanted = from_message(command.strike_pose)
        distance = wanted.distance_to(release.tip)
        turn = abs(wanted.rotation_to(release.tip))
        lift = abs(release.height - command.strike_pose.position.z)
        if distance > STRIKE_POSITION_M or turn > STRIKE_ANGLE_RAD or lift > STRIKE_HEIGHT_M:
            self.violate(
                "arm elsewhere",
                f"shot {release.shot} was released {1e3 * distance:.2f} mm,"
                f" {math.degrees(turn):.2f} deg and {1e3 * lift:.2f} mm in height away from its"
                " strike pose",
            )

    def _check_permit(self, release: Release) -> None:
        end = self.promises.get(release.shot, -math.inf)
        if self._struck_until + PULSE_S > end:
            self.violate(
                "outside the permit",
                f"shot {release.shot} was released {end - release.time:.3f} s before the end of"
                " the arm's promise to stand still",
            )
        asked, doubt = self.last_check
        if doubt is not None:
            self.violate("against its check", f"shot {release.shot} was released against: {doubt}")
        elif release.time > asked + CHECK_S:
            self.violate(
                "check too old",
                f"shot {release.shot} was released {release.time - asked:.3f} s after the last"
                " check",
            )

    def _check_time(self, release: Release, command: TapCommand) -> None:
        ended = self.ended_taps.get(release.shot)
        if ended is not None and release.time > ended + WINDOW_S:
            self.violate(
                "after its end",
                f"shot {release.shot} was released {release.time - ended:.3f} s after its end was"
                " delivered to the tapper",
            )
        stopped = self.stopped_at.get("tapper_trigger")
        if stopped is not None and release.time > stopped + WINDOW_S:
            self.violate(
                "after a stop",
                f"shot {release.shot} was released {release.time - stopped:.3f} s after a stop",
            )
        late = 1e-9 * (self.tapper_clock.now().ros - to_nanoseconds(command.expiry)) - WINDOW_S
        if late > 0:
            self.violate("expired", f"shot {release.shot} was released {late:.3f} s too late")

    def _check_scene(self, release: Release, command: TapCommand) -> None:
        if release.time > self.hidden_since + self.unseen_limit:
            self.violate(
                "unseen",
                f"shot {release.shot} was released {release.time - self.hidden_since:.2f} s after"
                " the camera last saw the object",
            )
        planned = from_message(command.object_pose)
        self._check_knowledge(release, planned)
        off, turned = (
            planned.distance_to(release.object_pose),
            abs(planned.rotation_to(release.object_pose)),
        )
        moved = self.moved_by_hand
        if (off > BUMP_M or turned > BUMP_RAD) and (
            moved is None or release.time > moved[0] + self.unseen_limit
        ):
            self.violate(
                "object elsewhere",
                f"shot {release.shot} was released with the object {1e3 * off:.1f} mm and"
                f" {math.degrees(turned):.1f} deg from where the tap was planned",
            )

    def _check_knowledge(self, release: Release, planned: Pose) -> None:
        """What the tapper has heard without a break is known to it, whatever the truth is."""
        since, last = math.inf, self.seen_by_tapper[-1][0] if self.seen_by_tapper else math.inf
        if release.time > last + self.unseen_by_tapper + WINDOW_S:
            self.violate(
                "unseen by the tapper",
                f"shot {release.shot} was released {release.time - last:.3f} s after the tapper"
                " had last heard where the object lies",
            )
        for heard, pose in reversed(self.seen_by_tapper):
            if planned.distance_to(pose) <= BUMP_M and abs(planned.rotation_to(pose)) <= BUMP_RAD:
                break
            since = heard
        if release.time > since + WINDOW_S:
            self.violate(
                "against what it saw",
                f"shot {release.shot} was released {release.time - since:.3f} s after the tapper"
                " had heard that the object lies elsewhere",
            )

    # What goes on

    def _check_charge(self) -> None:
        now = self.scheduler.now
        charged = self.physical.tapper_board.state in ("CHARGING", "CHARGED")
        if not charged:
            self._charged_since = None
            return
        if self._charged_since is None:
            self._charged_since = now
        elif now - self._charged_since > CHARGED_LIMIT_S:
            self.violate("left charged", f"the striker has been charged for {now:.1f} s")
            self._charged_since = now

    def _check_motion(self) -> None:
        now = self.scheduler.now
        if not self.physical.moving(now):
            self._moving_since = None
            return
        if self._moving_since is None:
            self._moving_since = now
            if not self._asked_to_move:
                self.violate("moved unasked", "the arm began to move, and nobody had asked for it")
            if now < self._struck_until:
                self.violate(
                    "moved in flight",
                    f"the arm began to move {self._struck_until - now:.3f} s before the striker"
                    " can be through its stroke",
                )
            if not self.word_given:
                self.violate(
                    "moved by itself",
                    "the arm began to move without a person's word after a crash or a stop",
                )
        if now > self.held_since + STOP_MOTION_S:
            self.violate(
                "moves while held",
                f"the arm moves {now - self.held_since:.2f} s after the panel's"
                " emergency stop was pressed, which is still held",
            )
            self.held_since = math.inf
        stopped = self.stopped_at.get("scara_arm")
        if stopped is not None and now > stopped + STOP_MOTION_S:
            self.violate("moves while stopped", f"the arm moves {now - stopped:.2f} s after a stop")
            self.stopped_at["scara_arm"] = math.inf

    # Reports

    def ask_to_move(self) -> None:
        """A command that may move the arm was handled: until it is idle again it may."""
        self._asked_to_move = True

    def on_answer(self, service: str, request: object, response: object) -> None:
        """Hear what a service answers."""
        if not isinstance(request, HoldStill.Request):
            return
        if isinstance(response, HoldStill.Response) and response.granted:
            self.promises[request.tap_id] = self.scheduler.now + request.duration

    def on_asked(self, process: str, job: str, answer: object | None) -> None:
        """Hear what a machine answers to its running job."""
        if process == "tapper_trigger" and job == "fire":
            self.last_check = self.scheduler.now, answer

    def _on_tapper_state(self, message: TapperState) -> None:
        fired = any(release.shot == message.tap_id for release in self.physical.releases)
        if message.tap_id and message.outcome != TapperState.NONE:
            before = self.outcomes.get(message.tap_id, message.outcome)
            if TapperState.UNKNOWN not in (before, message.outcome) and before != message.outcome:
                self.violate(
                    "other outcome",
                    f"tap {message.tap_id} was told with outcome {before}, now {message.outcome}",
                )
            self.outcomes[message.tap_id] = message.outcome
            if message.outcome == TapperState.FIRED and not fired:
                self.violate("false report", f"tap {message.tap_id} is told FIRED, it was not")
        if message.state == TapperState.SAFE and self._charged_since is not None:
            since = self.scheduler.now - self._charged_since
            if since > 0.6 and message.tap_id != 0:
                self.violate(
                    "said safe while charged",
                    f"the tapper is told SAFE, it has been charged for {since:.2f} s",
                )

    def _on_plan_state(self, message: PlanState) -> None:
        before, self._plan_state = self._plan_state, message.state
        if message.state != PlanState.REACHED or before == PlanState.REACHED:
            return  # what is repeated was true when it was told first
        true = self.physical.object_pose(self.scheduler.now)
        goal = from_message(message.goal.pose)
        off, turned = goal.distance_to(true), abs(goal.rotation_to(true))
        position, angle = message.position_tolerance, message.angle_tolerance
        moved = self.moved_by_hand
        recently = moved is not None and self.scheduler.now - moved[0] < self.unseen_limit
        if (off > position or turned > angle) and not recently:
            self.violate(
                "false claim",
                f"told reached, truly {1e3 * off:.3f} mm and {math.degrees(turned):.3f} deg off"
                f" (tolerance {1e3 * position:.3f} mm, {math.degrees(angle):.3f} deg)",
            )

    def at_the_end(self) -> None:
        """Hold every report of an outcome against what truly happened, also later."""
        fired = {release.shot for release in self.physical.releases}
        for shot, outcome in self.outcomes.items():
            if outcome == TapperState.NOT_FIRED and shot in fired:
                self.violate("false report", f"tap {shot} was told NOT_FIRED, it was fired")
