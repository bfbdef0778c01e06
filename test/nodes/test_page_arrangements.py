"""Goals that were placed on the page survive its reload."""

from __future__ import annotations

from unittest.mock import Mock

import pytest
from tapping_cell_msgs.msg import ArrangementState, ObjectProgress

from tapping_cell.nodes.conversions import to_message
from tapping_cell.nodes.page import arrangements
from tapping_cell.nodes.page.arrangements import Arrangements
from tapping_cell.se2 import Pose

SENT, PLACED = Pose(0.1, 0.0, 0.0), Pose(0.0, 0.1, 0.5)


def test_goals_placed_during_an_arrangement_survive_a_reload_of_the_only_page(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(arrangements, "ActionClient", Mock())
    one = Arrangements(Mock(), Mock())
    goal = ObjectProgress(object_id="disk", has_goal=True, goal_pose=to_message(SENT))
    active, ended = ArrangementState(active=True, objects=[goal]), ArrangementState()
    one._on_progress(active)
    assert one.drafts is not None and one.drafts["disk"].distance_to(SENT) < 1e-9
    one.drafts = {"disk": PLACED}
    one.forget()
    one._on_progress(active)  # the topic is latched
    assert one.active and one.drafts == {"disk": PLACED}
    one._on_progress(ended)
    one._on_progress(active)
    assert one.drafts["disk"].distance_to(SENT) < 1e-9, "a new arrangement is shown"
