"""The state machine of the tapper at fixed mounts, with its driver and its emulated board, in
virtual time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from logic_parts import alone
from test_permit import START, Pair, at, board, jobs
from virtual_node import VirtualNode

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.hardware.tapper import TapperDriver
from tapping_cell.hardware.tapper_protocol import State as BoardState
from tapping_cell.logic.effects import JobEnded
from tapping_cell.logic.host import Activated, Configured
from tapping_cell.logic.poses import to_message
from tapping_cell.logic.tapper import TapperLogic, TapperOptions
from tapping_cell.logic.tapper_jobs import ChargeEnd, Status
from tapping_cell.messages import (
    ErrorCode,
    ObjectState,
    PoseWithCovariance,
    TapCommand,
    TapperState,
)
from tapping_cell.se2 import Pose
from tapping_cell.simulation.tapper_emulator import TapperEmulator, TapperMachine

CELL = load_cell(shared_folder() / "positioning_cell" / "cell.yaml")


class Ring(VirtualNode):
    """The node and its board of eight coils. There is no arm."""

    def __init__(self, machine: TapperMachine | None = None) -> None:
        self.device = TapperEmulator(machine or TapperMachine(coils=8), now=0.0)

        def make(line: Any) -> tuple[TapperLogic, TapperDriver]:
            return TapperLogic(TapperOptions()), TapperDriver(line, draw_number=lambda below: 7)

        super().__init__(
            "tapper_trigger",
            self.device,
            make,
            lambda driver, patience, _: driver.connect(timeout=patience),
            "tapper_state",
            cell=CELL,
        )
        self.wait_state(TapperState.SAFE)

    def command(self, tap_id: int, tapper: str, speed: float = 0.3, valid: float = 5.0) -> None:
        message = TapCommand(
            request=TapCommand.TAP, tap_id=tap_id, striker_speed=speed, tapper=tapper
        )
        message.header.frame_id = "table"
        message.expiry = self.stamp(valid)
        self.publish("tap_command", message)

    def see(self, at_rest: bool = True, x: float = 0.0) -> None:
        pose = PoseWithCovariance(pose=to_message(Pose(x, 0.0, 0.0)))
        message = ObjectState(visible=True, at_rest=at_rest, pose=pose)
        message.header.stamp = self.stamp()
        self.publish("object_states", alone(message))

    def see_for(self, seconds: float, **seen: Any) -> None:
        end = self.now() + seconds
        while self.now() < end:
            self.see(**seen)
            self.run(0.03)

    def proven(self) -> None:
        self.wait(lambda: self.last.mounts_proven, "mounts proven")

    def shots(self) -> list[int]:
        return [shot for shot, _, _ in self.device.fires]


@pytest.fixture
def ring() -> Ring:
    return Ring()


def test_the_node_verifies_its_mounts_and_fires_the_named_tapper(ring: Ring) -> None:
    ring.proven()
    assert list(ring.last.tappers) == list(CELL.tapper_names)
    assert ring.last.fixed_mounts
    channels = CELL.boards[0].channels
    for tap_id, name in enumerate(("west", "northeast", "east"), start=100):
        ring.command(tap_id, name)
        ring.wait(lambda i=tap_id: ring.last.tap_id == i and ring.last.outcome, "an outcome")
        assert (ring.last.outcome, ring.last.tapper) == (TapperState.FIRED, name)
        assert ring.device.channel == channels[name]
        # The state is SAFE again only when the striker has returned.
        assert ring.last.state == TapperState.FIRING
        assert ring.device.coils.next_event() is not None
        ring.wait_state(TapperState.SAFE)
        assert ring.device.coils.next_event() is None
    assert ring.shots() == [100, 101, 102]
    ring.command(102, "east")
    ring.run(1.0)
    assert ring.shots() == [100, 101, 102]
    assert not ring.reported_errors()


def test_a_tap_must_name_its_tapper_if_there_are_several(ring: Ring) -> None:
    ring.proven()
    for tap_id, name in ((100, ""), (101, "nobody")):
        ring.command(tap_id, name)
        ring.wait(lambda i=tap_id: ring.last.tap_id == i, "told")
        assert ring.last.outcome == TapperState.NOT_FIRED
        assert ring.last.error_code == ErrorCode.TAPPER_UNKNOWN
    assert ring.shots() == []


def test_a_moving_or_moved_object_is_not_tapped(ring: Ring) -> None:
    ring.proven()
    ring.see_for(0.2)
    ring.command(100, "west", valid=1.0)
    ring.see_for(1.5, at_rest=False)
    assert ring.shots() == []
    assert ring.last.outcome == TapperState.NOT_FIRED
    ring.command(101, "west", valid=1.0)
    ring.see_for(1.5, x=0.02)
    assert ring.shots() == []
    ring.command(102, "west", valid=1.0)
    ring.see_for(0.5)
    assert ring.shots() == [102]


def test_no_shot_is_fired_after_a_camera_timeout(ring: Ring) -> None:
    ring.proven()
    ring.see_for(0.2)
    ring.run(1.0)
    ring.command(100, "west", valid=1.0)
    ring.run(1.5)
    assert ring.shots() == []
    assert ring.last.outcome == TapperState.NOT_FIRED


def test_a_striker_that_stays_extended_is_a_fault_that_names_it(ring: Ring) -> None:
    ring.proven()
    ring.device.coils.flight = 1e6
    ring.command(100, "north")
    ring.wait_state(TapperState.FAULT)
    assert ring.last.outcome == TapperState.FIRED
    assert ring.last.error_code == ErrorCode.TAPPER_STRIKER_AWAY
    assert "north" in ring.last.error_msg
    ring.command(101, "west")
    ring.run(1.0)
    assert ring.shots() == [100]


def test_a_striker_that_does_not_leave_its_mount_is_a_fault(ring: Ring) -> None:
    ring.proven()
    ring.device.coils.block(CELL.boards[0].channels["south"], True)
    ring.command(100, "south")
    ring.wait_state(TapperState.FAULT)
    assert ring.last.error_code == ErrorCode.TAPPER_STRIKER_AWAY


def test_a_striker_off_its_mount_blocks_every_tap_until_it_is_back(ring: Ring) -> None:
    ring.proven()
    ring.device.coils.keep_out(4, True)
    ring.wait(lambda: not ring.last.mounts_proven and ring.last.away, "told")
    assert list(ring.last.away) == [CELL.tapper_names[4]]
    ring.command(100, "north", valid=1.0)
    ring.run(1.5)
    assert ring.shots() == []
    ring.device.coils.keep_out(4, False)
    ring.proven()
    assert ring.last.error_code == ErrorCode.NONE
    ring.command(101, "north")
    ring.wait(lambda: ring.shots() == [101], "fired")


@pytest.mark.parametrize("machine", [TapperMachine(), TapperMachine(version="2.0.0-sim")])
def test_a_board_without_switches_fires_nothing(machine: TapperMachine) -> None:
    ring = Ring(machine)
    ring.run(2.0)
    assert not ring.last.mounts_proven
    assert ring.last.error_code == ErrorCode.TAPPER_MOUNT_NOT_PROVEN
    ring.command(100, "east")
    ring.run(1.0)
    assert ring.shots() == []


def test_a_fixed_tapper_does_not_fire_before_it_is_charged() -> None:
    tapper = TapperLogic(TapperOptions())
    reply = replace(board(BoardState.SAFE), channels=8, at_mounts=255)
    tapper.on_lifecycle(Configured(CELL, reply), at(START))
    tapper.on_lifecycle(Activated(), at(START))
    command = Pair().command(TapCommand.TAP, at(START))
    (charge,) = jobs(tapper.on_message("tap_command", replace(command, tapper="west"), at(START)))
    assert tapper.check_charging(at(START)) is None
    assert tapper.check_firing(START, at(START)) is not None
    charged = ChargeEnd(Status(replace(reply, state=BoardState.CHARGED), 0), True, None)
    assert jobs(tapper.on_job(JobEnded(charge, charged), at(START + 0.02)))
    assert tapper.check_firing(START, at(START + 0.02)) is None
