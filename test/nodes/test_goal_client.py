"""The client of the verb ``goal`` with a real planner: confirmations, and the end of the
planner."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from harness import TIMEOUT_S, bench
from rich.console import Console
from tapping_cell_msgs.msg import PlanState
from test_tap_planner import GOAL, Actors, acted, planner_process

from tapping_cell.cli import session
from tapping_cell.cli.confirmation import Person
from tapping_cell.cli.errors import ExitStatus
from tapping_cell.configuration.layout_file import LayoutFile, LayoutGoal
from tapping_cell.logic import goal_watch
from tapping_cell.messages import ErrorCode
from tapping_cell.nodes.clients.arrange_client import ArrangeClient, ArrangementEnded
from tapping_cell.nodes.clients.goal_client import Finished, GoalClient, TapProposed


@contextmanager
def client_of_a_cell() -> Iterator[GoalClient]:
    with GoalClient("goal") as client:
        session.wait_for_planner(client, 60.0, Console(quiet=True))
        yield client


def follow(client: GoalClient, typed: Callable[[], str], words: io.StringIO) -> Finished:
    """Follow the goal. ``typed`` returns what the user types when a tap is proposed."""
    reader, writer = os.pipe()
    console = Console(file=words, width=200)
    with os.fdopen(reader) as answers:
        person = Person(client, console, answers)
        on_event = person.on_event

        def listen(event: object) -> None:
            if isinstance(event, TapProposed):
                os.write(writer, typed().encode())
            on_event(event)

        person.on_event = listen  # type: ignore[method-assign]
        try:
            return session.follow(client, lambda: None, console, person)
        finally:
            os.close(writer)


def test_taps_confirmed_in_the_terminal_reach_the_goal() -> None:
    words = io.StringIO()
    with acted() as actors, client_of_a_cell() as client:
        session.send(client, GOAL, (0.0, 0.0), Console(quiet=True), ask=True)
        finished = follow(client, lambda: "what?\ny\n", words)
        assert finished.error_code == 0, finished.error_msg
        assert finished.taps == len([c for c in actors.commands if c.request == c.TAP]) >= 1
    assert words.getvalue().count("tap 1 planned: striker") == 1
    assert "make this tap?" in words.getvalue()


def test_a_goal_cancelled_in_the_terminal_makes_no_tap() -> None:
    words = io.StringIO()
    with acted() as actors, client_of_a_cell() as client:
        session.send(client, GOAL, (0.0, 0.0), Console(quiet=True), ask=True)
        with pytest.raises(KeyboardInterrupt):
            follow(client, lambda: "c\n", words)
        assert client.cancel()
        time.sleep(0.3)
        assert actors.commands == []


def test_resending_a_goal_does_not_end_the_wait_for_it() -> None:
    with acted(), client_of_a_cell() as client:
        # The goal is sent twice: here and by session.send. In operation, session.send itself sends
        # a goal again if the response to it is late.
        client.send(GOAL)
        session.send(client, GOAL, (0.0, 0.0), Console(quiet=True))
        finished = session.follow(client, lambda: None, Console(quiet=True))
        assert finished.error_code == 0, finished.error_msg


def test_a_planner_killed_during_a_goal_ends_the_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(goal_watch, "RETURN_S", 4.0)
    words = io.StringIO()
    command = [sys.executable, "-m", "tapping_cell.nodes.planner.tap_planner"]
    options = ["--ros-args", "-p", "ready_deadline:=120.0"]
    with subprocess.Popen([*command, *options], stderr=subprocess.DEVNULL) as planner:
        try:
            with GoalClient("goal") as client:
                session.wait_for_planner(client, 60.0, Console(quiet=True))
                session.send(client, GOAL, (0.0, 0.0), Console(quiet=True))
                planner.kill()  # it still waits for arm, tapper and camera, which do not exist
                finished = session.follow(client, lambda: None, Console(file=words))
        finally:
            planner.kill()
    assert finished.error_code == ErrorCode.NOT_READY, finished.error_msg
    assert "sent no message" in finished.error_msg
    assert "waiting for it to return" in words.getvalue()


def test_a_planner_killed_during_an_arrangement_ends_the_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(goal_watch, "RETURN_S", 4.0)
    layout = LayoutFile((LayoutGoal("aluminium disk", (0.03, 0.0, 0.0)),))
    with planner_process(tmp_path) as planner, ArrangeClient() as client:
        deadline = time.monotonic() + TIMEOUT_S
        while not (client.accepts_goals() and client.planner_active):
            assert time.monotonic() < deadline, "the planner is not discovered"
            time.sleep(0.1)
        client.send(layout)
        while not client.answered:
            assert time.monotonic() < deadline, "the planner has not answered"
            time.sleep(0.1)
        planner.kill()
        ended = next(event for event in client.events() if event is not None)
    assert isinstance(ended, ArrangementEnded)
    assert ended.error_code == ErrorCode.NOT_READY and "sent no message" in ended.error_msg


def test_ctrl_c_ends_a_goal_that_a_restarted_planner_has_resumed(tmp_path: Path) -> None:
    with bench(lambda: [], {}) as b:
        actors = Actors(b)
        actors.arm_arrives = False
        with planner_process(tmp_path) as planner, client_of_a_cell() as client:
            session.send(client, GOAL, (0.0, 0.0), Console(quiet=True))
            b.wait(actors.taps, "a tap")
            planner.kill()
            planner.wait()
            before = len(actors.plans)
            with planner_process(tmp_path):
                b.wait(lambda: actors.plans[before:], "the next planner")
                b.wait(lambda: actors.plans[-1].state != PlanState.IDLE, "the resumption")
                words = io.StringIO()
                assert session.cancel(client, "goal", Console(file=words)) == ExitStatus.INTERRUPTED
                b.wait(lambda: actors.plans[-1].state == PlanState.CANCELED, "the end of the goal")
                assert words.getvalue() == "goal canceled\n"


def test_ctrl_c_without_a_planner_reports_that_the_goal_may_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with planner_process(tmp_path) as planner, client_of_a_cell() as client:
        session.send(client, GOAL, (0.0, 0.0), Console(quiet=True))
        planner.kill()
        planner.wait()
        words = io.StringIO()
        assert session.cancel(client, "goal", Console(file=words)) == ExitStatus.FAILED
    assert words.getvalue() == ""
    assert "may go on" in capsys.readouterr().err


def test_a_client_that_has_sent_no_goal_cancels_no_goal() -> None:
    with acted() as actors, client_of_a_cell() as client:
        actors.arm_arrives = False
        actors.send()
        actors.bench.wait(actors.taps, "a tap of another client's goal")
        assert client.cancel()
        time.sleep(0.3)
        assert actors.plans[-1].state not in (PlanState.CANCELED, PlanState.FAILED)
