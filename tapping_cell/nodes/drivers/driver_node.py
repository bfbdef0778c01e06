"""What the nodes of the two serial devices share: a machine, its driver, and how both begin."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Sequence
from typing import Any, Generic, Protocol, TypeVar

from std_msgs.msg import Bool

from tapping_cell import messages
from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.logic import stops
from tapping_cell.logic.device import DeviceLogic
from tapping_cell.logic.host import Activated, Configured, Deactivated, ShutDown, Unreachable
from tapping_cell.nodes.cell_identity import key_of, state_folder
from tapping_cell.nodes.cell_node import LATCHED, CellNode, NotReady, Parameters, run
from tapping_cell.nodes.logic_host import LogicHost

URGENCY = 1
"""Priority among the processes of real-time scheduling: the lowest, above all ordinary ones."""


class DeviceDriver(Protocol):
    """What both drivers can do."""

    def connect(self, timeout: float) -> Any:
        """Open the line and identify who answers."""

    def stop(self) -> bool:
        """Stop on the wire, at once; from any thread."""

    def close(self) -> None:
        """Close the line."""


Driver = TypeVar("Driver", bound=DeviceDriver)


class DriverNode(CellNode[Parameters], Generic[Parameters, Driver]):
    """A node that hosts a device's machine. Whatever is decided is decided there."""

    actor = True
    carries_pictures = False

    def __init__(
        self,
        name: str,
        parameters: type[Parameters],
        make_logic: Callable[[Parameters], DeviceLogic[Any, Any]],
    ) -> None:
        super().__init__(name, parameters)
        self.driver: Driver | None = None
        self.port = ""
        self.logic = make_logic(self.settings)
        self.host = LogicHost(self, self.logic, state_folder(key_of(self)))
        self.host.publishes(messages.StopState, "~/stop_state", LATCHED)
        for service in ("~/stop", "~/clear_fault"):
            self.host.serves(messages.Trigger, service)

    @property
    def stopped(self) -> bool:
        """Whether a stop is latched."""
        return self.logic.stopped

    def connect(self, driver: Driver, port: str, cell: Cell, read: Callable[[Any], Any]) -> Any:
        """Connect, and tell the machine; returns what ``connect`` answers.

        ``port``: its path, for diagnostics. ``read``: makes of that answer what the machine gets.

        Raises:
            NotReady: the device is not there or not understood; tried again by the life cycle.
        """
        try:
            answer = driver.connect(timeout=self.logic.patience)
            connected = read(answer)
        except HardwareFault as fault:
            driver.close()
            if fault.reason is FaultReason.PORT_MISSING and not port.startswith("/dev/"):
                # No device of the system: a simulated one, which starts about now.
                waits = f"the simulated device has not opened {port} yet; start sim_world"
                self.host.lifecycle(Unreachable(HardwareFault(fault.reason, waits)))
                raise NotReady(waits, expected=True) from fault
            self.host.lifecycle(Unreachable(fault))
            raise NotReady(fault.sentence) from fault
        self.driver, self.port = driver, port
        self.host.start(driver)
        kept = self.host.stop_file.recall()
        self.host.lifecycle(Configured(cell, connected, kept_stop=kept))
        return answer

    def activate(self) -> None:
        """Let the machine act."""
        self.host.lifecycle(Activated())

    def deactivate(self) -> None:
        """Have the machine end what is under way."""
        self.host.lifecycle(Deactivated())

    def cleanup(self) -> None:
        """Close the port."""
        self.host.lifecycle(ShutDown())
        self.host.close()
        if self.driver is not None:
            self.driver.close()
        self.driver = None

    def hear_stop(self, message: Bool) -> None:
        """Hand a level of the emergency stop to the machine, which stops the wire at once."""
        self.host.hear(stops.TOPIC, messages.Bool(data=message.data))


def run_driver(
    make_node: Callable[[], CellNode[Any]], arguments: Sequence[str] | None = None
) -> int:
    """Run a driver's node; where the system allows it, ahead of ordinary processes.

    An emergency stop must not wait for a processor that others keep busy. Every thread that is
    made from here on inherits the scheduling. Who may not choose it runs as before.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(URGENCY))
    return run(make_node, arguments)
