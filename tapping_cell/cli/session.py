"""Following one goal on a running graph: words for people, rows for the run folder."""

from __future__ import annotations

import math
import platform
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import metadata

from rich.console import Console
from tapping_cell_msgs.msg import TapperState

from tapping_cell import __version__
from tapping_cell.nodes.conversions import from_message
from tapping_cell.nodes.goal_client import Finished, GoalClient, PhaseChanged, TapDone
from tapping_cell.report.run import TapRow
from tapping_cell.se2 import Pose


class NotReadyInTime(RuntimeError):
    """The graph did not become ready; the sentence says what is missing."""


@dataclass
class Followed:
    """What was heard of one goal."""

    taps: list[TapRow] = field(default_factory=list)
    finished: Finished | None = None


def end_on_signals() -> None:
    """Make Ctrl-C and a termination request end the verb in order, as a KeyboardInterrupt.

    Both are set, because a shell starts background jobs with the interrupt signal ignored, and
    Python leaves it so.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def versions() -> dict[str, str]:
    """Versions of the cell and of what its numbers depend on."""
    packages = ("numpy", "scipy", "rclpy")
    found = {"tapping_cell": __version__, "python": platform.python_version()}
    for package in packages:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "unknown"
    return found


def pose_text(pose: Pose) -> str:
    """A pose for people."""
    return f"x {1000 * pose.x:.1f} mm, y {1000 * pose.y:.1f} mm, {math.degrees(pose.theta):.1f} deg"


def wait_until_ready(
    client: GoalClient, patience: float, check: Callable[[], None], console: Console
) -> None:
    """Wait until the cell can take a goal.

    Raises:
        NotReadyInTime: names what is missing after ``patience`` seconds.
    """
    deadline = time.monotonic() + patience
    with console.status("waiting for the cell") as status:
        while missing := client.missing():
            check()
            if time.monotonic() > deadline:
                raise NotReadyInTime(
                    f"the cell was not ready after {patience:.0f} s: " + "; ".join(missing)
                )
            status.update("waiting for the cell: " + missing[0])
            time.sleep(0.05)


def follow(client: GoalClient, check: Callable[[], None], console: Console) -> Followed:
    """Show a goal's progress tap by tap until it ends. ``check`` may raise to give up."""
    followed = Followed()
    with console.status("goal sent") as status:
        for event in client.events():
            check()
            if isinstance(event, PhaseChanged):
                status.update(f"tap {event.taps + 1}: {event.phase}")
            elif isinstance(event, TapDone):
                row = tap_row(event)
                followed.taps.append(row)
                console.print(tap_text(row, event))
            elif isinstance(event, Finished):
                followed.finished = event
    return followed


def tap_row(event: TapDone) -> TapRow:
    """A measured tap as a row of the run folder."""
    record = event.record
    return TapRow(
        number=record.number,
        tap_id=record.tap_id,
        method=record.planner,
        before=from_message(record.object_pose),
        commanded=Pose(record.dx, record.dy, record.dtheta),
        predicted=from_message(record.predicted_pose),
        measured=from_message(record.measured_pose.pose),
        true_pose=event.true_pose,
        strike=from_message(record.strike_pose),
        striker_speed=record.striker_speed,
        contact_angle=record.contact_angle,
        outcome=OUTCOMES.get(record.outcome, "unknown"),
    )


OUTCOMES = {TapperState.FIRED: "fired", TapperState.NOT_FIRED: "not fired"}
"""Words for the tapper's outcomes; any other is unknown."""


def tap_text(row: TapRow, event: TapDone) -> str:
    """One line for people about one tap."""
    moved = 1000 * row.before.distance_to(row.measured)
    turned = math.degrees(row.before.rotation_to(row.measured))
    return (
        f"tap {row.number} ({row.method}): striker {1000 * row.striker_speed:.0f} mm/s, moved "
        f"{moved:.1f} mm and {turned:+.1f} deg; to go "
        f"{1000 * event.residual_distance:.2f} mm and "
        f"{math.degrees(event.residual_rotation):.2f} deg"
    )
