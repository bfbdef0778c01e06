"""The state machine of the tapper with a cell's tappers on two boards, in virtual time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from virtual_node import VirtualNode

from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.hardware.tapper import TapperDriver
from tapping_cell.hardware.tapper_boards import TapperBoards
from tapping_cell.logic.tapper import TapperLogic, TapperOptions
from tapping_cell.messages import Bool, ErrorCode, TapCommand, TapperState
from tapping_cell.simulation.fault_layer import Direction, FaultKind, LineFault
from tapping_cell.simulation.tapper_emulator import TapperEmulator, TapperMachine


def cell_on_two_boards() -> Cell:
    """Return the shipped cell with every second tapper on a second board."""
    cell = load_cell(shared_folder() / "positioning_cell" / "cell.yaml")
    entries = tuple(
        replace(entry, channel=index // 2, port="/dev/second" if index % 2 else "/dev/first")
        for index, entry in enumerate(cell.fixed_tappers.tappers)
    )
    section = replace(cell.fixed_tappers, tappers=entries)
    return replace(cell, file=replace(cell.file, fixed_tappers=section))


CELL = cell_on_two_boards()


class TwoBoards(VirtualNode):
    """The node and its two boards of four coils each."""

    def __init__(self) -> None:
        self.devices = [TapperEmulator(TapperMachine(coils=4), now=0.0) for _ in range(2)]

        def make(lines: Any) -> tuple[TapperLogic, TapperBoards]:
            drivers = [TapperDriver(line, draw_number=lambda below: 7) for line in lines]
            return TapperLogic(TapperOptions()), TapperBoards(drivers)

        super().__init__(
            "tapper_trigger",
            self.devices,
            make,
            lambda driver, patience, _: driver.connect(timeout=patience),
            "tapper_state",
            cell=CELL,
        )
        self.wait_state(TapperState.SAFE)
        self.wait(lambda: self.last.mounts_proven, "mounts proven on both boards")

    def command(self, tap_id: int, tapper: str, valid: float = 5.0) -> None:
        message = TapCommand(
            request=TapCommand.TAP, tap_id=tap_id, striker_speed=0.3, tapper=tapper
        )
        message.header.frame_id = "table"
        message.expiry = self.stamp(valid)
        self.publish("tap_command", message)

    def shots(self) -> list[list[int]]:
        return [[shot for shot, _, _ in device.fires] for device in self.devices]

    def tap(self, tap_id: int, tapper: str) -> None:
        self.command(tap_id, tapper)
        self.wait(lambda: self.last.tap_id == tap_id and self.last.outcome, "an outcome")
        self.wait(lambda: self.last.state not in (TapperState.CHARGING, TapperState.FIRING), "end")


@pytest.fixture
def ring() -> TwoBoards:
    return TwoBoards()


def test_each_tapper_is_fired_by_its_own_board(ring: TwoBoards) -> None:
    assert len(CELL.boards) == 2
    for tap_id, entry in enumerate(CELL.fixed_tappers.tappers, start=100):
        ring.tap(tap_id, entry.name)
        assert (ring.last.outcome, ring.last.tapper) == (TapperState.FIRED, entry.name)
        fired = ring.devices[int(entry.port == "/dev/second")]
        assert (fired.fires[-1][0], fired.channel) == (tap_id, entry.channel)
    assert ring.shots() == [[100, 102, 104, 106], [101, 103, 105, 107]]
    assert set(ring.last.tappers) == set(CELL.tapper_names)
    assert not ring.reported_errors()


def test_an_extended_striker_of_one_board_blocks_the_taps_of_the_other(ring: TwoBoards) -> None:
    ring.devices[1].coils.keep_out(2, True)
    ring.wait(lambda: ring.last.away, "told")
    (away,) = ring.last.away
    assert CELL.tapper_channels[away] % 32 == 2
    ring.command(100, "east", valid=1.0)
    ring.run(1.5)
    assert ring.shots() == [[], []]
    assert ring.last.outcome == TapperState.NOT_FIRED
    ring.devices[1].coils.keep_out(2, False)
    ring.wait(lambda: ring.last.mounts_proven, "proven again")
    ring.tap(101, "east")
    assert ring.shots() == [[101], []]


def test_a_lost_board_blocks_every_tap(ring: TwoBoards) -> None:
    layer = ring.lines[1].layer
    way = Direction.TO_HOST
    layer.add(LineFault(FaultKind.HANG_UP, way, layer.count(way), 1, 3.0))
    ring.wait_state(TapperState.DISCONNECTED)
    ring.command(100, "east", valid=1.0)
    ring.run(1.5)
    assert ring.shots() == [[], []]
    ring.wait_state(TapperState.SAFE)
    ring.wait(lambda: ring.last.mounts_proven, "proven again")
    ring.tap(101, "east")
    assert ring.shots() == [[101], []]


def test_an_open_guard_at_one_board_blocks_every_tap(ring: TwoBoards) -> None:
    ring.devices[1].set_interlock(False, ring.now())
    ring.lines[1].schedule()
    ring.wait(lambda: not ring.last.interlock_closed, "told")
    ring.command(100, "east", valid=1.0)
    ring.run(1.5)
    assert ring.shots() == [[], []]


def test_a_stop_reaches_both_boards_and_must_be_cleared_at_both(ring: TwoBoards) -> None:
    ring.publish("emergency_stop", Bool(data=True))
    ring.wait(lambda: all(device.state == "STOPPED" for device in ring.devices), "both stopped", 1)
    ring.publish("emergency_stop", Bool(data=False))
    ring.devices[0].press_clear_button(ring.now())
    ring.lines[0].schedule()
    ring.run(1.0)
    answer = ring.call("~/clear_fault")
    ring.run(1.0)
    assert ring.last.state == TapperState.STOPPED, answer
    for device, line in zip(ring.devices, ring.lines, strict=True):
        device.press_clear_button(ring.now())
        line.schedule()
    ring.run(1.0)
    ring.call("~/clear_fault")
    ring.wait_state(TapperState.SAFE)


def test_a_shot_number_used_by_one_board_is_used_for_the_other(ring: TwoBoards) -> None:
    ring.tap(100, "east")
    ring.command(100, "northeast")
    ring.run(1.0)
    assert ring.shots() == [[100], []]
    assert ring.last.error_code in (ErrorCode.NONE, ErrorCode.COMMAND_REPEATED)
