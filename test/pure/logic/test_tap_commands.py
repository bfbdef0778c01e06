"""A tap command names its tapper. In a cell with only one tapper, the name may be empty."""

from __future__ import annotations

import math
from functools import reduce

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from logic_parts import board_reply

from tapping_cell.configuration.cell import load_cell
from tapping_cell.hardware.tapper_protocol import State
from tapping_cell.logic import tap_commands
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.effects import Publish
from tapping_cell.logic.host import Activated, Configured
from tapping_cell.logic.tapper import TapperLogic, TapperOptions
from tapping_cell.logic.tapper_commands import ReceivedCommands
from tapping_cell.messages import ErrorCode, TapCommand, TapperState

NAMES = st.lists(st.text("abc123", min_size=1, max_size=4), min_size=1, max_size=12, unique=True)


@given(names=NAMES, name=st.text("abc123", max_size=4))
def test_a_name_selects_exactly_that_tapper_or_none(names: list[str], name: str) -> None:
    found = tap_commands.named_tapper(name, names)
    if name in names:
        assert found == name
    elif name == "" and len(names) == 1:
        assert found == names[0]
    else:
        assert found is None
        code, sentence = tap_commands.unknown_tapper(name, names)
        assert code == ErrorCode.TAPPER_UNKNOWN
        assert all(f"'{known}'" in sentence for known in names)


NOW = Now(steady=100.0, ros=10**18)
CLOCK = 10**9
"""Time of ``NOW`` in whole seconds."""


def tap(tap_id: int, stamp: int = 0) -> TapCommand:
    """Return a valid command."""
    command = TapCommand(tap_id=tap_id, striker_speed=0.3)
    command.header.frame_id = "table"
    command.header.stamp = to_stamp(stamp)
    command.expiry = to_stamp(NOW.ros + 10**9)
    command.strike_pose.orientation.w = 1.0
    return command


@given(st.floats(0.0, 10.0) | st.floats(0.98, 1.02))
@example(0.991)
@example(1.009)
@example(0.989)
@example(1.011)
def test_the_quaternion_of_a_strike_pose_is_normalised_within_a_hundredth(norm: float) -> None:
    command = tap(1)
    command.strike_pose.orientation.w = norm
    refused = tap_commands.refusal(command, NOW, 0)
    if abs(norm - 1.0) < 0.0099:
        assert refused is None
    elif abs(norm - 1.0) > 0.0101:
        assert refused is not None and refused[0] == ErrorCode.COMMAND_INVALID
        assert "quaternion" in refused[1]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["striker_speed", "strike_pose.position.x"])
def test_a_number_that_is_not_finite_is_refused(name: str, value: float) -> None:
    command = tap(1)
    *path, last = name.split(".")
    setattr(reduce(getattr, path, command), last, value)
    refused = tap_commands.refusal(command, NOW, 0)
    assert refused is not None and refused[0] == ErrorCode.COMMAND_INVALID
    assert "not finite" in refused[1]


def test_the_message_of_a_late_command_says_how_late_it_is() -> None:
    late = Now(steady=NOW.steady, ros=NOW.ros + 10**9 + 2_500_000_000)
    assert tap_commands.expired(tap(1), late)
    assert "2.5 s ago" in tap_commands.expiry_message(tap(1), late)


@pytest.mark.parametrize("used", [None, CLOCK - 100])
@pytest.mark.parametrize("awaits_outcome", [True, False])
def test_a_refused_command_takes_no_effect_later(awaits_outcome: bool, used: int | None) -> None:
    """A copy may arrive after the outcome of the tap before it is known."""
    received = ReceivedCommands()
    command = tap(CLOCK, stamp=NOW.ros)
    assert received.refusal(command, used, NOW) is None
    reported = received.note_refused(command, used, awaits_outcome, NOW)
    assert reported == (not awaits_outcome)
    refused = received.refusal(command, used, NOW)
    assert refused is not None and refused[0] == ErrorCode.COMMAND_REPEATED
    # While the tap before it has no outcome, the id of the refused tap is not used up.
    assert received.last_tap_id == (0 if awaits_outcome else CLOCK)
    again = received.refusal(tap(CLOCK, stamp=NOW.ros + 1), used, NOW)
    assert (again is None) == awaits_outcome


def test_ids_that_were_used_or_are_too_large_are_not_stored() -> None:
    received = ReceivedCommands()
    received.last_tap_id = CLOCK
    for tap_id in (CLOCK - 1, CLOCK, CLOCK + 2**28 + 1):
        assert not received.note_refused(tap(tap_id), None, awaits_outcome=False, now=NOW)
        assert received.last_tap_id == CLOCK
    # The board's count of shots raises the largest id.
    assert received.note_refused(tap(CLOCK + 2**28 + 1), CLOCK + 1, awaits_outcome=False, now=NOW)


def test_a_shot_number_of_the_board_is_never_used_again() -> None:
    """After a restart of the node, only the board knows the last tap."""
    for used, code in ((None, ErrorCode.NONE), (CLOCK, ErrorCode.COMMAND_REPEATED)):
        refused = ReceivedCommands().refusal(tap(CLOCK), used, NOW)
        assert (refused or (ErrorCode.NONE,))[0] == code


@pytest.mark.parametrize(
    ("valid", "ahead", "above", "code"),
    [
        (899.0, 0.9, 1, ErrorCode.NONE),
        (901.0, 0.0, 1, ErrorCode.COMMAND_INVALID),
        (1.0, 1.1, 1, ErrorCode.STAMP_INVALID),
        (1.0, 0.0, 2**28, ErrorCode.NONE),
        (1.0, 0.0, 2**28 + 1, ErrorCode.COMMAND_INVALID),
        (1.0, 0.0, 0, ErrorCode.COMMAND_REPEATED),
        (1.0, 0.0, -1, ErrorCode.COMMAND_REPEATED),
    ],
)
def test_a_command_is_refused_beyond_its_limits_of_time_and_id(valid, ahead, above, code):
    """Times in s; ``above``: distance of the id from the last id, which exceeds the clock."""
    last = 2 * CLOCK
    command = tap(last + above, stamp=NOW.ros + round(ahead * 1e9))
    command.expiry = to_stamp(NOW.ros + round(valid * 1e9))
    assert (tap_commands.refusal(command, NOW, last) or (ErrorCode.NONE,))[0] == code


def test_the_tapper_refuses_a_tap_for_another_tapper_and_names_itself() -> None:
    machine = TapperLogic(TapperOptions())
    machine.on_lifecycle(Configured(load_cell(), board_reply(State.SAFE)), NOW)
    machine.on_lifecycle(Activated(), NOW)
    for tap_id, name, code in ((1, "south", ErrorCode.TAPPER_UNKNOWN), (2, "", ErrorCode.NONE)):
        command = tap(tap_id)
        command.tapper = name
        made = machine.on_message("tap_command", command, NOW)
        (message,) = [effect.message for effect in made if isinstance(effect, Publish)]
        assert isinstance(message, TapperState)
        assert (message.tap_id, message.error_code) == (tap_id, code)
        assert message.tappers == ["tapper"]
        assert message.outcome == (TapperState.NOT_FIRED if code else TapperState.NONE)
