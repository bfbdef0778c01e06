"""Make the taps of an experiment, one after another: wait for the cell, bring the object back, make
the tap, read the result."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from tapping_cell_msgs.action import SingleTap
from tapping_cell_msgs.msg import ErrorCode, TapperState, TapRecord

from tapping_cell.calibration.design import contact_of, travel_direction
from tapping_cell.calibration.trials import Trial
from tapping_cell.logic.poses import covariance_from_message
from tapping_cell.mechanics import Tap
from tapping_cell.nodes.clients.goal_client import Finished
from tapping_cell.nodes.clients.single_tap_client import SingleTapClient
from tapping_cell.nodes.conversions import from_message
from tapping_cell.report import error_codes
from tapping_cell.se2 import Pose

READY_TIMEOUT_S = 60.0
BACK_TOLERANCE = (0.015, math.radians(45.0))
"""Tolerance, in m and rad, of a goal that brings the object back to the middle of the table. It is
large, to save taps."""
NO_CLEARANCE = (
    ErrorCode.TAP_LEAVES_TABLE,
    ErrorCode.TAP_LEAVES_VIEW,
    ErrorCode.NO_TAP_FOUND,
    ErrorCode.NO_CONTACT_FOUND,
)
"""Error codes of a tap that is not possible here, but may be possible at another position of the
object. After such an error, the object is brought back to the middle of the table."""
PASSING = (
    ErrorCode.OBJECT_NOT_SEEN,
    ErrorCode.OBJECT_NOT_AT_REST,
    ErrorCode.OBJECT_MOVED,
    ErrorCode.REFERENCES_NOT_SEEN,
    ErrorCode.CAMERA_SILENT,
    ErrorCode.IMAGE_INVALID,
    ErrorCode.GOAL_REPLACED,
    ErrorCode.PLANNER_BUSY,
)
"""Error codes of temporary failures. The trial is repeated when the cell is ready again."""
IN_A_ROW = 3


class SeriesStopped(RuntimeError):
    """The experiment cannot continue. ``code`` is an ErrorCode. Completed trials are kept."""

    def __init__(self, code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


@dataclass(slots=True)
class TapMaker:
    """Make prescribed taps near the middle of the table."""

    client: SingleTapClient
    check: Callable[[], None]
    """Raises an exception if the experiment must end, for example because a node died."""
    _failures: int = field(default=0, init=False)

    def make(self, striker_speed: float, incidence: float, number: int) -> SingleTap.Result | None:
        """Make one tap at ``striker_speed`` (m/s) and ``incidence`` (rad). ``number``, the index of
        the tap in the whole experiment, determines the direction of travel. Return None if no
        usable tap was made; the caller should try again.

        Raises:
            SeriesStopped: the experiment cannot continue.
        """
        self._wait()
        wanted = travel_direction(self.client.object_pose(), number)
        result = self.client.tap(striker_speed, incidence, wanted, math.pi, self.check)
        code = result.error_code
        uncertain = code != ErrorCode.NONE and result.record.outcome == TapperState.UNKNOWN
        # After a stop or a fault, the series must not go on when somebody resets the cell.
        ended = code not in (ErrorCode.NONE, *NO_CLEARANCE, *PASSING)
        if result.record.tap_id == 0 or uncertain or ended:
            self._untapped(code, result.error_msg)
            return None
        self._failures = 0
        return result

    def _untapped(self, code: int, sentence: str) -> None:
        """Handle a tap that cannot be used, usually because it was not fired: bring the object back
        if required, or raise SeriesStopped."""
        self._failures += 1
        name = error_codes.name(code)
        if self._failures >= IN_A_ROW or code not in (*NO_CLEARANCE, *PASSING):
            raise SeriesStopped(code, f"{name}: {sentence}")
        if code in NO_CLEARANCE:
            self._bring_back(code, sentence)

    def _bring_back(self, code: int, sentence: str) -> None:
        """Bring the object to the middle of the table with an ordinary goal."""
        middle = Pose(0.0, 0.0, self.client.object_pose().theta)
        if self.client.object_pose().distance_to(middle) <= BACK_TOLERANCE[0]:
            raise SeriesStopped(code, f"{error_codes.name(code)}: {sentence}")
        self.client.send(middle, BACK_TOLERANCE)
        try:
            for event in self.client.events():
                self.check()
                if isinstance(event, Finished) and event.error_code:
                    raise SeriesStopped(
                        event.error_code,
                        f"the object could not be brought back to the middle of the table: "
                        f"{event.error_msg}",
                    )
        except BaseException:
            self.client.cancel()
            raise

    def _wait(self) -> None:
        """Wait until the cell can tap."""
        deadline = time.monotonic() + READY_TIMEOUT_S
        while missing := self.client.missing():
            self.check()
            if time.monotonic() > deadline:
                raise SeriesStopped(
                    ErrorCode.NOT_READY,
                    f"the cell was not ready for a tap within {READY_TIMEOUT_S:.0f} s: "
                    + "; ".join(missing),
                )
            time.sleep(0.02)


def trial_of(
    client: SingleTapClient, tap: Tap, record: TapRecord, camera_rate: float, problem: str
) -> Trial:
    """Convert a measured tap to a trial. The trial's outcome is ``lost`` if the object was not
    visible after the tap. ``camera_rate`` is in Hz and may be NaN. ``problem`` is the planner's
    error message about the tap, or an empty text."""
    start, end = from_message(record.object_pose), from_message(record.measured_pose.pose)
    lost = not math.isfinite(end.x)
    tip = client.tip_of(int(record.tap_id)) or from_message(record.strike_pose)
    incidence, contact = contact_of(tap, start, tip, record.striker_speed)
    spread = covariance_from_message(record.measured_pose.covariance)
    notes = [problem] if problem else []
    if record.outcome != TapperState.FIRED:
        notes.append("the tapper did not report whether it fired")
    return Trial(
        run=0,
        trial=0,
        outcome="lost" if lost else "ok",
        striker_speed=record.striker_speed,
        # The record contains NaN if there is no speed sensor, and 0 if no release was reported.
        # Both become NaN.
        striker_speed_measured=record.measured_speed or math.nan,
        incidence=incidence,
        contact_angle=contact,
        start_x=start.x,
        start_y=start.y,
        start_theta=start.theta,
        end_x=end.x,
        end_y=end.y,
        end_theta=end.theta,
        # Standard deviation along one axis. The variance of one observation is taken as the mean of
        # its variances in x and y. A displacement is the difference of two observations, so it has
        # twice this variance.
        displacement_std=math.nan if lost else math.sqrt(spread[0, 0] + spread[1, 1]),
        rotation_std=math.nan if lost else math.sqrt(2 * spread[2, 2]),
        camera_rate_hz=camera_rate,
        note="; ".join(notes),
        track=client.track_of(record),
    )
