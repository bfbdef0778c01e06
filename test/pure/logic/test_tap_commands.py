"""A tap command names its tapper. In a cell with only one tapper, the name may be empty."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from logic_parts import board_reply

from tapping_cell.configuration.cell import load_cell
from tapping_cell.hardware.tapper_protocol import State
from tapping_cell.logic import tap_commands
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.effects import Publish
from tapping_cell.logic.host import Activated, Configured
from tapping_cell.logic.tapper import TapperLogic, TapperOptions
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


@given(st.floats(0.0, 10.0).filter(lambda norm: abs(norm - 1.0) > 0.011))
def test_a_strike_pose_with_a_quaternion_that_is_not_normalised_is_refused(norm: float) -> None:
    now = Now(steady=100.0, ros=10**18)
    command = TapCommand(tap_id=1, striker_speed=0.3)
    command.header.frame_id = "table"
    command.expiry = to_stamp(now.ros + 10**9)
    command.strike_pose.orientation.w = 1.0
    assert tap_commands.refusal(command, now, 0) is None
    command.strike_pose.orientation.w = norm
    refused = tap_commands.refusal(command, now, 0)
    assert refused is not None and refused[0] == ErrorCode.COMMAND_INVALID
    assert "quaternion" in refused[1]


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
    now = Now(steady=100.0, ros=10**18)
    last = 2 * 10**9
    command = TapCommand(tap_id=last + above, striker_speed=0.3)
    command.header.frame_id = "table"
    command.header.stamp = to_stamp(now.ros + round(ahead * 1e9))
    command.expiry = to_stamp(now.ros + round(valid * 1e9))
    command.strike_pose.orientation.w = 1.0
    assert (tap_commands.refusal(command, now, last) or (ErrorCode.NONE,))[0] == code


def test_the_tapper_refuses_a_tap_for_another_tapper_and_names_itself() -> None:
    now = Now(steady=100.0, ros=10**18)
    machine = TapperLogic(TapperOptions())
    machine.on_lifecycle(Configured(load_cell(), board_reply(State.SAFE)), now)
    machine.on_lifecycle(Activated(), now)
    for tap_id, name, code in ((1, "south", ErrorCode.TAPPER_UNKNOWN), (2, "", ErrorCode.NONE)):
        command = TapCommand(tap_id=tap_id, tapper=name, striker_speed=0.3)
        command.header.frame_id = "table"
        command.strike_pose.orientation.w = 1.0
        command.expiry = to_stamp(now.ros + 10**9)
        made = machine.on_message("tap_command", command, now)
        (message,) = [effect.message for effect in made if isinstance(effect, Publish)]
        assert isinstance(message, TapperState)
        assert (message.tap_id, message.error_code) == (tap_id, code)
        assert message.tappers == ["tapper"]
        assert message.outcome == (TapperState.NOT_FIRED if code else TapperState.NONE)
