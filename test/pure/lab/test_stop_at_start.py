"""An emergency stop that is held while the arm's node starts also ends the move that the node's
predecessor has commanded."""

from __future__ import annotations

import pytest

from lab.trial import Trial
from tapping_cell.messages import Bool

REACTION_S = 0.5
"""Maximum time from the start of the node until the arm is at rest, s."""


@pytest.mark.parametrize("seed", [21, 22, 23])  # Grbl and Marlin
def test_a_node_that_starts_during_an_emergency_stop_stops_the_move_of_its_predecessor(
    seed: int,
) -> None:
    trial = Trial(seed=seed, faults=False)
    trial.bring_up()
    scheduler, arm = trial.scheduler, trial.processes["scara_arm"]
    trial.call_service("scara_arm", "~/home")
    scheduler.run(scheduler.now + 5.0, lambda: trial.physical.moving(scheduler.now))
    scheduler.run(scheduler.now + 0.3)
    arm.kill()
    trial.network.publish("panel", "emergency_stop", Bool(data=True))
    arm.start()
    scheduler.run(scheduler.now + 3.0, lambda: scheduler.now >= arm.runs_since)
    assert trial.physical.moving(scheduler.now), (
        "the homing cycle has ended too early for this test"
    )
    scheduler.run(scheduler.now + REACTION_S)
    assert not trial.physical.moving(scheduler.now)
