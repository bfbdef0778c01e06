"""Common base of the two device nodes: a state machine, its driver, and their start-up."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Sequence
from typing import Any, Generic, Protocol, TypeVar, cast

from tapping_cell import messages
from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.logic.device import DeviceLogic
from tapping_cell.logic.host import Configured, Unreachable
from tapping_cell.nodes.cell_identity import key_of, state_folder
from tapping_cell.nodes.cell_node import LATCHED, CellNode, NotReady, Parameters, run
from tapping_cell.nodes.drivers.ros_link import RosLink
from tapping_cell.nodes.logic_host import LogicHost, LogicNode

URGENCY = 1
"""Lowest real-time priority. It is still above the priority of every process without real-time
scheduling."""


class DeviceDriver(Protocol):
    """Interface common to both drivers."""

    def connect(self, timeout: float) -> Any:
        """Open the port and identify the device."""

    def stop(self) -> bool:
        """Send the stop command to the device immediately, from any thread."""

    def close(self) -> None:
        """Close the port."""


Driver = TypeVar("Driver", bound=DeviceDriver)
Section = TypeVar("Section")
Link = TypeVar("Link", bound=RosLink)


class DriverNode(LogicNode[Parameters], Generic[Parameters, Driver]):
    """Node that hosts the state machine of a device."""

    def __init__(
        self,
        name: str,
        parameters: type[Parameters],
        make_logic: Callable[[Parameters], DeviceLogic[Any, Any]],
    ) -> None:
        super().__init__(name, parameters)
        self.driver: Driver | None = None
        self.port = ""
        self._link: RosLink | None = None
        self._linked_to: object = None
        self.logic = make_logic(self.settings)
        self.host = LogicHost(self, self.logic, state_folder(key_of(self)))
        self.logic.recall_stop(self.host.stop_file.recall())
        self.host.publishes(messages.StopState, "~/stop_state", LATCHED)
        for service in ("~/stop", "~/clear_fault"):
            self.host.serves(messages.Trigger, service)

    @property
    def stopped(self) -> bool:
        """Whether a stop is latched."""
        return self.logic.stopped

    def connect(self, driver: Driver, port: str, cell: Cell, read: Callable[[Any], Any]) -> Any:
        """Connect to the device and notify the state machine. Return the result of
        ``driver.connect``.

        ``port``: path of the port, for diagnostics. ``read``: converts the result of
        ``driver.connect`` for the state machine.

        Raises:
            NotReady: a stop could not be stored, the device is absent or its response is not
                understood. The node then tries to configure itself again.
        """
        try:
            self.host.stop_file.require_writable()
        except OSError as error:
            raise NotReady(
                f"the file that preserves a stop across restarts cannot be written ({error}); make"
                " its folder writable and free some space on its disk"
            ) from error
        try:
            self.logic.before_connect(driver)
            answer = driver.connect(timeout=self.logic.patience)
            connected = read(answer)
        except HardwareFault as fault:
            driver.close()
            if fault.reason is FaultReason.PORT_MISSING and not port.startswith("/dev/"):
                # A port outside /dev belongs to a simulated device. If the port is missing, the
                # device has not been started yet.
                waits = f"the simulated device has not opened {port} yet; start sim_world"
                self.host.lifecycle(Unreachable(HardwareFault(fault.reason, waits)))
                raise NotReady(waits, expected=True) from fault
            self.host.lifecycle(Unreachable(fault))
            raise NotReady(fault.sentence) from fault
        self.driver, self.port = driver, port
        self.host.start(driver)
        self.host.lifecycle(Configured(cell, connected))
        return answer

    def link_to(self, section: Section, make: Callable[[Section], Link]) -> Link:
        """Return the link to a robot's own ROS driver for a new driver of the device. The same link
        is returned until ``section``, the driver's section of the cell file, changes."""
        if self._link is not None and self._linked_to != section:
            self._link.destroy()
            self._link = None
        if self._link is None:
            self._link = make(section)
            self._linked_to = section
        # The state machine, which keeps a stop, makes the new driver stop again.
        self._link.release()
        return cast(Link, self._link)

    def destroy_node(self) -> None:
        """Destroy the link together with the node."""
        if self._link is not None:
            self._link.destroy()
        super().destroy_node()  # type: ignore[no-untyped-call]

    def cleanup(self) -> None:
        """Close the port."""
        try:
            super().cleanup()
        finally:
            if self.driver is not None:
                self.driver.close()
            self.driver = None


def run_driver(
    make_node: Callable[[], CellNode[Any]], arguments: Sequence[str] | None = None
) -> int:
    """Run a driver's node with real-time priority if the system permits it.

    An emergency stop must not wait while other processes occupy the processor. Every thread created
    from here on inherits the scheduling policy. Without permission, the node runs with its normal
    priority.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(URGENCY))
    return run(make_node, arguments)
