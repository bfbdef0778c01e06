"""Trials of a single-tap experiment, made one after another and recorded immediately."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from tapping_cell_msgs.msg import ErrorCode, TapRecord

from tapping_cell.calibration.design import (
    ATTEMPTS,
    Design,
    Run,
    given_up,
    judged,
    progress,
)
from tapping_cell.calibration.experiment import ExperimentFile
from tapping_cell.calibration.trials import Trial, append_trial
from tapping_cell.cli.tap_maker import SeriesStopped, TapMaker, trial_of
from tapping_cell.mechanics import Tap
from tapping_cell.nodes.clients.single_tap_client import SingleTapClient
from tapping_cell.report.bag import BagWriter


@dataclass(frozen=True, slots=True)
class Done:
    """Completed trial, and the distance in m by which its tap was expected to move the object."""

    run: Run
    trial: Trial
    expected: float


@dataclass(slots=True)
class TapSeries:
    """One session of an experiment; makes the missing trials of the design."""

    client: SingleTapClient
    folder: Path
    design: Design
    header: ExperimentFile
    tap: Tap
    bag: BagWriter
    trials: list[Trial]
    check: Callable[[], None]
    """Raises an exception if the experiment must end, for example because a node died."""
    _maker: TapMaker = field(init=False)

    def __post_init__(self) -> None:
        self._maker = TapMaker(self.client, self.check)

    def run(self) -> Iterator[Done]:
        """Make the missing trials of the design. Each trial is written to disk before it is
        yielded.

        Raises:
            SeriesStopped: the experiment cannot continue.
            OSError, RecordError: a record cannot be written.
        """
        for run in self.design.runs:
            while (far := progress(self.design, self.trials)[run.number]).used < self.design.trials:
                if given_up(self.design, far):
                    raise SeriesStopped(
                        ErrorCode.TAP_WITHOUT_EFFECT,
                        f"run {run.number}: only {far.used} of {far.made} trials are usable "
                        f"({self.design.trials} usable trials are needed from at most "
                        f"{ATTEMPTS * self.design.trials}); see the column 'note' of the run's "
                        "file, and calibrate arm, tapper and camera",
                    )
                done = self._trial(run, far.made + 1)
                if done is not None:
                    self.trials.append(done.trial)
                    yield done

    def _trial(self, run: Run, number: int) -> Done | None:
        """Make one trial. Return None if no tap was made and the trial should be repeated."""
        result = self._maker.make(run.striker_speed, run.incidence, len(self.trials))
        if result is None:
            return None
        record: TapRecord = result.record
        expected = math.hypot(record.dx, record.dy)
        rate = self.header.camera_rate_hz or math.nan
        trial = replace(
            trial_of(self.client, self.tap, record, rate, result.error_msg),
            run=run.number,
            trial=number,
        )
        trial = judged(trial, self.header, expected)
        self.client.write_bag(self.bag)
        append_trial(self.folder, trial)
        return Done(run, trial, expected)
