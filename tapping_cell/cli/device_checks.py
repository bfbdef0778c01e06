"""Comparison of the settings of arm and tapper with those that the cell requires.

Nothing moves and nothing is charged. Steps, speeds and accelerations must always be changed by a
person.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import rclpy
from rclpy.node import Node
from rich.markup import escape
from rich.table import Table

from tapping_cell.configuration.arm_assembly import joint_accelerations, make_dialect
from tapping_cell.configuration.cell import (
    ArmSection,
    Cell,
    OutputSection,
    TapperSection,
)
from tapping_cell.hardware.dialect import ArmDialect
from tapping_cell.hardware.faults import HardwareFault
from tapping_cell.hardware.finding import Finding
from tapping_cell.hardware.output_tapper import OutputTapperDriver
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.hardware.tapper import TapperDriver
from tapping_cell.hardware.transport import Connection
from tapping_cell.nodes.drivers.output_link import RosOutputLink
from tapping_cell.nodes.drivers.trajectory_link import RosTrajectoryLink

TIMEOUT = 8.0
"""Timeout in s for opening a port, and also for each response of the device at that port."""


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the table."""

    device: str
    setting: str
    found: str
    ok: bool
    remedy: str = ""


def check_devices(cell: Cell, write: bool) -> list[Row]:
    """Compare the settings of arm and tapper with those of the cell. ``write``: store the settings
    that are safe to store, after confirmation."""
    rows = check_tapper(cell)
    if cell.file.arm is not None:
        rows = [*check_arm(cell, _confirm if write else None), *rows]
    return rows


def check_arm(cell: Cell, confirm: Callable[[Finding], bool] | None = None) -> list[Row]:
    """Check the arm's controller. ``confirm`` is called before each setting is stored."""
    arm = cell.arm
    try:
        with _connection(arm) as connection:
            port = connection.name
            dialect = make_dialect(arm, connection)
            connection.open(TIMEOUT)
            firmware, findings = dialect.inspect(connection.now() + TIMEOUT)
            if confirm is not None and _store(dialect, findings, confirm, connection):
                firmware, findings = dialect.inspect(connection.now() + TIMEOUT)
    except (HardwareFault, ValueError) as fault:
        return [Row("arm", "connection", "failed", False, str(fault))]
    rows = [Row("arm", "controller", f"{firmware.name} {firmware.version} on {port}", True)]
    rows += [Row("arm", "remark", remark, True) for remark in firmware.remarks]
    for finding in findings:
        remedy = finding.needed + (f": send {finding.command}" if finding.command else "")
        met = finding.met
        rows.append(Row("arm", finding.setting, finding.found, met, "" if met else remedy))
    return rows


@contextmanager
def _connection(arm: ArmSection) -> Iterator[SerialTransport | RosTrajectoryLink]:
    """Open the connection to the arm's controller, and close it at the end."""
    if arm.ros2_control is None:
        transport = SerialTransport(_port(arm.port), arm.baud)
        try:
            yield transport
        finally:
            transport.close()
        return
    with _node() as node:
        link = RosTrajectoryLink(node, arm.ros2_control, joint_accelerations(arm))
        try:
            yield link
        finally:
            link.destroy()


@contextmanager
def _node() -> Iterator[Node]:
    """Create a node, and destroy it at the end."""
    rclpy.init()
    try:
        node = Node("device_checks")
        try:
            yield node
        finally:
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


class _NoMemory:
    """Shot memory that stores nothing, because nothing is fired."""

    def recall(self) -> int:
        """Return 0: no shot has been sent."""
        return 0

    def keep(self, shot: int) -> None:
        """Never called."""
        raise AssertionError("the check fires nothing")


def check_output(tapper: TapperSection, section: OutputSection) -> list[Row]:
    """Check the digital output that fires the tapper. The check only switches the output off."""
    with _node() as node:
        link = RosOutputLink(node, section)
        driver = OutputTapperDriver(link, tapper.output_settings(), _NoMemory())
        try:
            reply = driver.connect(TIMEOUT)
            version, other_commanders = driver.version, link.other_commanders
            driver.close()
        except (HardwareFault, ValueError) as fault:
            return [Row("tapper", "connection", "failed", False, str(fault))]
        finally:
            link.destroy()
    rows = [
        Row("tapper", "output", f"{version} on {section.name}", True),
        _guard_row("tapper", "guard", reply.interlock_closed, "the input of the guard"),
        Row(
            "tapper",
            "remark",
            "the output reads back as off"
            if section.read_back
            else "the output is not read back: only the camera can confirm that a shot was fired",
            True,
        ),
    ]
    rows += [
        Row(
            "tapper",
            "other programs",
            f"{name} can switch {section.name}",
            False,
            "end that program or revoke its access: no other program may fire the tapper",
        )
        for name in other_commanders
    ]
    return rows


def check_tapper(cell: Cell) -> list[Row]:
    """Check every tapper board. Opening the connection discharges the tapper."""
    section = cell.file.tapper
    if section.output is not None:
        return check_output(section, section.output)
    ports = [board.port for board in cell.boards]
    names = ["tapper"] if len(ports) == 1 else [f"tapper board {n + 1}" for n in range(len(ports))]
    return [
        row
        for name, port in zip(names, ports, strict=True)
        for row in _check_board(name, port, section.baud)
    ]


def _check_board(name: str, given_port: str, baud: int) -> list[Row]:
    try:
        port = _port(given_port)
        driver = TapperDriver(SerialTransport(port, baud))
        try:
            reply = driver.connect(TIMEOUT)
        finally:
            driver.close()
    except (HardwareFault, ValueError) as fault:
        return [Row(name, "connection", "failed", False, str(fault))]
    stop = "pressed or latched" if reply.stop_latched else "clear"
    return [
        Row(name, "firmware", f"{driver.version} on {port}", True),
        _guard_row(name, "interlock", reply.interlock_closed, "the interlock loop on pin D2"),
        Row(
            name,
            "stop",
            stop,
            not reply.stop_latched,
            "press the clear button, then clear the stop" if reply.stop_latched else "",
        ),
    ]


def _guard_row(device: str, setting: str, closed: bool, input_name: str) -> Row:
    remedy = "" if closed else f"close the guard, or check {input_name}"
    return Row(device, setting, "closed" if closed else "open", closed, remedy)


def _store(
    dialect: ArmDialect,
    findings: list[Finding],
    confirm: Callable[[Finding], bool],
    connection: Connection,
) -> bool:
    """Store settings in the controller, if they are safe to store and the user confirms them.
    Return whether any setting was stored."""
    wanted = [f for f in findings if not f.met and f.storable and confirm(f)]
    for finding in wanted:
        dialect.store(finding, connection.now() + TIMEOUT)
    return bool(wanted)


def _confirm(finding: Finding) -> bool:
    # The prompt of input() would go to stdout, into the output of --json.
    print(f"{finding.sentence}. Store it now? [y/N] ", end="", file=sys.stderr, flush=True)
    try:
        answer = input()
    except EOFError:
        return False
    return answer.strip().lower() in ("y", "yes")


def _port(port: str) -> str:
    if "{" in port:
        raise ValueError(
            f"port {port} belongs to a simulated cell: give the path of a device in the cell file,"
            " such as /dev/serial/by-id/..."
        )
    return str(Path(port).expanduser())


def table_of(rows: list[Row]) -> Table:
    """Return the table of the findings."""
    table = Table("device", "setting", "found", "", "what to do")
    for row in rows:
        mark = "[green]ok[/]" if row.ok else "[red]wrong[/]"
        setting, found, remedy = map(escape, (row.setting, row.found, row.remedy))
        table.add_row(row.device, setting, found, mark, remedy)
    return table
