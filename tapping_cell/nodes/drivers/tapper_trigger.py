"""Node of the tappers: hosts ``logic.tapper`` with the driver of all tapper boards."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticStatus

from tapping_cell import messages
from tapping_cell.configuration.cell import OutputSection, TapperSection
from tapping_cell.configuration.schema import ConfigurationError, quantity, text
from tapping_cell.hardware.output_tapper import OutputTapperDriver
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.hardware.tapper import TapperDriver, TapperSettings
from tapping_cell.hardware.tapper_boards import TapperBoards, numbered
from tapping_cell.hardware.tapper_protocol import Mode
from tapping_cell.logic import enabling
from tapping_cell.logic.tapper import TapperLogic, TapperOptions
from tapping_cell.logic.tapper_peers import PeerLimits
from tapping_cell.nodes.cell_identity import key_of, state_folder
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.cell_parameters import CellParameters
from tapping_cell.nodes.drivers.driver_node import DriverNode, run_driver
from tapping_cell.nodes.drivers.output_link import KeptShot, RosOutputLink


@dataclass(frozen=True, slots=True)
class Parameters(CellParameters):
    """Parameters of tapper_trigger."""

    port: str = text(
        "path of the tapper's serial port; if empty, the one in the cell file. In a cell with "
        "several tapper boards, the second has this path with the suffix _1, and so on",
        default="",
    )
    state_rate: float = quantity("rate of tapper_state", "Hz", 1.0, 200.0, default=20.0)
    set_up: bool = text(
        "set-up mode: charge and fire only while an enabling device (the key on the page or the "
        "switch at the board) is held; taps above the board's set-up energy only while the switch "
        "at the board is held",
        default=False,
    )
    arm_freshness: float = quantity(
        "maximum age of the arm's measured position when the striker fires",
        "s",
        0.02,
        2.0,
        default=0.3,
    )
    silence_limit: float = quantity(
        "maximum age of the last messages of planner and camera; if one is older, the tapper "
        "neither charges nor fires",
        "s",
        0.1,
        5.0,
        default=0.45,
    )
    unseen_limit: float = quantity(
        "maximum time for which the object may be out of view before a tap is fired; if the arm "
        "hides it, 4 s are allowed",
        "s",
        0.1,
        10.0,
        default=0.45,
    )
    moved_limit: float = quantity(
        "maximum distance, at the time of firing, of the object from the pose for which the tap "
        "was planned",
        "m",
        0.0001,
        0.1,
        default=0.002,
    )
    turned_limit: float = quantity(
        "maximum rotation, at the time of firing, of the object from the pose for which the tap "
        "was planned",
        "rad",
        0.001,
        math.pi,
        default=0.05,
    )
    needs_camera: bool = text(
        "charge and fire only if usable images have been received since the node was started; set "
        "to false only for single taps in a cell without a camera",
        default=True,
    )


class TapperTrigger(DriverNode[Parameters, TapperBoards | OutputTapperDriver]):
    """See the module's docstring."""

    logic: TapperLogic

    def __init__(self) -> None:
        super().__init__("tapper_trigger", Parameters, make_logic)
        self.host.publishes(messages.TapperState, "tapper_state", LATCHED)
        self.host.subscribes(messages.TapCommand, "tap_command", COMMAND)
        self.host.subscribes(messages.ArmState, "arm_state", LATCHED)
        self.host.subscribes(messages.PlanState, "plan_state", LATCHED)
        self.host.subscribes(messages.ObjectStates, "object_states", LATCHED)
        self.host.subscribes(messages.Bool, enabling.TOPIC, COMMAND)
        self.host.calls(messages.HoldStill, "hold_still")

    def configure(self) -> None:
        """Read the cell file, open the ports and start the sessions. Starting the sessions
        discharges every tapper."""
        cell = self.settings.load_cell()
        tapper = cell.file.tapper
        if tapper.output is not None:
            output = self._output_driver(tapper, tapper.output)
            self.connect(output, tapper.output.name, cell, lambda reply: reply)
            return
        ports = [
            str(self.port_path(numbered(self.settings.port, index) or board.port))
            for index, board in enumerate(cell.boards)
        ]
        settings = TapperSettings(mode=Mode.SETUP if self.settings.set_up else Mode.RUN)
        boards = TapperBoards(
            [TapperDriver(SerialTransport(port, tapper.baud), settings) for port in ports]
        )
        self.connect(boards, ", ".join(ports), cell, lambda reply: reply)

    def _output_driver(self, tapper: TapperSection, section: OutputSection) -> OutputTapperDriver:
        """Return the driver of a digital output."""
        if self.settings.set_up:
            raise ConfigurationError(
                "parameter set_up is true, but tapper.dialect is io: set-up mode needs the tapper's"
                " board, which limits the energy and reads the enabling switch"
            )
        link = self.link_to(section, lambda section: RosOutputLink(self, section))
        memory = KeptShot(state_folder(key_of(self)))
        return OutputTapperDriver(link, tapper.output_settings(), memory)

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Report port, firmware and counters."""
        driver, (code, sentence) = self.driver, self.logic.error
        if driver is None:
            return DiagnosticStatus.WARN, sentence, {}
        counters = driver.counters
        values: dict[str, object] = {
            "hardware_id": "tapper",
            "port": self.port,
            "firmware": driver.version,
            "shots fired": counters.fired,
            "outcome unknown": counters.unknown,
            "retries": counters.retries,
            "timeouts": counters.timeouts,
            "bad frames": counters.bad_frames,
            "reconnects": counters.reconnects,
            "stops": counters.stops,
            "last error": counters.last_error,
        }
        if code:
            return DiagnosticStatus.ERROR, sentence, values
        return DiagnosticStatus.OK, "ok", values


def make_logic(parameters: Parameters) -> TapperLogic:
    """Return the tapper's state machine for these parameters."""
    limits = PeerLimits(
        parameters.arm_freshness,
        parameters.silence_limit,
        parameters.unseen_limit,
        parameters.moved_limit,
        parameters.turned_limit,
        parameters.needs_camera,
    )
    return TapperLogic(TapperOptions(parameters.state_rate, limits, parameters.set_up))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_driver(TapperTrigger, arguments)


if __name__ == "__main__":
    sys.exit(main())
