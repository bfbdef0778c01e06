"""The positioning cell (no arm, one board or two) in virtual time with all faults. An inserted
defect makes the checks fail."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from tapping_cell.messages import ErrorCode
from tapping_cell.verification.campaign import run_trial
from tapping_cell.verification.faults import Mix
from tapping_cell.verification.fixed_faults import FIXED_AT_A_SHOT, FIXED_CAUSES, FIXED_MAKERS
from tapping_cell.verification.fixed_trial import FixedTrial

MIX = Mix(fixed=True)


def test_the_same_seed_gives_the_same_trace() -> None:
    first, second = (run_trial(7, 2, trace=True, mix=MIX) for _ in range(2))
    assert first.trace == second.trace
    assert len(first.trace) > 100


@pytest.mark.parametrize("seed", [0, 1])
def test_without_faults_every_goal_is_reached(seed: int) -> None:
    trial = FixedTrial(seed, faults=False, mix=MIX)
    assert len(trial.physical.boards) == 1 + seed
    report = trial.run(2)
    assert report.violations == []
    assert trial.short_time_limit or {goal.code for goal in report.outcomes} == {ErrorCode.NONE}
    assert report.releases >= 2


@pytest.mark.parametrize("seed", range(3))
def test_nothing_unsafe_happens_under_random_faults(seed: int) -> None:
    report = run_trial(2000 + seed, 4, mix=MIX)
    assert report.violations == []
    assert len(report.outcomes) == 4


def test_the_invariants_detect_violations() -> None:
    """Modified copies of a real release each violate one of the invariants."""
    trial = FixedTrial(1, faults=False, mix=MIX)
    assert trial.run(1).violations == []
    good = next(one for one in trial.physical.releases)
    checker = trial.checker
    made = {
        "fired while another was charged": replace(good, others_charged=(0,)),
        "second striker": replace(good, others_out=("west",)),
        "wrong tapper": replace(good, tapper="nobody"),
        "object in motion": replace(good, object_at_rest=False),
    }
    checker.moved_by_hand = None
    for name, release in made.items():
        checker.violations.clear()
        checker._check_release(release, [])
        assert name in {found.name for found in checker.violations}
    checker.violations.clear()
    checker.motion_seen_by_tapper = True
    checker.on_asked("tapper_trigger", "fire", None)
    checker._check_release(good, [])
    assert "fired at observed motion" in {found.name for found in checker.violations}
    checker.violations.clear()
    trial.physical.out_since["west"] = -math.inf
    checker._check_release(good, [])
    assert "fired at a striker" in {found.name for found in checker.violations}


def test_the_faults_around_a_shot_are_known() -> None:
    assert set(FIXED_AT_A_SHOT) <= set(FIXED_MAKERS)
    assert set().union(*FIXED_CAUSES.values()) >= {"striker stays out", "striker blocked"}
