"""The deterministic simulator: its events happen in order, only its seed matters, and a defect
makes the checks fail."""

from __future__ import annotations

import math
import random
from typing import NoReturn

import pytest

from lab.trial import Trial
from lab.virtual_cell.scheduler import Fiber, HangError, Killed, Scheduler
from tapping_cell.logic.arm import ArmLogic
from tapping_cell.logic.transitions import UndefinedTransition


def test_events_happen_in_the_order_of_their_times() -> None:
    scheduler, events = Scheduler(), list[float]()
    for time in (3.0, 1.0, 2.0, 1.0):
        scheduler.at(time, lambda: events.append(scheduler.now))
    scheduler.at(1.5, lambda: events.append(-1.0)).cancel()
    scheduler.run(10.0)
    assert events == [1.0, 1.0, 2.0, 3.0] and scheduler.now == 10.0


def test_a_fiber_waits_in_virtual_time_and_ends_where_it_is_killed() -> None:
    scheduler, events = Scheduler(), list[object]()

    def body() -> None:
        try:
            fiber.wait_until(5.0)
            events.append(scheduler.now)
            fiber.wait_until(math.inf)
        except Killed:
            events.append("killed")
            raise

    fiber = Fiber(scheduler, "test", body)
    fiber.start()
    fiber.freeze(7.0)
    scheduler.run(20.0)
    assert events == [7.0], "a frozen fiber goes on when it is thawed"
    fiber.kill()
    assert events == [7.0, "killed"] and fiber.ended


def test_endless_events_at_one_time_are_reported_as_a_hang() -> None:
    scheduler = Scheduler()

    def again() -> None:
        scheduler.after(0.0, again)

    again()
    with pytest.raises(HangError):
        scheduler.run(1.0)


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
def test_a_run_draws_no_number_that_is_not_of_its_seed(
    monkeypatch: pytest.MonkeyPatch, dialect: str
) -> None:
    def refuse(self: random.SystemRandom, bits: int) -> int:
        raise AssertionError("a random number of the operating system")

    monkeypatch.setattr(random.SystemRandom, "getrandbits", refuse)
    trials = (Trial(seed=seed, faults=False) for seed in range(100))
    report = next(trial for trial in trials if trial.cell.arm.dialect == dialect).run(1)
    assert report.violations == []


def test_an_error_of_the_simulator_is_a_violation_of_its_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A campaign goes on, and the run can be replayed by its seed."""

    def fail(self: Trial, number: int) -> None:
        raise ZeroDivisionError(f"goal {number}")

    monkeypatch.setattr(Trial, "next_goal", fail)
    report = Trial(seed=21, trace=True, faults=False).run(2)
    (violation,) = report.violations
    assert violation.name == "simulator defect"
    assert violation.sentence == "ZeroDivisionError: goal 0"
    assert "Traceback" in report.trace[-1]


def test_a_state_machine_that_raises_while_it_handles_an_error_is_detected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The ROS host would end after the second exception."""

    def fail(*_: object) -> NoReturn:
        raise ValueError("wrong")

    def fail_again(*_: object) -> NoReturn:
        raise UndefinedTransition("no way out")

    trial = Trial(5, faults=False)
    monkeypatch.setattr(ArmLogic, "on_defect", fail_again)
    trial.scheduler.after(5.0, lambda: monkeypatch.setattr(ArmLogic, "on_tick", fail))
    report = trial.run(3)
    unhandled, first = report.violations
    assert (unhandled.name, first.name) == ("unhandled defect", "defect")
    assert "no way out" in unhandled.sentence
    assert "ValueError" in first.sentence


@pytest.mark.parametrize("speed", [0.0, -1.0, 1000.0, math.nan, math.inf])
def test_an_impossible_striker_speed_has_no_energy(speed: float) -> None:
    """Another program may command such a tap, which the tapper refuses."""
    assert Trial(seed=21, faults=False).physical.energy_for(speed) == math.inf
