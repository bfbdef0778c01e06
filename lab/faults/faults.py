"""Random faults of a cell and their injection."""

from __future__ import annotations

import importlib
import inspect
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lab.faults.fault_target import FaultTarget, Made, Maker
from lab.faults.invalid_goals import draw_wrong_goal
from lab.faults.trajectories import WRONG, draw_trajectory
from lab.virtual_cell.further_panels import PanelPress
from lab.virtual_cell.host import PlannedFreeze
from lab.virtual_cell.network import STRANGER
from lab.virtual_cell.people import KEY, SWITCH
from tapping_cell.logic.clock import to_stamp
from tapping_cell.logic.host import Activated, Deactivated
from tapping_cell.logic.poses import to_message
from tapping_cell.messages import (
    ArmState,
    ErrorCode,
    HoldStill,
    JointTrajectory,
    JointTrajectoryPoint,
    PlanState,
    PoseStamped,
    TapCommand,
    TapperState,
)
from tapping_cell.messages import Pose as Pose3
from tapping_cell.se2 import Pose
from tapping_cell.simulation.fault_layer import Direction, FaultKind, LineFault, random_fault

SPAN_S = 16.0
"""The faults of a goal are injected within this time after the goal is sent, s."""
SHARE_AT_A_MOMENT = 0.25
"""Fraction of the goals whose faults all occur just after a node has published a certain state. In
these goals, several faults coincide."""
SHARE_AT_THE_SHOT = 0.5
"""Fraction of the goals whose faults all occur just after a certain step of a shot."""
CLOSE_S = 0.3
"""Maximum time from the published state, or from the step of a shot, to the faults."""
SHARE_OF_LOST_ANSWERS = 0.2
"""Fraction of the delays of ``hold_still`` that exceed the tapper's timeout."""
SHARE_OF_LONG_HOLDS, LONG_HOLD_S = 0.2, (1.0, 600.0)
"""Fraction of the requests of another node for which the arm should stand still for longer than a
shot takes, and the range of the duration, s."""
SHARE_OF_LATE_ACTIVATIONS, LATE_ACTIVATION_S = 0.2, (5.0, 60.0)
"""Fraction of the planners that crash and are activated late, and the range of the time from their
start to their activation, s."""
SHARE_OF_WRONG_CLOCKS, PLANNER_AWAY_S = 0.2, (15.0, 28.0)
"""Fraction of the planners that crash while their computer's clock is set back, and the range of
the time until these planners are started again, s."""
SHARE_OF_STOPS_UNSEEN = 0.2
"""Fraction of the stops that are pressed and cleared while no planner runs."""
SHARE_OF_LOST_COMPUTERS, CAMERA_AWAY_S = 0.2, (15.0, 40.0)
"""Fraction of the tappers that are killed together with the camera, and the range of the time until
the camera is started again, s."""
FLOOD_HZ = 100.0
"""Rate at which a foreign node floods a topic."""
CLOSEST_S = 2e-4
"""Minimum time from a step of a shot to its faults. The random times are log-uniform between
``CLOSEST_S`` and ``CLOSE_S``."""


@dataclass(frozen=True, slots=True)
class Mix:
    """Distribution of the faults. ``only``: kinds of faults, empty for all; a kind that is listed
    several times is drawn more often. ``mean``: mean number of faults per goal. ``fixed``: whether
    the cell has fixed tappers. ``several``: whether every cell has several objects. ``set_up``,
    ``ask``: whether every run is in set-up mode, or asks a person before every tap. Otherwise, the
    seed selects these cells."""

    only: tuple[str, ...] = ()
    mean: float = 2.0
    fixed: bool = False
    several: bool = False
    set_up: bool = False
    ask: bool = False


ALL = Mix()


@dataclass(frozen=True, slots=True)
class Moment:
    """The n-th occurrence of an event in a goal; n is ``times``. The trial reports the event by its
    ``name``."""

    name: str
    times: int


def moment_name(topic: str, state: int) -> str:
    """Return the name of the moment at which a node publishes a change to this state."""
    return f"{topic} {state}"


MOMENTS = (
    moment_name("arm_state", ArmState.IDLE),
    moment_name("arm_state", ArmState.MOVING),
    moment_name("arm_state", ArmState.IN_POSITION),
    moment_name("arm_state", ArmState.WITHDRAWING),
    moment_name("tapper_state", TapperState.SAFE),
    moment_name("tapper_state", TapperState.CHARGING),
    moment_name("plan_state", PlanState.LOOKING),
    moment_name("plan_state", PlanState.PLACING),
    moment_name("plan_state", PlanState.SETTLING),
)
ARM_ASKED, ARM_PROMISED = "hold_still asked", "hold_still answered"
CHECKED, RELEASED = "last check", "released"
OF_A_SHOT = (
    moment_name("plan_state", PlanState.PLACING),
    moment_name("arm_state", ArmState.MOVING),
    moment_name("tapper_state", TapperState.CHARGING),
    moment_name("tapper_state", TapperState.CHARGED),
    moment_name("arm_state", ArmState.IN_POSITION),
    ARM_ASKED,
    ARM_PROMISED,
    moment_name("tapper_state", TapperState.FIRING),
    CHECKED,
    RELEASED,
)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of a run. ``time``: delay in s after the goal was sent, or after ``moment``."""

    kind: str
    time: float
    strike: Callable[[FaultTarget], None]
    description: str = ""
    moment: Moment | None = None


def draw_faults(
    rng: np.random.Generator,
    trial: FaultTarget,
    mix: Mix = ALL,
    at_the_shot: bool = False,
) -> list[Fault]:
    """Choose the random faults of one goal; return them in the order of their times.

    ``at_the_shot``: only faults around the shot.
    """
    only, mean = mix.only, mix.mean
    number = 1 + int(rng.poisson(mean - 1)) if at_the_shot else int(rng.poisson(mean))
    place = 0.0 if at_the_shot else rng.random()
    moment, kinds, closest = None, tuple(trial.makers), 0.0
    if place < SHARE_AT_THE_SHOT:
        name = _pick(rng, trial.of_a_shot)
        times = 1 if at_the_shot or rng.random() < 0.7 else 2
        moment, kinds, closest = Moment(name, times), trial.at_a_shot, CLOSEST_S
    elif place < SHARE_AT_THE_SHOT + SHARE_AT_A_MOMENT:
        moment = Moment(_pick(rng, trial.moments), int(rng.integers(1, 3)))
    if only:
        kinds = tuple(kind for kind in only if kind in kinds) or only
    faults = []
    for _ in range(number):
        kind = _pick(rng, kinds)
        strike, description = trial.makers[kind](rng, trial)
        if closest:
            time = draw_duration(rng, closest, CLOSE_S)
        else:
            time = float(rng.uniform(0.0, SPAN_S if moment is None else CLOSE_S))
        faults.append(Fault(kind, time, strike, description, moment))
    return sorted(faults, key=lambda fault: fault.time)


def draw_duration(rng: np.random.Generator, shortest: float, longest: float) -> float:
    """Return a random, log-uniform duration between the two limits, s."""
    return float(math.exp(rng.uniform(math.log(shortest), math.log(longest))))


def _pick(rng: np.random.Generator, names: tuple[str, ...]) -> str:
    return names[int(rng.integers(len(names)))]


NODES = ("tap_planner", "scara_arm", "tapper_trigger")
MODULES = {
    "tap_planner": "planner tap_cycle tap_decision tap_steps tap_counts tap_sender confirmation"
    " resumption goal_requests planner_reports planner_inputs",
    "scara_arm": "arm arm_cycle arm_readings standing_still device",
    "tapper_trigger": "tapper tapper_cycle tapper_board tapper_commands device",
}
"""Modules of ``tapping_cell.logic`` that are the state machine of each node."""
ISSUES = re.compile(r"_effects\.(append|extend)\(|\byield\b")


def _functions_of(node: str) -> dict[str, str]:
    """Return the source of each function of a node's state machine, by name."""
    found = {}
    for room in MODULES[node].split():
        module = importlib.import_module(f"tapping_cell.logic.{room}")
        scopes = [module, *(kind for _, kind in inspect.getmembers(module, inspect.isclass))]
        for scope in scopes:
            for name, function in inspect.getmembers(scope, inspect.isfunction):
                # Functions that ``dataclass`` makes have no file.
                if inspect.getsourcefile(function) == module.__file__:
                    found[name] = inspect.getsource(function)
    return dict(sorted(found.items()))


_SOURCES = {node: _functions_of(node) for node in NODES}
METHODS = {node: tuple(sources) for node, sources in _SOURCES.items()}
"""Functions of each node's state machine."""
DECIDING = {
    node: tuple(name for name, source in sources.items() if ISSUES.search(source))
    for node, sources in _SOURCES.items()
}
"""Functions that issue an effect. If such a handler raises, its effects are lost, but the state has
already changed."""


def _freeze(rng: np.random.Generator, trial: FaultTarget) -> Made:
    node, duration = _pick(rng, (*trial.nodes, "camera_pose")), draw_duration(rng, 0.001, 5.0)
    return lambda t: t.freeze(node, duration), f"{node} frozen for {duration:.3f} s"


def _freeze_at_shot(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """Freeze a node for about the time for which the arm promises to stand still."""
    node = _pick(rng, ("tapper_trigger", "tapper_trigger", trial.arm_node, "tap_planner"))
    duration = float(rng.uniform(0.02, 0.6))
    return lambda t: t.freeze(node, duration), f"{node} frozen for {duration:.3f} s"


def _freeze_before_write(rng: np.random.Generator, trial: FaultTarget) -> Made:
    node = _pick(rng, ("tapper_trigger", "tapper_trigger", trial.arm_node))
    writes, duration = int(rng.integers(0, 60)), draw_duration(rng, 0.005, 3.0)

    def strike(t: FaultTarget) -> None:
        t.processes[node].freeze_before_write = PlannedFreeze(writes, duration)

    return strike, (
        f"{node} frozen for {duration:.3f} s before serial write {writes + 1}, counted from now"
    )


def _freeze_at_write(rng: np.random.Generator, trial: FaultTarget) -> Made:
    writes, duration = int(rng.integers(0, 4)), draw_duration(rng, 0.02, 3.0)

    def strike(t: FaultTarget) -> None:
        t.processes["tapper_trigger"].freeze_before_write = PlannedFreeze(writes, duration)

    return strike, (
        f"tapper_trigger frozen for {duration:.3f} s before serial write {writes + 1}, counted "
        "from now"
    )


def _freeze_after_check(rng: np.random.Generator, trial: FaultTarget) -> Made:
    duration = draw_duration(rng, 0.005, 3.0)

    def strike(t: FaultTarget) -> None:
        t.processes["tapper_trigger"].freeze_after_check = duration

    return strike, f"tapper_trigger frozen for {duration:.3f} s after its last check"


def _kill(rng: np.random.Generator, trial: FaultTarget) -> Made:
    node, away = _pick(rng, (*trial.nodes, "camera_pose")), draw_duration(rng, 0.2, 25.0)
    description = f"{node} killed, restarted after {away:.1f} s"
    late = float(rng.uniform(*LATE_ACTIVATION_S))
    is_late = node == "tap_planner" and rng.random() < SHARE_OF_LATE_ACTIVATIONS
    if node == "tap_planner" and not is_late and rng.random() < SHARE_OF_WRONG_CLOCKS:
        return _kill_and_set_clock_back(rng)
    camera_away = float(rng.uniform(*CAMERA_AWAY_S))
    with_camera = node == "tapper_trigger" and rng.random() < SHARE_OF_LOST_COMPUTERS

    def strike(t: FaultTarget) -> None:
        if with_camera:
            t.kill("camera_pose", camera_away)
        t.kill(node, away)
        if is_late:
            t.processes[node].activation_delay = late

    if is_late:
        description += f" and activated {late:.1f} s after its start"
    if with_camera:
        description += f"; the camera is killed, too, and restarted after {camera_away:.1f} s"
    return strike, description


def _kill_and_set_clock_back(rng: np.random.Generator) -> Made:
    """The planner crashes, and its computer's clock is set back while the planner is down, so that
    the stored goal seems younger than it is, or seems to come from the future."""
    away = float(rng.uniform(*PLANNER_AWAY_S))
    before, step = float(rng.uniform(0.0, away)), draw_duration(rng, 1.0, 3600.0)
    lasting = away - before + draw_duration(rng, 1.0, 15.0)

    def strike(t: FaultTarget) -> None:
        def set_clock_back() -> None:
            _step_clock(t, "tap_planner", -step, lasting)

        t.kill("tap_planner", away)
        t.scheduler.after(before, set_clock_back)

    return strike, (
        f"tap_planner killed, restarted after {away:.1f} s; the clock of its computer stepped by"
        f" {-step:.2f} s {before:.1f} s after the crash, and back {lasting:.1f} s later"
    )


def _restart(rng: np.random.Generator, trial: FaultTarget) -> Made:
    node, away = _pick(rng, trial.nodes), draw_duration(rng, 0.2, 5.0)
    return lambda t: t.shut_down(node, away), f"{node} shut down, restarted after {away:.1f} s"


def _deactivate(rng: np.random.Generator, trial: FaultTarget) -> Made:
    node, away = _pick(rng, trial.nodes), draw_duration(rng, 0.05, 5.0)

    def strike(t: FaultTarget) -> None:
        t.processes[node].lifecycle(Deactivated())
        t.scheduler.after(away, lambda: t.processes[node].lifecycle(Activated()))

    return strike, f"{node} deactivated for {away:.2f} s"


LINKS = {
    "arm_state": ("tap_planner", "tapper_trigger"),
    "tapper_state": ("tap_planner", "scara_arm"),
    "object_states": ("tap_planner", "tapper_trigger"),
    "plan_state": ("tapper_trigger",),
    "tap_command": ("scara_arm", "tapper_trigger"),
    "hold_still": ("request", "answer"),
    "emergency_stop": NODES,
}
"""Links that can be slow: for each topic its subscribers, and for each service its two directions
(request and answer)."""


def _slow_topic(rng: np.random.Generator, trial: FaultTarget) -> Made:
    topic = _pick(rng, tuple(LINKS))
    towards = _pick(rng, LINKS[topic])
    delay, lasting = draw_duration(rng, 0.01, 2.0), draw_duration(rng, 0.2, 6.0)

    def strike(t: FaultTarget) -> None:
        t.network.faults.slow[topic, towards] = delay
        t.scheduler.after(lasting, lambda: t.network.end_delay(topic, towards))

    return strike, f"{topic} to {towards} delayed by {delay:.2f} s for {lasting:.1f} s"


def _duplicates(rng: np.random.Generator, trial: FaultTarget) -> Made:
    lasting = draw_duration(rng, 0.5, 8.0)

    def strike(t: FaultTarget) -> None:
        t.network.faults.duplicates = 0.3
        t.scheduler.after(lasting, lambda: setattr(t.network.faults, "duplicates", 0.0))

    return strike, f"a third of all messages delivered twice for {lasting:.1f} s"


def _replay(rng: np.random.Generator, trial: FaultTarget) -> Made:
    topic = _pick(rng, ("tap_command", "arm_state", "tapper_state", "plan_state"))
    back = int(rng.integers(1, 20))

    def strike(t: FaultTarget) -> None:
        kept = t.network.history.get(topic)
        if kept:
            t.network.publish(STRANGER, topic, kept[max(len(kept) - back, 0)])

    return strike, f"an old message repeated on {topic}"


def _foreign_command(rng: np.random.Generator, trial: FaultTarget) -> Made:
    withdraw = bool(rng.random() < 0.6)
    how = int(rng.integers(3))

    def strike(t: FaultTarget) -> None:
        last = max(t.oracle.commands, default=0)
        number = (0, last, last + 1)[how]
        command = TapCommand(
            request=TapCommand.WITHDRAW if withdraw else TapCommand.TAP, tap_id=number
        )
        if not withdraw and last:
            # Copy the object, the poses and the speed of the last command.
            model = t.oracle.commands[last]
            command.object_id = model.object_id
            command.strike_pose, command.striker_speed = model.strike_pose, model.striker_speed
            command.object_pose, command.predicted_pose = model.object_pose, model.predicted_pose
        now = t.clocks["tap_planner"].now().ros
        command.header.frame_id = "table"
        command.header.stamp = to_stamp(now)
        command.expiry = to_stamp(now + int(rng_expiry * 1e9))
        t.network.publish(STRANGER, "tap_command", command)

    rng_expiry = float(rng.uniform(1.0, 30.0))
    name = "WITHDRAW" if withdraw else "TAP"
    tap_id = ("0", "of the current tap", "of the next tap")[how]
    return strike, f"a {name} of another program with id {tap_id}"


def _foreign_outcome(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """Another node falsely reports that the shot is over."""
    fired = bool(rng.random() < 0.5)

    def strike(t: FaultTarget) -> None:
        last = max(t.oracle.commands, default=0)
        _send_outcome(t, last, TapperState.FIRED if fired else TapperState.NOT_FIRED)

    return strike, (
        "another program publishes a tapper_state with the outcome "
        f"{'FIRED' if fired else 'NOT_FIRED'}"
    )


def _foreign_hold(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """Another node requests ``hold_still`` for a tap, then for a shorter time. It may also report
    that the tap is over and withdraw the tap; the arm receives this withdrawal immediately, but the
    tapper receives it late."""
    back, duration = int(rng.integers(0, 2)), float(rng.uniform(0.01, 0.3))
    if rng.random() < SHARE_OF_LONG_HOLDS:
        duration = draw_duration(rng, *LONG_HOLD_S)
    later, late = draw_duration(rng, 0.001, 0.05), float(rng.uniform(0.03, 0.6))
    sends = rng.random() < 0.7
    outcome = TapperState.FIRED if rng.random() < 0.5 else TapperState.NOT_FIRED

    def strike(t: FaultTarget) -> None:
        number = max(max(t.oracle.commands, default=0) - back, 0)
        for after, asked in ((0.0, duration), (later, 0.0)):
            request = HoldStill.Request(tap_id=number, duration=asked)
            t.scheduler.after(after, partial(t.network.call, "hold_still", request, lambda _: None))
        if sends:
            link = ("tap_command", "tapper_trigger")
            t.network.faults.slow[link] = late
            t.scheduler.after(late, partial(t.network.end_delay, *link))
            t.scheduler.after(1.5 * later, partial(leave, t, number))

    def leave(t: FaultTarget, number: int) -> None:
        _send_outcome(t, number, outcome)
        _send_withdrawal(t, number)

    return strike, (
        f"another node requests hold_still for {duration:.3f} s and, {later:.3f} s later, for 0 s"
        + (", then withdraws the tap" if sends else "")
    )


def _foreign_withdrawal(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """Another node withdraws the tap under way."""

    def strike(t: FaultTarget) -> None:
        _send_withdrawal(t, max(t.oracle.commands, default=0))

    return strike, "another program's WITHDRAW of the current tap"


def _send_outcome(trial: FaultTarget, tap_id: int, outcome: int) -> None:
    """Publish an outcome of a tap by a node that is not part of the cell."""
    forged = TapperState(state=TapperState.SAFE, tap_id=tap_id, outcome=outcome)
    forged.header.stamp = to_stamp(trial.clocks["tapper_trigger"].now().ros)
    trial.network.publish(STRANGER, "tapper_state", forged)


def _send_withdrawal(trial: FaultTarget, tap_id: int) -> None:
    """Publish a withdrawal of a tap by a node that is not part of the cell."""
    command = TapCommand(request=TapCommand.WITHDRAW, tap_id=tap_id)
    command.header.frame_id = "table"
    command.header.stamp = to_stamp(trial.clocks["tap_planner"].now().ros)
    trial.network.publish(STRANGER, "tap_command", command)


def _foreign_flood(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """Another node repeats one state or command a hundred times per second. At the end it may also
    withdraw the tap; the tapper then receives the withdrawal late."""
    name = _pick(rng, (*("tapper_state",) * 3, "arm_state", "plan_state", "tap_command"))
    outcome = int(rng.choice((TapperState.NONE, TapperState.NONE, TapperState.NOT_FIRED)))
    number, withdraws = 1 + round(FLOOD_HZ * draw_duration(rng, 0.02, 0.5)), rng.random() < 0.7
    late = float(rng.uniform(0.03, 0.6))

    def strike(t: FaultTarget) -> None:
        last = max(t.oracle.commands, default=0)
        for step in range(number):
            t.scheduler.after(step / FLOOD_HZ, partial(send, t, last))
        if withdraws:
            t.scheduler.after((number - 0.5) / FLOOD_HZ, partial(leave, t, last))

    def leave(t: FaultTarget, last: int) -> None:
        for topic in ("tap_command", "arm_state"):
            t.network.faults.slow[topic, "tapper_trigger"] = late
            t.scheduler.after(late, partial(t.network.end_delay, topic, "tapper_trigger"))
        _send_withdrawal(t, last)

    def send(t: FaultTarget, last: int) -> None:
        message: TapperState | ArmState | PlanState | TapCommand
        if name == "tapper_state":
            message = TapperState(state=TapperState.SAFE, tap_id=last, outcome=outcome)
        elif name == "arm_state":
            message = ArmState(state=ArmState.IN_POSITION, tap_id=last, homed=True)
            if last:
                message.tip_pose = t.oracle.commands[last].strike_pose
        elif name == "plan_state":
            message = PlanState(state=PlanState.FIRING)
        else:
            message = TapCommand(request=TapCommand.WITHDRAW)
        message.header.frame_id = "table"
        node = "tap_planner" if name in ("plan_state", "tap_command") else "scara_arm"
        message.header.stamp = to_stamp(t.clocks[node].now().ros)
        t.network.publish(STRANGER, name, message)

    leaves = ", then withdraws the tap" if withdraws else ""
    return strike, f"another program publishes {name} {number} times at 100 Hz{leaves}"


def _repeated_command(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """The last TAP arrives once more unchanged, replayed from a recording or duplicated by the
    network. Sometimes this happens just after the tapper's process was started again."""
    restarted = rng.random() < 0.3
    away, delay = draw_duration(rng, 0.2, 5.0), draw_duration(rng, 0.01, 3.0)

    def repeat(t: FaultTarget) -> None:
        last = max(t.oracle.commands, default=0)
        if last:
            t.network.publish(STRANGER, "tap_command", t.oracle.commands[last])

    def strike(t: FaultTarget) -> None:
        if restarted:
            t.kill("tapper_trigger", away)
            t.scheduler.after(away + delay, partial(repeat, t))
        else:
            repeat(t)

    description = "the last TAP is repeated"
    if restarted:
        description += (
            f" {delay:.2f} s after tapper_trigger, killed, was restarted after {away:.1f} s"
        )
    return strike, description


def _slow_answer(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """Delay the request and the answer of ``hold_still``, each by up to the tapper's timeout, or
    the answer by more than that."""
    delays = {("hold_still", way): float(rng.uniform(0.0, 0.2)) for way in ("request", "answer")}
    if rng.random() < 0.5:
        delays.pop(("hold_still", _pick(rng, ("request", "answer"))))
    lasting = draw_duration(rng, 0.2, 6.0)
    if rng.random() < SHARE_OF_LOST_ANSWERS:
        delays, lasting = {("hold_still", "answer"): float(rng.uniform(0.5, 2.0))}, 12.0

    def strike(t: FaultTarget) -> None:
        t.network.faults.slow.update(delays)
        for link in delays:
            t.scheduler.after(lasting, partial(t.network.end_delay, *link))

    description = " and ".join(f"{way} by {delay:.3f} s" for (_, way), delay in delays.items())
    return strike, f"hold_still delayed: {description}, for {lasting:.1f} s"


def _received_by_one(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """A message is received by one node immediately, and by all other nodes late."""
    kind = _pick(rng, ONE_SIDED)
    what, description = MAKERS[kind](rng, trial)
    first = _pick(rng, ("scara_arm", *NODES))
    late = float(rng.uniform(0.03, 0.6))
    silent = bool(rng.random() < 0.5)
    links = [
        (topic, node)
        for topic in ("tap_command", "tapper_state", "emergency_stop")
        for node in LINKS[topic]
        if node != first
    ]
    if silent:
        # The messages that arm and planner send to the tapper are late, too.
        links += [("arm_state", "tapper_trigger"), ("plan_state", "tapper_trigger")]

    def strike(t: FaultTarget) -> None:
        for link in links:
            t.network.faults.slow[link] = late
            t.scheduler.after(late, partial(t.network.end_delay, *link))
        what(t)

    echo = "; arm_state and plan_state late too" if silent else ""
    return strike, f"{description}; received {late:.3f} s late by all nodes except {first}{echo}"


def _motors_off(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """The motors of one board lose their power, so that the arm or the spring is no longer where
    its board assumes."""
    if rng.random() < 0.5:
        return lambda t: t.turn_arm_motors_off(), "the arm's motors lose their power"
    lasting = draw_duration(rng, 0.05, 3.0)
    return lambda t: t.turn_tapper_motor_off(lasting), (
        f"the tapper's motor has no power for {lasting:.2f} s"
    )


def _shot_power(rng: np.random.Generator, trial: FaultTarget) -> Made:
    return lambda t: t.interrupt_tapper_power(), "the tapper's board loses power for a moment"


def _shot_cable(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """The tapper's cable fails: bytes are lost or late for some time, or the port disappears."""
    kinds = (FaultKind.DROP, FaultKind.STALL, FaultKind.HANG_UP, FaultKind.DELAY, FaultKind.DELAY)
    kind = kinds[int(rng.integers(len(kinds)))]
    direction = list(Direction)[int(rng.integers(2))]
    length, lasting = int(rng.integers(30, 2000)), draw_duration(rng, 0.02, 1.0)

    def strike(t: FaultTarget) -> None:
        layer = t.physical.tapper_line.layer
        layer.add(LineFault(kind, direction, layer.count(direction), length, lasting))

    return strike, (
        f"tapper line, {direction.value}: {kind.value} "
        + (f"of {length} bytes" if kind is FaultKind.DROP else f"for {lasting:.2f} s")
    )


def _foreign_state(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """Another node publishes that the arm is in position, or that the planner waits for a shot."""
    of_arm = bool(rng.random() < 0.5)

    def strike(t: FaultTarget) -> None:
        last = max(t.oracle.commands, default=0)
        node = "scara_arm" if of_arm else "tap_planner"
        message: ArmState | PlanState = (
            ArmState(
                state=ArmState.IN_POSITION,
                tap_id=last,
                homed=True,
                tip_pose=t.oracle.commands[last].strike_pose if last else Pose3(),
            )
            if of_arm
            else PlanState(state=PlanState.FIRING)
        )
        message.header.stamp = to_stamp(t.clocks[node].now().ros)
        t.network.publish(STRANGER, "arm_state" if of_arm else "plan_state", message)

    return strike, f"a forged {'arm_state: in position' if of_arm else 'plan_state: firing'}"


def _second_arm(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """The arm of another cell in the same ROS domain also offers ``hold_still`` and grants every
    request. The process of the cell's own arm may end at the same time."""
    lasting, alone = draw_duration(rng, 0.2, 6.0), bool(rng.random() < 0.3)

    def strike(t: FaultTarget) -> None:
        if alone:
            t.kill("scara_arm", lasting)

        def grant(request: HoldStill.Request, answer: Callable[[HoldStill.Response], None]) -> None:
            answer(HoldStill.Response(granted=True, duration=request.duration))

        t.network.serve("scara_arm of another cell", "hold_still", grant)
        t.scheduler.after(lasting, partial(t.network.leave, "scara_arm of another cell"))

    killed = ", and the cell's own arm is killed" if alone else ""
    return strike, f"the arm of another cell offers hold_still for {lasting:.1f} s{killed}"


def _second_node(rng: np.random.Generator, trial: FaultTarget) -> Made:
    node, lasting = _pick(rng, trial.nodes), draw_duration(rng, 1.0, 20.0)
    return lambda t: t.start_second(node, lasting), f"a second {node} for {lasting:.1f} s"


def _trajectory(rng: np.random.Generator, trial: FaultTarget) -> Made:
    message = draw_trajectory(rng, trial.joint_names)
    return partial(_send_trajectory, message), (
        f"a joint_trajectory with {len(message.points)} points from another node"
    )


def _invalid_trajectory(rng: np.random.Generator, trial: FaultTarget) -> Made:
    wrong = _pick(rng, WRONG)
    message = draw_trajectory(rng, trial.joint_names, wrong)

    def strike(t: FaultTarget) -> None:
        t.oracle.invalid_trajectories.append((message, wrong))
        _send_trajectory(message, t)

    return strike, f"an invalid joint_trajectory from another node: {wrong}"


def _send_trajectory(message: JointTrajectory, trial: FaultTarget) -> None:
    trial.network.publish(STRANGER, "joint_trajectory", message)


def _fast_trajectory(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """The arm is requested to move as fast as it can, sometimes without an enabling device."""
    without = bool(rng.random() < 0.5)
    joints = [float(v) for v in rng.uniform((-0.5, 0.5, -0.05, -1.0), (1.0, 1.8, 0.0, 1.0))]

    def strike(t: FaultTarget) -> None:
        point = JointTrajectoryPoint(positions=joints)
        message = JointTrajectory(joint_names=list(t.joint_names), points=[point])
        if without:
            t.release_enabling((KEY, SWITCH), False, 2.0)
        send = partial(t.network.publish, STRANGER, "joint_trajectory", message)
        t.scheduler.after(0.5 if without else 0.0, send)

    return strike, "a joint_trajectory without times from another node" + (
        ", after the enabling device was released" if without else ""
    )


def _unreported_trajectory(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """The arm follows another program's trajectory. The planner receives the arm's state too late
    and therefore commands a tap that the arm refuses."""
    follow, description = _trajectory(rng, trial)
    late, lasting = float(rng.uniform(0.1, 0.4)), float(rng.uniform(0.5, 1.0))

    def strike(t: FaultTarget) -> None:
        t.network.faults.slow["arm_state", "tap_planner"] = late
        t.scheduler.after(lasting, partial(t.network.end_delay, "arm_state", "tap_planner"))
        follow(t)

    return strike, f"{description}, which the planner receives {late:.2f} s late"


def _clock_step(rng: np.random.Generator, trial: FaultTarget) -> Made:
    node = _pick(rng, (*trial.nodes, "camera_pose"))
    step = float(rng.choice((-1.0, 1.0))) * draw_duration(rng, 0.01, 3600.0)

    lasting = draw_duration(rng, 0.1, 30.0)

    return lambda t: _step_clock(t, node, step, lasting), (
        f"the clock of {node}'s computer stepped by {step:.2f} s, and back after {lasting:.1f} s"
    )


def _step_clock(trial: FaultTarget, node: str, step: float, lasting: float) -> None:
    """Set the clock of a node's computer forward by ``step`` s, and back after ``lasting`` s."""
    clock = trial.clocks[node]

    def set_back() -> None:
        clock.offset -= step

    clock.offset += step
    trial.scheduler.after(lasting, set_back)


def _line(rng: np.random.Generator, trial: FaultTarget) -> Made:
    name = _pick(rng, ("arm", "tapper"))
    direction = list(Direction)[int(rng.integers(2))]
    drawn = random_fault(rng, direction, 0, 3000 if name == "arm" else 1500)

    def strike(t: FaultTarget) -> None:
        layer = (t.physical.arm_line if name == "arm" else t.physical.tapper_line).layer
        layer.add(replace(drawn, byte=layer.count(direction) + drawn.byte))

    reset = " (the board restarts)" if drawn.kind is FaultKind.RESET else ""
    return strike, f"{name} line: {drawn.kind.value}{reset} after {drawn.byte} bytes"


def _shot_line(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """The tapper's line fails during a shot, at a random byte. A shot takes about 100 bytes in each
    direction."""
    direction = list(Direction)[int(rng.integers(2))]
    drawn = random_fault(rng, direction, 0, 120)

    def strike(t: FaultTarget) -> None:
        layer = t.physical.tapper_line.layer
        layer.add(replace(drawn, byte=layer.count(direction) + drawn.byte))

    return strike, f"tapper line: {drawn.kind.value} after {drawn.byte} bytes of the shot"


def _power(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """A board loses its power for a moment. If the board is unplugged, its port disappears as
    well."""
    name, way = _pick(rng, ("arm", "tapper")), Direction.TO_HOST
    unplugged, lasting = name == "arm" and bool(rng.random() < 0.5), draw_duration(rng, 0.3, 3.0)

    def strike(t: FaultTarget) -> None:
        if name == "tapper":
            t.interrupt_tapper_power()
            return
        if not unplugged:
            t.interrupt_arm_power()
            return
        layer = t.physical.arm_line.layer
        layer.add(LineFault(FaultKind.HANG_UP, way, layer.count(way), 1, lasting))
        t.scheduler.after(0.5 * lasting, t.interrupt_arm_power)

    description = f"the {name}'s board loses power"
    return strike, description + (
        f", and its port is gone for {lasting:.2f} s" if unplugged else ""
    )


UNUSABLE = (
    ErrorCode.CAMERA_NOT_CALIBRATED,
    ErrorCode.IMAGE_INVALID,
    ErrorCode.STAMP_INVALID,
)
"""Error codes of frames that the camera's node cannot use."""


def _camera(rng: np.random.Generator, trial: FaultTarget) -> Made:
    which = _pick(rng, ("lost", "late", "repeated", "hidden", "wrong", "unusable"))
    code = UNUSABLE[int(rng.integers(len(UNUSABLE)))]
    lasting = draw_duration(rng, 0.05, 6.0)
    late_by = draw_duration(rng, 0.02, 1.5)
    off = Pose(float(rng.normal(0, 0.02)), float(rng.normal(0, 0.02)), float(rng.normal(0, 0.3)))

    def strike(t: FaultTarget) -> None:
        faults, until = t.camera.faults, t.scheduler.now + lasting
        if which == "lost":
            faults.lost_until = until
        elif which == "late":
            faults.late_until, faults.late_by = until, late_by
        elif which == "repeated":
            faults.repeated_until = until
        elif which == "hidden":
            t.hide_object(lasting)
        elif which == "unusable":
            faults.unusable_until, faults.unusable_code = until, code
        else:
            # Only one frame has a wrong pose. A single outlier gets little weight when frames are
            # fused, but the same error in several frames could not be detected.
            faults.wrong_until, faults.wrong_by = t.scheduler.now + 1 / 15, off

    return strike, f"frames {which} for {lasting:.2f} s"


def _bump(rng: np.random.Generator, trial: FaultTarget) -> Made:
    return _by_hand(rng, 0.015)


def _turn(rng: np.random.Generator, trial: FaultTarget) -> Made:
    return _by_hand(rng, 0.0)


def _by_hand(rng: np.random.Generator, way: float) -> Made:
    """The object is moved by hand, suddenly or slowly. ``way``: standard deviation of the
    displacement in x and in y, m."""
    shift = Pose(float(rng.normal(0, way)), float(rng.normal(0, way)), float(rng.normal(0, 0.4)))
    lasting = 0.0 if rng.random() < 0.5 else draw_duration(rng, 0.1, 2.0)
    return lambda t: t.move_object(shift, lasting), (
        f"the object is moved by hand by {1e3 * math.hypot(shift.x, shift.y):.0f} mm and"
        f" {math.degrees(shift.theta):.0f} deg within {lasting:.2f} s"
    )


def _emergency_stop(rng: np.random.Generator, trial: FaultTarget) -> Made:
    lasting = draw_duration(rng, 0.2, 5.0)
    return lambda t: t.press_emergency_stop(lasting), f"emergency stop held for {lasting:.1f} s"


def _stop_without_power(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """During an emergency stop, the tapper's board loses its power and with it its stop. Then the
    panel repeats its level."""
    lost, again = float(rng.uniform(0.2, 1.0)), float(rng.uniform(1.8, 3.0))

    def strike(t: FaultTarget) -> None:
        t.press_emergency_stop(again + 1.0)
        t.scheduler.after(lost, t.interrupt_tapper_power)
        t.scheduler.after(again, t.repeat_emergency_stop)

    return strike, (
        f"emergency stop, repeated after {again:.1f} s; the tapper's board loses its power"
        f" {lost:.1f} s after the stop"
    )


def _further_panel(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """The emergency stop of a further panel is pressed. The panel is killed while it is pressed, or
    its publisher is volatile, or both. A killed panel may be started again, released or pressed."""
    volatile = bool(rng.random() < 0.4)
    press = PanelPress(
        draw_duration(rng, 0.05, 5.0),
        volatile,
        vanishes=not volatile or bool(rng.random() < 0.4),
        back_after=draw_duration(rng, 0.1, 10.0) if rng.random() < 0.6 else math.inf,
        again=bool(rng.random() < 0.3),
        stays=draw_duration(rng, 0.5, 30.0),
    )
    kind = "volatile panel" if volatile else "panel"
    end = "killed" if press.vanishes else "released"
    back = ""
    if press.vanishes and math.isfinite(press.back_after):
        state = "pressed" if press.again else "released"
        back = f", back after {press.back_after:.1f} s and {state}"
    return lambda t: t.press_further_panel(press), (
        f"emergency stop of a further {kind}, {end} after {press.held:.1f} s{back}"
    )


def _service_stop(rng: np.random.Generator, trial: FaultTarget) -> Made:
    node = _pick(rng, (trial.arm_node, "tapper_trigger"))
    return lambda t: t.call_stop(node), f"service stop of {node}"


def _stop_and_reset(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """Somebody stops a device, and soon afterwards somebody clears the stop without looking whether
    a goal is under way. Sometimes the planner is frozen meanwhile, or has crashed."""
    node, after = _pick(rng, (trial.arm_node, "tapper_trigger")), draw_duration(rng, 0.3, 6.0)
    share = rng.random()
    frozen = 0.0 if share < 0.7 else float(rng.uniform(0.0, 5.0))
    away = after + float(rng.uniform(0.5, 8.0)) if share < SHARE_OF_STOPS_UNSEEN else 0.0

    def strike(t: FaultTarget) -> None:
        if frozen:
            t.freeze("tap_planner", frozen)
        if away:
            t.kill("tap_planner", away)
        t.call_stop(node)
        t.scheduler.after(after, partial(t.reset, node), in_main=True)

    description = f"service stop of {node}, cleared after {after:.2f} s"
    if frozen:
        description += f", tap_planner frozen for {frozen:.2f} s"
    if away:
        description += f", tap_planner killed just before, restarted after {away:.1f} s"
    return strike, description


def _stop_at_the_cell(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """Somebody presses the stop button that is wired to the tapper's board."""
    share = float(rng.random())

    def strike(t: FaultTarget) -> None:
        t.press_stop_button(share)

    return strike, "the stop button at the tapper's board is pressed"


def _invalid_goal(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """Another client publishes a goal with one wrong field, which the planner must refuse."""
    wrong, pose = draw_wrong_goal(rng), trial.draw_goal(rng)

    def strike(t: FaultTarget) -> None:
        message = PoseStamped(pose=to_message(pose))
        message.header.frame_id = "table"
        wrong.spoil(message, t.clocks["tap_planner"].now().ros)
        t.network.publish(STRANGER, "goal_pose", message)

    return strike, f"an invalid goal of another client: {wrong.name}"


def _interlock(rng: np.random.Generator, trial: FaultTarget) -> Made:
    lasting = draw_duration(rng, 0.05, 4.0)

    def strike(t: FaultTarget) -> None:
        t.physical.set_interlock(False)
        t.scheduler.after(lasting, lambda: t.physical.set_interlock(True))

    return strike, f"guard open for {lasting:.2f} s"


def _enabling_released(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """A person releases the enabling devices of set-up mode, or one of them, and holds them again
    before anybody has cleared the arm's stop."""
    devices = ((KEY, SWITCH), (KEY, SWITCH), (KEY,), (SWITCH,))[int(rng.integers(4))]
    silent, away = bool(rng.random() < 0.5), draw_duration(rng, 0.05, 5.0)

    def strike(t: FaultTarget) -> None:
        t.release_enabling(devices, silent, away)

    return strike, (
        f"{' and '.join(devices)} released for {away:.2f} s"
        + (", without a last message" if silent else "")
    )


def _enabling_late(rng: np.random.Generator, trial: FaultTarget) -> Made:
    towards = _pick(rng, ("scara_arm", "tapper_trigger"))
    delay, lasting = draw_duration(rng, 0.05, 2.0), draw_duration(rng, 0.2, 6.0)

    def strike(t: FaultTarget) -> None:
        t.network.faults.slow["enabling", towards] = delay
        t.scheduler.after(lasting, lambda: t.network.end_delay("enabling", towards))

    return strike, f"the key's messages to {towards} delayed by {delay:.2f} s for {lasting:.1f} s"


def _ask_changed(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """A person no longer wants to confirm every tap, and soon wants it again."""
    after = draw_duration(rng, 0.05, 8.0)

    def strike(t: FaultTarget) -> None:
        t.change_ask(False)
        t.scheduler.after(after, lambda: t.change_ask(True))

    return strike, f"the planner asks before no tap for {after:.2f} s"


def _camera_away(rng: np.random.Generator, trial: FaultTarget) -> Made:
    """The camera's node ends for about the time for which a confirmation remains valid."""
    away = float(rng.uniform(5.0, 26.0))

    def strike(t: FaultTarget) -> None:
        t.kill("camera_pose", away)

    return strike, f"camera_pose killed, restarted after {away:.1f} s"


def _cancel(rng: np.random.Generator, trial: FaultTarget) -> Made:
    return lambda t: t.cancel_goal(), "the goal is cancelled"


def _cancel_by_service(rng: np.random.Generator, trial: FaultTarget, raises_after: int = 0) -> Made:
    """A person ends the present goal by the planner's service: the goal of the action client, that
    of another client, or that of a planner that was killed shortly before. After its restart, this
    planner may be activated late. ``raises_after``: number of lines after which the planner raises
    an exception while it handles the request; 0 if it does not raise."""
    which = _pick(rng, ("own", "own", "crashed", "second client's"))
    away, later = draw_duration(rng, 0.2, 5.0), float(rng.uniform(0.05, 6.0))
    inactive = float(rng.uniform(0.5, 8.0)) if rng.random() < 0.5 else 0.0
    goal = trial.draw_goal(rng) if which == "second client's" else None

    def cancel(t: FaultTarget) -> None:
        if raises_after:
            t.plant_exception("tap_planner", raises_after)
        t.cancel_by_service()

    def strike(t: FaultTarget) -> None:
        if which == "own":
            cancel(t)
            return
        if goal is not None:
            t.send_goal(goal, foreign=True)
        else:
            t.processes["tap_planner"].activation_delay = inactive
            t.kill("tap_planner", away)
        t.scheduler.after(later if goal is not None else away + later, lambda: cancel(t))

    raising = f", which raises an exception after {raises_after} lines" if raises_after else ""
    if which == "own":
        return strike, f"the service ~/cancel is called{raising}"
    before = "a second client sends another goal" if goal is not None else "tap_planner killed"
    after = later if goal is not None else away + later
    return strike, f"{before}; the service ~/cancel is called {after:.2f} s later{raising}"


def _second_client(rng: np.random.Generator, trial: FaultTarget) -> Made:
    goal = trial.draw_goal(rng)
    return lambda t: t.send_goal(goal, foreign=True), "a second client sends another goal"


def _exception(rng: np.random.Generator, trial: FaultTarget) -> Made:
    return _exception_in(_pick(rng, trial.nodes), rng, trial)


def _exception_in_planner(rng: np.random.Generator, trial: FaultTarget) -> Made:
    return _exception_in("tap_planner", rng, trial)


def _exception_in(node: str, rng: np.random.Generator, trial: FaultTarget) -> Made:
    """A handler or a job of a node raises an exception at a random line of its code, of a random
    method of its state machine, or while the node handles a request."""
    share = rng.random()
    if share < 0.25:
        return _exception_in_request(node, rng, trial)
    function, longest = "", 3000.0
    if share > 0.5:
        function, longest = _pick(rng, (DECIDING if share > 0.7 else METHODS)[node]), 100.0
    lines = round(draw_duration(rng, 1.0, longest))
    where = f" of {function}" if function else ""
    return (
        lambda t: t.plant_exception(node, lines, function),
        f"{node} raises an exception after {lines} lines{where}",
    )


def _exception_in_request(node: str, rng: np.random.Generator, trial: FaultTarget) -> Made:
    lines, resets = round(draw_duration(rng, 1.0, 100.0)), bool(rng.random() < 0.5)
    if node == "tap_planner":
        # The record of the tap that the request ends takes 70 lines, and the report more.
        lines = round(rng.uniform(1.0, 200.0)) if resets else lines
        return _cancel_by_service(rng, trial, lines)

    def strike(t: FaultTarget) -> None:
        t.plant_exception(node, lines)
        if resets:
            t.reset(node)
        else:
            t.call_stop(node)

    request = "reset" if resets else "stop"
    return strike, f"{node} raises an exception after {lines} lines of a request to {request}"


def _disk_full(rng: np.random.Generator, trial: FaultTarget) -> Made:
    def strike(t: FaultTarget) -> None:
        t.processes["tap_planner"].disk.full = True
        t.scheduler.after(20.0, lambda: setattr(t.processes["tap_planner"].disk, "full", False))

    return strike, "the planner's disk is full for 20 s"


MAKERS: dict[str, Maker] = {
    "freeze": _freeze,
    "freeze at a shot": _freeze_at_shot,
    "freeze before a write": _freeze_before_write,
    "freeze at a write": _freeze_at_write,
    "freeze after the last check": _freeze_after_check,
    "kill": _kill,
    "restart": _restart,
    "deactivate": _deactivate,
    "slow topic": _slow_topic,
    "duplicates": _duplicates,
    "replay": _replay,
    "foreign command": _foreign_command,
    "foreign withdrawal": _foreign_withdrawal,
    "foreign outcome": _foreign_outcome,
    "foreign hold": _foreign_hold,
    "foreign flood": _foreign_flood,
    "repeated command": _repeated_command,
    "received by one": _received_by_one,
    "slow answer": _slow_answer,
    "foreign state": _foreign_state,
    "second node": _second_node,
    "second arm": _second_arm,
    "foreign trajectory": _trajectory,
    "invalid trajectory": _invalid_trajectory,
    "invalid goal": _invalid_goal,
    "stop at the cell": _stop_at_the_cell,
    "unreported trajectory": _unreported_trajectory,
    "clock step": _clock_step,
    "serial line": _line,
    "line at a shot": _shot_line,
    "cable at a shot": _shot_cable,
    "power at a shot": _shot_power,
    "loss of power": _power,
    "motors off": _motors_off,
    "camera": _camera,
    "object moved": _bump,
    "object turned": _turn,
    "emergency stop": _emergency_stop,
    "stop without power": _stop_without_power,
    "further panel": _further_panel,
    "stop service": _service_stop,
    "stop and reset": _stop_and_reset,
    "guard": _interlock,
    "cancel": _cancel,
    "cancel by service": _cancel_by_service,
    "second client": _second_client,
    "disk full": _disk_full,
    "exception": _exception,
    "exception in the planner": _exception_in_planner,
}
KINDS = tuple(MAKERS)
SET_UP_MAKERS: dict[str, Maker] = {
    "enabling device released": _enabling_released,
    "enabling messages delayed": _enabling_late,
    "fast trajectory": _fast_trajectory,
}
"""Additional kinds of faults of a cell in set-up mode."""
ASK_MAKERS: dict[str, Maker] = {"ask changed": _ask_changed, "camera away": _camera_away}
"""Additional kinds of faults of a cell that asks a person before every tap."""
MODE_SHARE = 8
"""How often each additional kind is listed among the kinds of faults around a shot."""
ONE_SIDED = (
    *("foreign withdrawal", "foreign outcome") * 3,
    *("foreign command", "cancel", "emergency stop", "replay"),
)
"""Kinds of faults that send messages. In the fault "received by one", a node receives such a
message much earlier than all others."""
AT_A_SHOT = (
    *("freeze at a shot", "freeze at a write", "freeze after the last check") * 2,
    "freeze at a shot",
    "freeze",
    *("slow answer", "received by one") * 3,
    *("foreign outcome", "foreign command", "repeated command", "foreign state") * 2,
    *("line at a shot", "cable at a shot", "power at a shot") * 2,
    *("object moved", "foreign withdrawal") * 2,
    "slow topic",
    "kill",
    "restart",
    "motors off",
    "deactivate",
    "cancel",
    "cancel by service",
    "camera",
    "emergency stop",
    "further panel",
    "stop service",
    "stop at the cell",
    "stop and reset",
    "guard",
    "clock step",
    "duplicates",
    "second client",
    "object turned",
    *("exception", "exception in the planner"),
    *("foreign trajectory", "foreign hold", "foreign flood", "second arm") * 2,
)
"""Kinds of faults around a shot. Some kinds are listed several times, so that they are drawn more
often, because these kinds make two nodes observe different states."""
