"""The designed experiment: its runs, the goal of each trial, and the outcome of a trial."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.design import (
    Design,
    Progress,
    contact_of,
    given_up,
    judged,
    progress,
    read_design,
    travel_direction,
    write_design,
)
from tapping_cell.calibration.experiment import ExperimentFile
from tapping_cell.calibration.trials import Track, Trial
from tapping_cell.mechanics import Disk, Impact, Sliding, Striker, Tap
from tapping_cell.se2 import Pose

HEADER = ExperimentFile(format=1, made="2026-01-01T00:00:00+00:00", source="simulated")
DISK = Disk(radius=0.048, mass=0.2455, height=0.012)
TAP = Tap(
    sliding=Sliding(DISK, friction=0.17, torque_factor=3.64, gravity=9.81),
    impact=Impact(DISK, Striker(0.1, 0.0054), restitution=0.86, friction=0.20),
)


def test_the_default_is_that_of_the_paper() -> None:
    design = Design()
    assert len(design.runs) == 4 and design.trials == 10
    assert len({(run.striker_speed, abs(run.incidence)) for run in design.runs}) == 4
    assert [run.number for run in design.runs] == [1, 2, 3, 4]


@given(
    travels=st.lists(st.floats(0.02, 0.13), min_size=60, max_size=60),
    luck=st.lists(st.floats(-0.25, 0.25), min_size=60, max_size=60),
)
def test_the_object_stays_near_the_middle(travels: list[float], luck: list[float]) -> None:
    place = Pose(0.0, 0.0, 0.0)
    for number, (travel, error) in enumerate(zip(travels, luck, strict=True)):
        heading = travel_direction(place, number) + error
        place = Pose(
            place.x + travel * math.cos(heading), place.y + travel * math.sin(heading), 0.0
        )
        assert math.hypot(place.x, place.y) < 0.165


def test_outward_trials_cover_every_direction_and_return_on_the_same_line() -> None:
    headings = np.array([travel_direction(Pose(0.0, 0.0, 0.0), n) for n in range(0, 40, 2)])
    gaps = np.diff(np.sort(headings), append=np.sort(headings)[0] + 2 * math.pi)
    assert gaps.max() < math.radians(60)
    out = travel_direction(Pose(0.0, 0.0, 0.0), 4)
    back = travel_direction(Pose(0.1 * math.cos(out), 0.1 * math.sin(out), 0.0), 5)
    assert math.remainder(back - out - math.pi, math.tau) == pytest.approx(0.0, abs=1e-9)


@given(
    angle=st.floats(-3.1, 3.1),
    incidence=st.floats(-0.9, 0.9),
    theta=st.floats(-3.1, 3.1),
    speed=st.floats(0.1, 2.0),
)
def test_the_contact_follows_from_the_geometry(
    angle: float, incidence: float, theta: float, speed: float
) -> None:
    """``angle`` is the direction of the contact in the object's frame; the contact normal is
    opposite to it."""
    start = Pose(0.03, -0.02, theta)
    normal = angle + theta + math.pi
    back = DISK.radius + 0.0054
    heading = normal + incidence
    tip = Pose(
        start.x - back * math.cos(normal) - 0.015 * math.cos(heading),
        start.y - back * math.sin(normal) - 0.015 * math.sin(heading),
        heading,
    )
    found_incidence, found_angle = contact_of(TAP, start, tip, speed)
    assert found_incidence == pytest.approx(incidence, abs=1e-9)
    assert math.remainder(found_angle - angle, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_a_tip_that_would_miss_has_no_contact() -> None:
    contact = contact_of(TAP, Pose(0.0, 0.0, 0.0), Pose(-0.1, 0.06, 0.0), 0.5)
    assert all(math.isnan(value) for value in contact)


def slide(distance: float = 0.06, pushed: float = 0.0, hidden: bool = False) -> Trial:
    """Return a trial measured by a camera of 30 Hz. ``pushed``: distance in m by which a hand
    pushes the object 0.5 s after the end of the slide."""
    friction = 1.7
    speed = math.sqrt(2 * friction * distance)
    time = np.arange(-0.5, 1.5, 1 / 30)
    sliding = np.clip(time, 0.0, speed / friction)
    along = speed * sliding - friction / 2 * sliding**2 + np.where(time > 0.9, pushed, 0.0)
    seen = ~((time > 0.03) & (time < 0.2)) if hidden else np.full(time.shape, True)
    still = np.zeros(time.shape)[seen]
    noise = np.full(still.shape, 0.00002)
    track = Track(time[seen], along[seen], still, still, noise, np.full(still.shape, 0.0003))
    return Trial(
        run=1,
        trial=1,
        start_x=0.0,
        start_y=0.0,
        start_theta=0.0,
        end_x=float(along[-1]),
        end_y=0.0,
        end_theta=0.0,
        camera_rate_hz=30.0,
        track=track,
    )


@pytest.mark.parametrize(
    ("trial", "outcome", "word"),
    [
        (slide(), "ok", ""),
        (slide(0.0003), "missed", "expected"),
        (slide(pushed=0.02), "disturbed", "pushed"),
        (slide(hidden=True), "lost", "no sample"),
        (replace(slide(), track=None), "lost", "fewer than four"),
        (replace(slide(), outcome="lost", end_x=math.nan, note="gone"), "lost", "gone"),
    ],
    ids=["good", "missed", "a hand", "hidden", "no track", "lost"],
)
def test_the_outcome_of_a_trial_is_reported(trial: Trial, outcome: str, word: str) -> None:
    result = judged(trial, HEADER, expected=0.06)
    assert result.outcome == outcome
    assert word in result.note
    assert (result.note == "") == (outcome == "ok")


def test_progress_counts_usable_trials_and_numbering_continues() -> None:
    design = Design(trials=3)
    trials = [
        Trial(run=1, trial=1),
        Trial(run=1, trial=2, outcome="lost"),
        Trial(run=1, trial=3),
        Trial(run=3, trial=7),
    ]
    far = progress(design, trials)
    assert far[1] == Progress(used=2, made=3)
    assert far[2] == Progress(used=0, made=0)
    assert far[3] == Progress(used=1, made=7)


def test_a_run_is_aborted_after_twice_its_number_of_trials() -> None:
    design = Design(trials=3)
    assert not given_up(design, Progress(used=0, made=5))
    assert given_up(design, Progress(used=2, made=6))
    assert not given_up(design, Progress(used=3, made=6))


def test_the_design_is_saved_and_never_overwritten(tmp_path: Path) -> None:
    design = Design(speeds=(0.5,), incidences=(0.1, -0.7), trials=4, seed=9)
    write_design(tmp_path / "new", design)
    assert read_design(tmp_path / "new") == design
    with pytest.raises(RecordError, match="--resume"):
        write_design(tmp_path / "new", Design())
    with pytest.raises(RecordError, match="contains no"):
        read_design(tmp_path)
    (tmp_path / "new" / "design.yaml").write_text("speeds: [0.5]\ntrials: many\n")
    with pytest.raises(RecordError, match="trials"):
        read_design(tmp_path / "new")


@pytest.mark.parametrize("values", [{"speeds": ()}, {"incidences": (0.1, 0.1)}], ids=str)
def test_an_invalid_design_is_refused(values: dict[str, tuple[float, ...]]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        Design(**values)  # type: ignore[arg-type]
