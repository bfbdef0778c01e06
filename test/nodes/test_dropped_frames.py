"""If images arrive faster than the node can process them, the node takes only the newest image. If
the node is merely blocked for a short time, it processes all images."""

from __future__ import annotations

import pytest

from tapping_cell.nodes.camera.dropped_frames import LONGEST_WAIT_S, Backlog


def film(
    period: float, each: float, pictures: int, jam: float = 0.0
) -> tuple[Backlog, list[float]]:
    """Simulate a node that needs ``each`` s per image and is blocked once for ``jam`` s, while an
    image arrives every ``period`` s. Return the backlog and the ages of the results, s."""
    backlog, queue, ages = Backlog(), [period * k for k in range(pictures)], []
    now, jammed = 0.0, False
    while queue:
        now = max(now, queue[0])
        if not jammed and len(queue) < pictures / 2:
            now, jammed = now + jam, True
        taken = queue.pop(0)
        backlog.arrived(taken)
        while backlog.stale(now) and queue and queue[0] <= now:
            backlog.passed_over += 1
            taken = queue.pop(0)
            backlog.arrived(taken)
        now += each
        backlog.processed(now)
        ages.append(now - taken)
    return backlog, ages


@pytest.mark.parametrize(("rate", "each"), [(30.0, 0.060), (120.0, 0.011), (60.0, 0.2)])
def test_results_are_not_delayed_unnecessarily(rate: float, each: float) -> None:
    backlog, ages = film(1.0 / rate, each, 400)
    # Once the node knows that it cannot keep up, a result is at most as old as the processing time
    # plus one period. The last image is excluded because none follows it.
    assert max(ages[20:-1]) < each + 1.0 / rate + 0.005
    assert len(ages) + backlog.passed_over == 400
    assert "only the newest" in backlog.sentence


def test_a_node_that_keeps_up_clears_its_queue_without_dropping_frames() -> None:
    backlog, ages = film(1.0 / 30.0, 0.012, 300, jam=0.1)
    assert backlog.passed_over == 0 and len(ages) == 300
    assert ages[-1] == pytest.approx(0.012) and not backlog.sentence


def test_after_a_long_delay_the_newest_frame_is_processed_first() -> None:
    backlog, ages = film(1.0 / 30.0, 0.012, 300, jam=0.6)
    assert 10 < backlog.passed_over < 20
    assert max(ages) < LONGEST_WAIT_S
