"""Computers with different clocks: a few ms have no effect; a difference of seconds is refused, and
the refusal states it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from logic_parts import alone

from tapping_cell.logic.cell_monitor import NAMES, QUICKEST_IMAGE_S, CellMonitor
from tapping_cell.logic.clock import NANOSECONDS, Now, to_stamp
from tapping_cell.logic.peer_clock import SKEW_LIMIT_S
from tapping_cell.logic.poses import to_message
from tapping_cell.logic.tapper_peers import Mounts, PeerLimits, TapperPeers
from tapping_cell.messages import (
    ArmState,
    ErrorCode,
    ObjectState,
    ObjectStates,
    PlanState,
    TapperState,
    Time,
)
from tapping_cell.se2 import Pose

EPOCH = 1_795_000_000.0
"""ROS time of this computer at steady time 0, s."""


def at(steady: float) -> Now:
    return Now(steady, round((EPOCH + steady) * NANOSECONDS))


def stamp_of(
    message: ArmState | ObjectState | PlanState | TapperState, taken: float, ahead: float
) -> None:
    """Stamp a message at the true time ``taken`` with a clock that is ``ahead`` s ahead of this
    computer's clock."""
    message.header.stamp = to_stamp(round((EPOCH + taken + ahead) * NANOSECONDS))


def seen(taken: float, ahead: float) -> ObjectState:
    made = ObjectState(visible=True, at_rest=True, frames_fused=30)
    stamp_of(made, taken, ahead)
    return made


def arrivals(delays: list[float]) -> list[tuple[float, float]]:
    """Return for each image the times at which it is taken and received; messages arrive in
    order."""
    times: list[tuple[float, float]] = []
    for number, delay in enumerate(delays):
        taken = number / 30
        times.append((taken, max(times[-1][1] if times else 0.0, taken + delay)))
    return times


def monitor_with(ahead: float, delays: list[float]) -> tuple[CellMonitor, float]:
    """Return the monitor of a cell that is ready and has published for a while, and the time of the
    last reception."""
    monitor = CellMonitor(silence_limit=0.5)
    received = 0.0
    for taken, received in arrivals(delays):
        monitor.on_objects(alone(seen(taken, ahead)), at(received))
    arm = ArmState(state=ArmState.IDLE, clear_of_camera=True)
    monitor.on_arm(arm, at(received))
    monitor.on_tapper(TapperState(state=TapperState.SAFE, interlock_closed=True), at(received))
    return monitor, received


def shown_skew(sentence: str) -> float:
    """Return the clock difference that a message states, rounded to 0.01 s."""
    shown = re.search(r"([-+]\d+\.\d\d) s", sentence)
    assert shown is not None
    return float(shown[1])


DELAYS = st.lists(st.floats(0.0, 0.1), min_size=30, max_size=60)


@given(st.floats(-0.38, 0.38), DELAYS)
def test_clock_offsets_within_the_budget_block_nothing(ahead: float, delays: list[float]) -> None:
    monitor, now = monitor_with(ahead, delays)
    assert monitor.why_not_ready(at(now)) is None


@given(st.floats(0.65, 3600.0), st.sampled_from([-1.0, 1.0]), DELAYS)
def test_clock_offsets_beyond_the_budget_are_refused_with_the_values(ahead, sign, delays):
    monitor, now = monitor_with(sign * ahead, delays)
    missing = monitor.why_not_ready(at(now))
    assert missing is not None and missing[0] == ErrorCode.CLOCKS_DIFFER
    least = min(received - taken for taken, received in arrivals(delays))
    assert shown_skew(missing[1]) == pytest.approx(-sign * ahead + least, abs=0.011)
    assert f"limit {SKEW_LIMIT_S:.2f} s" in missing[1] and "synchronise" in missing[1]


@given(st.floats(0.65, 3600.0), st.sampled_from([-1.0, 1.0]), st.sampled_from(["arm", "tapper"]))
def test_the_planner_names_the_driver_whose_clock_is_off(ahead, sign, who):
    monitor, now = monitor_with(0.0, [0.0] * 30)
    state: ArmState | TapperState = ArmState(state=ArmState.IDLE, clear_of_camera=True)
    receive: Callable[..., None] = monitor.on_arm
    if who == "tapper":
        state = TapperState(state=TapperState.SAFE, interlock_closed=True)
        receive = monitor.on_tapper
    stamp_of(state, now, sign * ahead)
    receive(state, at(now))
    missing = monitor.why_not_ready(at(now))
    assert missing is not None and missing[0] == ErrorCode.CLOCKS_DIFFER
    assert NAMES[who] in missing[1]
    assert shown_skew(missing[1]) == pytest.approx(-sign * ahead, abs=0.011)


@given(
    ahead=st.floats(-0.4, 0.4),
    delays=st.lists(st.floats(0.0, 0.3), min_size=30, max_size=60),
    arm_delay=st.floats(0.0, 0.1),
    withdrawn=st.floats(0.0, 2.0),
)
def test_observations_before_the_withdrawal_do_not_count_as_later_ones(
    ahead: float, delays: list[float], arm_delay: float, withdrawn: float
) -> None:
    monitor = CellMonitor(silence_limit=0.5)
    reported = withdrawn + arm_delay
    received, least = 0.0, math.inf
    for number, delay in enumerate(delays):
        taken = number / 30
        received = max(received, taken + delay)
        least = min(least, received - taken)
        monitor.on_objects(alone(seen(taken, ahead)), at(received))
        # Images taken before the withdrawal are certain to be refused only if the delay of the
        # fastest image is at most QUICKEST_IMAGE_S longer than that of the arm's message.
        bounded = least <= arm_delay + QUICKEST_IMAGE_S
        if bounded and monitor.usable(reported, 10, at(received)):
            assert taken > withdrawn - 1e-6


@given(st.floats(1.0, 3600.0))
def test_images_that_seem_old_after_a_clock_step_are_reported_as_differing_clocks(step):
    """The clock of the only computer is set back."""
    monitor, received = monitor_with(0.0, [0.01] * 30)
    now = Now(received + 0.1, at(received + 0.1 - step).ros)
    monitor.on_objects(alone(seen(received + 0.09, -step)), now)
    code, sentence = monitor.why_not_observed(10.0, 10, now)
    assert code == ErrorCode.CLOCKS_DIFFER, sentence


@given(st.floats(0.1, 3600.0))
def test_an_image_from_the_future_does_not_hide_that_its_object_vanished(ahead: float) -> None:
    monitor, received = monitor_with(0.0, [0.01] * 30)
    monitor.watch("disk")
    for visible, offset in ((True, ahead), (False, 0.0)):
        state = replace(seen(received, offset), object_id="disk", visible=visible)
        monitor.on_objects(ObjectStates(objects=[state]), at(received))
    assert monitor.unseen_for(at(received + 5.0)) == pytest.approx(5.0)


@given(
    st.floats(-0.4, 0.4),
    st.floats(-0.4, 0.4),
    st.lists(st.floats(0.0, 0.05), min_size=20, max_size=40),
)
def test_a_tapper_fires_whichever_clock_is_ahead(arm_ahead, camera_ahead, delays):
    peers = TapperPeers(PeerLimits())
    peers.begin_tap("", 0.0)
    received = 0.0
    for number, delay in enumerate(delays):
        taken = number / 20
        received = max(received, taken + delay)
        arm = ArmState(state=ArmState.IN_POSITION, tap_id=7)
        stamp_of(arm, taken, arm_ahead)
        peers.on_arm_state(arm, at(received))
        plan = PlanState(state=PlanState.FIRING)
        stamp_of(plan, taken, 0.0)
        peers.on_plan_state(plan, at(received))
        peers.on_object_states(alone(seen(taken, camera_ahead)), at(received))
    assert peers.check_firing(7, Pose(0.0, 0.0, 0.0), Pose(0.0, 0.0, 0.0), at(received)) is None


@pytest.mark.parametrize("stamped", [True, False])
@pytest.mark.parametrize("late", ["arm", "planner", "camera"])
@given(delay=st.floats(0.0, 0.5), waited=st.floats(0.0, 0.5))
@example(delay=0.25, waited=0.25)
def test_a_message_is_as_old_as_its_stamp_or_without_a_stamp_as_its_arrival(
    late: str, delay: float, waited: float, stamped: bool
) -> None:
    """One peer's last message waits ``delay`` s in a queue, and the tap is checked ``waited`` s
    after its arrival. The other peers are prompt."""
    peers, here, limits = (
        TapperPeers(PeerLimits(unseen=math.inf)),
        Pose(0.0, 0.0, 0.0),
        PeerLimits(),
    )
    peers.begin_tap("", 0.0)

    def send(who: str, taken: float, received: float, stamped: bool = True) -> None:
        arm = ArmState(state=ArmState.IN_POSITION, tap_id=7)
        message, receive = {
            "arm": (arm, peers.on_arm_state),
            "planner": (PlanState(state=PlanState.FIRING), peers.on_plan_state),
            "camera": (
                seen(0.0, 0.0),
                lambda state, now: peers.on_object_states(alone(state), now),
            ),
        }[who]
        message.header.stamp = Time()
        if stamped:
            stamp_of(message, taken, 0.0)
        receive(message, at(received))

    for who in ("arm", "planner", "camera"):
        send(who, 1.0, 1.0)  # from now on, the delay of each peer is known to be 0
    arrival = 2.0 + delay
    for who in ("arm", "planner", "camera"):
        taken = 2.0 if who == late else arrival + waited
        send(who, taken, arrival if who == late else taken, stamped or who != late)
    limit, code = {
        "arm": (limits.arm_freshness, ErrorCode.TAPPER_ARM_NOT_IN_POSITION),
        "planner": (limits.silence, ErrorCode.NOT_READY),
        "camera": (limits.silence, ErrorCode.CAMERA_SILENT),
    }[late]
    age = waited + (delay if stamped else 0.0)
    assume(abs(age - limit) > 1e-6)
    reason = peers.check_firing(7, here, here, at(arrival + waited))
    assert (reason[0] if reason else ErrorCode.NONE) == (code if age > limit else ErrorCode.NONE)


@pytest.mark.parametrize("needed", [True, False])
def test_a_tapper_that_needs_a_camera_waits_for_its_first_image(needed: bool) -> None:
    """A tapper that is restarted while the camera is missing must not fire at an object that it has
    never seen."""
    peers, here = TapperPeers(PeerLimits(needs_camera=needed)), Pose(0.0, 0.0, 0.0)
    peers.begin_tap("", 0.0)
    arm = ArmState(state=ArmState.IN_POSITION, tap_id=7)
    stamp_of(arm, 1.0, 0.0)
    peers.on_arm_state(arm, at(1.0))
    for check in (peers.check_charging, peers.check_firing):
        reason = check(7, here, here, at(1.0))
        assert (reason is not None and reason[0] == ErrorCode.CAMERA_SILENT) == needed
    blind = seen(1.0, 0.0)
    blind.error_code = ErrorCode.IMAGE_INVALID
    peers.on_object_states(alone(blind), at(1.0))
    assert (peers.check_firing(7, here, here, at(1.0)) is not None) == needed
    peers.on_object_states(alone(seen(1.0, 0.0)), at(1.0))
    assert peers.check_firing(7, here, here, at(1.0)) is None


@pytest.mark.parametrize(
    "code",
    [
        ErrorCode.CAMERA_SILENT,
        ErrorCode.CAMERA_NOT_CALIBRATED,
        ErrorCode.IMAGE_INVALID,
        ErrorCode.STAMP_INVALID,
    ],
)
def test_an_image_that_cannot_be_measured_is_no_message_of_the_camera(code: int) -> None:
    peers, here = watching(""), Pose(0.0, 0.0, 0.0)
    for taken in (1.2, 1.5):
        arm = ArmState(state=ArmState.IN_POSITION, tap_id=7)
        stamp_of(arm, taken, 0.0)
        peers.on_arm_state(arm, at(taken))
        peers.on_object_states(alone(replace(seen(taken, 0.0), error_code=code)), at(taken))
    reason = peers.check_firing(7, here, here, at(1.5))
    assert reason is not None and reason[0] == ErrorCode.CAMERA_SILENT


def test_the_planners_last_tap_does_not_count_for_the_next_one() -> None:
    """Another program commands the next tap while the planner is idle."""
    peers = TapperPeers(PeerLimits())
    for state in (PlanState.FIRING, PlanState.IDLE):
        peers.begin_tap("", 0.0)
        peers.on_plan_state(PlanState(state=state), at(1.0))
        assert peers.abandonment_error() is None
    peers.on_plan_state(PlanState(state=PlanState.PLACING), at(1.1))
    peers.on_plan_state(PlanState(state=PlanState.IDLE), at(1.2))
    assert peers.abandonment_error() is not None


@given(st.sampled_from(["arm", "camera"]), st.floats(0.65, 3600.0))
def test_a_tapper_names_the_computer_whose_clock_is_off(who: str, ahead: float) -> None:
    peers = TapperPeers(PeerLimits())
    peers.begin_tap("", 0.0)
    for number in range(30):
        taken = number / 20
        arm = ArmState(state=ArmState.IN_POSITION, tap_id=7)
        stamp_of(arm, taken, ahead if who == "arm" else 0.0)
        peers.on_arm_state(arm, at(taken))
        peers.on_object_states(alone(seen(taken, ahead if who == "camera" else 0.0)), at(taken))
    reason = peers.check_firing(7, Pose(0.0, 0.0, 0.0), Pose(0.0, 0.0, 0.0), at(29 / 20))
    assert reason is not None and reason[0] == ErrorCode.CLOCKS_DIFFER
    assert who in reason[1]
    assert shown_skew(reason[1]) == pytest.approx(-ahead, abs=0.011)


def watching(object_id: str) -> TapperPeers:
    """Return the peers of a tap whose arm is in position and whose camera sends images."""
    peers = TapperPeers(PeerLimits())
    peers.begin_tap(object_id, 0.0)
    arm = ArmState(state=ArmState.IN_POSITION, tap_id=7)
    stamp_of(arm, 1.0, 0.0)
    peers.on_arm_state(arm, at(1.0))
    peers.on_object_states(alone(seen(1.0, 0.0)), at(1.0))
    return peers


def see(peers: TapperPeers, taken: float, x: float, received: float) -> None:
    """Pass the state of the object ``disk`` to the tapper."""
    state = seen(taken, 0.0)
    state.object_id, state.pose.pose = "disk", to_message(Pose(x, 0.0, 0.0))
    peers.on_object_states(alone(state), at(received))


@pytest.mark.parametrize("taken", [1.05, 1.1])
def test_a_late_message_does_not_hide_that_the_object_was_moved(taken: float) -> None:
    """A message of an image at ``taken`` arrives after one of a later image, or is repeated."""
    peers, here = watching("disk"), Pose(0.0, 0.0, 0.0)
    see(peers, 1.05, 0.0, 1.05)
    assert peers.check_firing(7, here, here, at(1.06)) is None
    see(peers, 1.1, 0.01, 1.1)
    see(peers, taken, 0.01 if taken == 1.1 else 0.0, 1.12)
    reason = peers.check_firing(7, here, here, at(1.12))
    assert reason is not None and reason[0] == ErrorCode.OBJECT_MOVED


def test_the_pose_of_an_object_that_is_not_seen_does_not_count() -> None:
    peers, here = watching(""), Pose(0.0, 0.0, 0.0)
    hidden = replace(seen(1.1, 0.0), visible=False)
    wrong = replace(seen(1.1, 0.0), error_code=ErrorCode.OBJECT_MOVED)
    for state in (hidden, wrong):
        state.pose.pose = to_message(Pose(0.01, 0.0, 0.0))
        peers.on_object_states(alone(state), at(1.1))
    assert peers.check_firing(7, here, here, at(1.11)) is None


@given(st.booleans(), st.booleans(), st.sampled_from([(), ("west",)]), st.booleans())
def test_a_fixed_tapper_needs_its_mounts_and_all_other_conditions(fitted, proven, away, waits):
    peers, here = TapperPeers(PeerLimits()), Pose(0.0, 0.0, 0.0)
    peers.use_mounts(Mounts(proven, fitted, away))
    peers.begin_tap("", 0.0)
    for state in (PlanState.FIRING, PlanState.FIRING if waits else PlanState.IDLE):
        peers.on_plan_state(PlanState(state=state), at(1.0))
    wanted = {ErrorCode.NOT_READY} if not waits else {ErrorCode.NONE}
    if away or not (fitted and proven):
        wanted = {ErrorCode.TAPPER_MOUNT_NOT_PROVEN}
    if fitted and away:
        wanted = {ErrorCode.TAPPER_STRIKER_AWAY}
    for check in (peers.check_charging, peers.check_firing):
        assert {(check(7, here, here, at(1.0)) or (ErrorCode.NONE,))[0]} == wanted


def test_an_object_that_is_moved_after_the_cameras_clock_was_set_back_is_not_struck() -> None:
    peers, here = watching("disk"), Pose(0.0, 0.0, 0.0)
    see(peers, 1.05, 0.0, 1.05)
    see(peers, 0.78, 0.01, 1.08)  # the clock was set back by 0.3 s just before this image
    reason = peers.check_firing(7, here, here, at(1.09))
    assert reason is not None and reason[0] == ErrorCode.OBJECT_MOVED


def test_a_message_from_the_future_blocks_later_messages_only_briefly() -> None:
    peers, here = watching("disk"), Pose(0.0, 0.0, 0.0)
    see(peers, 100.0, 0.01, 1.05)
    received = 1.05
    while received < 13.0:
        received += 0.05
        peers.on_object_states(alone(seen(received, 0.0)), at(received))
        see(peers, received, 0.0, received)
    arm = ArmState(state=ArmState.IN_POSITION, tap_id=7)
    stamp_of(arm, received, 0.0)
    peers.on_arm_state(arm, at(received))
    assert peers.check_firing(7, here, here, at(received)) is None
