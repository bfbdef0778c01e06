"""The trials of ``lab drivers --controllers``: one of each kind passes, and a defect makes them
fail."""

from __future__ import annotations

import pytest

from lab.drivers.controller_cell import NAMES, ControllerCell
from lab.drivers.controller_trials import FAULTS, run_faults, run_moves
from tapping_cell.hardware.scara import Joints


@pytest.mark.parametrize("kind", FAULTS)
def test_one_trial_of_each_kind_succeeds_on_every_controller(kind: str) -> None:
    for name in FAULTS[kind].controllers:
        outcome = run_faults(name, kind, 1, seed=2)
        assert outcome.tried == 1 and outcome.wrong == [], name


@pytest.mark.parametrize("name", NAMES)
def test_an_arm_that_is_not_where_it_reports_is_counted_as_wrong(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run_moves(name, 3, seed=2).wrong == []
    truth = ControllerCell.truth

    def sunk(cell: ControllerCell) -> Joints:
        joints = truth(cell)
        return joints._replace(quill=joints.quill - 0.01)

    monkeypatch.setattr(ControllerCell, "truth", sunk)
    assert all("but the arm is at" in sentence for sentence in run_moves(name, 3, seed=2).wrong)
    assert len(run_moves(name, 3, seed=2).wrong) == 3
