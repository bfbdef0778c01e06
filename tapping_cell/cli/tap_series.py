"""The trials of a single-tap experiment, one after the other, each recorded before the next."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tapping_cell_msgs.msg import ErrorCode, TapperState, TapRecord

from tapping_cell.calibration.design import (
    ATTEMPTS,
    Design,
    Run,
    contact_of,
    given_up,
    judged,
    progress,
    travel_direction,
)
from tapping_cell.calibration.experiment import ExperimentFile
from tapping_cell.calibration.trials import Trial, append_trial
from tapping_cell.mechanics import Tap
from tapping_cell.nodes.conversions import covariance_from_message, from_message
from tapping_cell.nodes.error_codes import NAMES
from tapping_cell.nodes.goal_client import Finished
from tapping_cell.nodes.single_tap_client import SingleTapClient
from tapping_cell.report.bag import BagWriter
from tapping_cell.se2 import Pose

READY_PATIENCE_S = 60.0
BACK_TOLERANCE = (0.015, math.radians(45.0))
"""Of a goal that brings the object back, m and rad: loose, so that it is quick."""
NO_ROOM = (ErrorCode.TAP_LEAVES_TABLE, ErrorCode.TAP_LEAVES_VIEW, ErrorCode.NO_TAP_FOUND)
"""Refusals that a better place of the object may cure."""
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
"""Failures that may pass by themselves: the cell is waited for, then the trial is made again."""
IN_A_ROW = 3


class SeriesStopped(RuntimeError):
    """The experiment cannot go on; ``code`` of ErrorCode and a sentence. What is done is kept."""

    def __init__(self, code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


@dataclass(frozen=True, slots=True)
class Done:
    """A trial that was made, with the distance in m that was expected of it."""

    run: Run
    trial: Trial
    expected: float


@dataclass(slots=True)
class TapSeries:
    """One session of an experiment: from the trials that are there to those of the design."""

    client: SingleTapClient
    folder: Path
    design: Design
    header: ExperimentFile
    tap: Tap
    bag: BagWriter
    trials: list[Trial]
    check: Callable[[], None]
    """Raises where the experiment must end, such as when a node died."""
    _failures: int = field(default=0, init=False)

    def run(self) -> Iterator[Done]:
        """Make what is left of the design; each trial is on disk when it is yielded.

        Raises:
            SeriesStopped: it cannot go on.
            OSError, RecordError: a record cannot be written.
        """
        for run in self.design.runs:
            while (far := progress(self.design, self.trials)[run.number]).used < self.design.trials:
                if given_up(self.design, far):
                    raise SeriesStopped(
                        ErrorCode.TAP_WITHOUT_EFFECT,
                        f"run {run.number}: of {far.made} trials {far.used} can be used, where "
                        f"{self.design.trials} are wanted of at most "
                        f"{ATTEMPTS * self.design.trials}; the column 'note' of its file says "
                        "why; calibrate arm, tapper and camera",
                    )
                done = self._trial(run, far.made + 1)
                if done is not None:
                    self.trials.append(done.trial)
                    yield done

    def _trial(self, run: Run, number: int) -> Done | None:
        """One trial; None where nothing was tapped and it should be tried again."""
        self._wait()
        start = self.client.object_pose()
        wanted = travel_direction(start, len(self.trials))
        result = self.client.tap(run.striker_speed, run.incidence, wanted, math.pi, self.check)
        record: TapRecord = result.record
        if record.tap_id == 0:
            self._untapped(result.error_code, result.error_msg)
            return None
        self._failures = 0
        expected = math.hypot(record.dx, record.dy)
        trial = judged(self._recorded(run, number, record, result.error_msg), self.header, expected)
        self.client.write_bag(self.bag)
        append_trial(self.folder, trial)
        return Done(run, trial, expected)

    def _untapped(self, code: int, sentence: str) -> None:
        """What to do about a trial that never began."""
        self._failures += 1
        name = NAMES.get(code, str(code))
        if self._failures >= IN_A_ROW or code not in (*NO_ROOM, *PASSING):
            raise SeriesStopped(code, f"{name}: {sentence}")
        if code in NO_ROOM:
            self._bring_back(code, sentence)

    def _bring_back(self, code: int, sentence: str) -> None:
        """Bring the object to the middle of the table by an ordinary goal."""
        middle = Pose(0.0, 0.0, self.client.object_pose().theta)
        if self.client.object_pose().distance_to(middle) <= BACK_TOLERANCE[0]:
            raise SeriesStopped(code, f"{NAMES.get(code, code)}: {sentence}")
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
        deadline = time.monotonic() + READY_PATIENCE_S
        while missing := self.client.missing():
            self.check()
            if time.monotonic() > deadline:
                raise SeriesStopped(
                    ErrorCode.NOT_READY,
                    f"the cell was not ready for a tap within {READY_PATIENCE_S:.0f} s: "
                    + "; ".join(missing),
                )
            time.sleep(0.02)

    def _recorded(self, run: Run, number: int, record: TapRecord, trouble: str) -> Trial:
        """The trial as measured; ``lost`` where the object was not seen after the tap."""
        start, end = from_message(record.object_pose), from_message(record.measured_pose.pose)
        lost = not math.isfinite(end.x)
        tip = self.client.tip_of(int(record.tap_id)) or from_message(record.strike_pose)
        incidence, contact = contact_of(self.tap, start, tip, record.striker_speed)
        spread = covariance_from_message(record.measured_pose.covariance)
        notes = [trouble] if trouble else []
        if record.outcome != TapperState.FIRED:
            notes.append("the tapper did not say whether it fired")
        return Trial(
            run=run.number,
            trial=number,
            outcome="lost" if lost else "ok",
            striker_speed=record.striker_speed,
            # NaN without a gate; 0 where the release was not heard of.
            striker_speed_measured=record.measured_speed or math.nan,
            incidence=incidence,
            contact_angle=contact,
            start_x=start.x,
            start_y=start.y,
            start_theta=start.theta,
            end_x=end.x,
            end_y=end.y,
            end_theta=end.theta,
            # Two looks make a displacement; of one axis of it.
            displacement_std=math.nan if lost else math.sqrt(spread[0, 0] + spread[1, 1]),
            rotation_std=math.nan if lost else math.sqrt(2 * spread[2, 2]),
            camera_rate_hz=self.header.camera_rate_hz or math.nan,
            note="; ".join(notes),
            track=self.client.track_of(record),
        )
