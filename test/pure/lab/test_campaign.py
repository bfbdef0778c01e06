"""Every kind of cell under random faults in virtual time: nothing unsafe happens, and without
faults every goal is reached. ``python -m lab faults`` simulates any number of goals."""

from __future__ import annotations

import pytest

from lab.campaign import run_trial, trial_of
from lab.faults.faults import ASK_MAKERS, AT_A_SHOT, MAKERS, SET_UP_MAKERS, Mix
from lab.faults.fixed_faults import FIXED_AT_A_SHOT, FIXED_MAKERS
from lab.faults.table_faults import OTHERS, TABLE_AT_A_SHOT, TABLE_MAKERS
from lab.table_trial import SHARE_OF_TABLES, has_several_objects

CELLS = {
    "arm": Mix(),
    "fixed": Mix(fixed=True),
    "several": Mix(several=True),
    "set-up": Mix(set_up=True),
    "ask": Mix(ask=True),
}


@pytest.mark.parametrize("cell", ["arm", "set-up"])
def test_the_same_seed_gives_the_same_trace(cell: str) -> None:
    first, second = (run_trial(7, 1, trace=True, mix=CELLS[cell]) for _ in range(2))
    assert first.trace == second.trace and len(first.trace) > 30
    assert first.violations == []


@pytest.mark.parametrize("cell", CELLS)
def test_without_faults_every_goal_is_reached(cell: str) -> None:
    """The oracle finds a goal that fails without a fault, except without the enabling switch."""
    report = trial_of(3, CELLS[cell], faults=False).run(1)
    assert report.violations == []
    assert 0 in {goal.code for goal in report.outcomes}
    assert report.releases >= 1


@pytest.mark.parametrize(
    ("cell", "seed", "goals"),
    [
        ("arm", 1000, 6),
        ("fixed", 2001, 4),
        ("several", 3001, 1),
        ("set-up", 4, 1),
        ("ask", 5, 1),
    ],
)
def test_nothing_unsafe_happens_under_random_faults(cell: str, seed: int, goals: int) -> None:
    report = run_trial(seed, goals, mix=CELLS[cell])
    assert report.violations == []
    assert len(report.outcomes) == goals


@pytest.mark.parametrize(
    "mix",
    [Mix(("enabling device released",), set_up=True), Mix(("ask changed",), ask=True)],
)
def test_every_run_has_the_chosen_mode_whatever_its_seed(mix: Mix) -> None:
    seed = next(filter(has_several_objects, range(100)))
    report = run_trial(seed, 1, mix=mix)
    assert report.violations == []
    assert report.faults.keys() & set(mix.only)


def test_the_seed_selects_the_cells_with_several_objects() -> None:
    share = sum(map(has_several_objects, range(2000))) / 2000
    assert share == pytest.approx(SHARE_OF_TABLES, abs=0.03)


def test_the_faults_around_a_shot_are_known() -> None:
    assert set(AT_A_SHOT) <= MAKERS.keys()
    assert not MAKERS.keys() & {*SET_UP_MAKERS, *ASK_MAKERS}
    assert set(TABLE_AT_A_SHOT) <= TABLE_MAKERS.keys() and OTHERS.keys() <= set(TABLE_AT_A_SHOT)
    assert set(FIXED_AT_A_SHOT) <= FIXED_MAKERS.keys()
