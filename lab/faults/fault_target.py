"""Interface of a trial on which faults act."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from lab.oracle.oracle import Oracle
from lab.virtual_cell.camera import Camera
from lab.virtual_cell.further_panels import PanelPress
from lab.virtual_cell.host import HostClock, Process
from lab.virtual_cell.network import Network
from lab.virtual_cell.physical_cell import PhysicalCell
from lab.virtual_cell.scheduler import Scheduler
from tapping_cell.configuration.cell import Cell
from tapping_cell.se2 import Pose


class FaultTarget(Protocol):
    """Interface of a trial for the injection of faults: its simulated parts, the kinds of faults
    that its cell can have, and actions of people and programs. Times are in s from the start of the
    run."""

    nodes: tuple[str, ...]
    arm_node: str
    makers: Mapping[str, Maker]
    at_a_shot: tuple[str, ...]
    of_a_shot: tuple[str, ...]
    moments: tuple[str, ...]
    cell: Cell
    scheduler: Scheduler
    network: Network
    clocks: dict[str, HostClock]
    processes: dict[str, Process]
    camera: Camera
    joint_names: tuple[str, ...]

    @property
    def physical(self) -> PhysicalCell:
        """Simulated objects, devices and their lines."""

    @property
    def oracle(self) -> Oracle:
        """Checker of the invariants."""

    def pursued_goals(self) -> Mapping[str, Pose]:
        """Return the goals of the objects that the present goal moves, by name."""

    def draw_goal(self, rng: np.random.Generator) -> Pose:
        """Choose a random goal in the central area of the table."""

    def send_goal(self, goal: Pose, foreign: bool = False) -> None:
        """Send an action goal to the planner if the planner's process is running."""

    def cancel_goal(self) -> None:
        """Cancel the action goal."""

    def cancel_by_service(self) -> None:
        """Call the planner's service that ends the present goal, whoever sent it."""

    def freeze(self, node: str, duration: float) -> None:
        """Freeze a process."""

    def kill(self, node: str, away: float) -> None:
        """Kill a process; it restarts after ``away`` s."""

    def shut_down(self, node: str, away: float) -> None:
        """Shut a process down; it restarts after ``away`` s."""

    def start_second(self, node: str, lasting: float) -> None:
        """Start a second instance of a node, as if by mistake, and kill this instance after
        ``lasting`` s."""

    def plant_exception(self, node: str, lines: int, function: str = "") -> None:
        """Let one of the next handlers or jobs of a node raise an exception, after ``lines`` lines
        of its code, which are counted from the next call of ``function`` if a name is given."""

    def hide_object(self, duration: float) -> None:
        """Hide the object for ``duration`` s, as if a hand covered it."""

    def move_object(self, shift: Pose, duration: float = 0.0) -> None:
        """Move the object by hand, within the central area of the table; ``duration`` in s."""

    def press_emergency_stop(self, duration: float) -> None:
        """Hold the emergency stop of the panel for ``duration`` s."""

    def repeat_emergency_stop(self) -> None:
        """Let the panel repeat its level while its emergency stop is held."""

    def press_further_panel(self, press: PanelPress) -> None:
        """Press the emergency stop of a further panel, which may vanish while it is pressed."""

    def interrupt_tapper_power(self) -> None:
        """Interrupt the power of the tapper's board, so that the board also loses its latched
        stop."""

    def interrupt_arm_power(self) -> None:
        """Interrupt the power of the arm's board, so that the board loses the arm's position."""

    def turn_arm_motors_off(self) -> None:
        """Switch the arm's motors off, as a sleep command does, so that the quill sinks."""

    def turn_tapper_motor_off(self, duration: float) -> None:
        """Switch the tapper's motor off for ``duration`` s, so that its steps have no effect."""

    def release_enabling(self, devices: tuple[str, ...], silent: bool, away: float) -> None:
        """Let the person of set-up mode release these devices for ``away`` s. ``silent``: the key's
        messages just end."""

    def change_ask(self, ask: bool) -> None:
        """Tell the planner whether to ask before every tap."""

    def press_stop_button(self, share: float) -> None:
        """Press the stop button that is wired to a board of the tapper; ``share``, from 0 to 1,
        selects the board."""

    def call_stop(self, node: str) -> None:
        """Call a node's service ``stop``."""

    def reset(self, node: str) -> None:
        """Clear the stop of a device's node and home the arm."""


Made = tuple[Callable[[FaultTarget], None], str]
"""Function that injects one fault, and a description of this fault."""
Maker = Callable[[np.random.Generator, FaultTarget], Made]
"""Function that chooses a random fault of one kind."""
