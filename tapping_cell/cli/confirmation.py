"""Confirmation of planned taps in a terminal: a person makes or skips each tap, or cancels the
goal."""

from __future__ import annotations

import math
import os
import select
import termios
from typing import TextIO

import numpy as np
from rich.console import Console
from tapping_cell_msgs.msg import PlannedTap

from tapping_cell.logic.poses import covariance_from_message
from tapping_cell.nodes.clients.goal_client import Event, GoalClient, PhaseChanged, TapProposed
from tapping_cell.nodes.conversions import from_message
from tapping_cell.report.words import expected_effort

QUESTION = "make this tap? y: yes, s: skip it, c: cancel the goal"


class Person:
    """Ask about each proposed tap and read the answers, without blocking the reception of
    events."""

    def __init__(self, client: GoalClient, console: Console, answers: TextIO) -> None:
        self._client = client
        self._console = console
        self._answers = answers.fileno()
        self._typed = b""
        self._asked = 0

    def on_event(self, event: Event | None) -> None:
        """Process an event, and the input that the person has typed. ``event`` is None if none
        arrived.

        Raises:
            KeyboardInterrupt: the person cancels the goal, or the input has ended.
        """
        if isinstance(event, PhaseChanged):
            self._asked = 0  # another client answered the question, or the tap was replanned
        elif isinstance(event, TapProposed):
            self._asked = event.tap.tap_id
            if os.isatty(self._answers):
                # Input typed before the tap was shown does not count as an answer.
                termios.tcflush(self._answers, termios.TCIFLUSH)
                self._typed = b""
            self._print(proposal_text(event.tap))
            self._print(QUESTION)
        if self._asked and (line := self._line()) is not None:
            self._take(line)

    def _line(self) -> str | None:
        """Return the next typed line, ``c`` at the end of the input, or None if no line was typed
        yet."""
        if b"\n" not in self._typed and select.select([self._answers], [], [], 0)[0]:
            read = os.read(self._answers, 1024)
            self._typed += read or b"c\n"
        line, end, rest = self._typed.partition(b"\n")
        if not end:
            return None
        self._typed = rest
        return line.decode(errors="replace")

    def _take(self, line: str) -> None:
        word = line.strip().lower()
        if word in ("c", "cancel"):
            raise KeyboardInterrupt
        if word not in ("y", "yes", "s", "skip"):
            self._print(QUESTION)
            return
        tap_id, self._asked = self._asked, 0
        try:
            response = self._client.confirm(tap_id, word.startswith("y"))
        except TimeoutError as error:
            self._print(str(error))
            return
        if not response.accepted:
            self._print(f"{response.error_msg} ({response.error_code})")

    def _print(self, text: str) -> None:
        self._console.print(text, highlight=False, markup=False)


def proposal_text(tap: PlannedTap) -> str:
    """Format a planned tap with its expected result and the uncertainty of that result."""
    before, after = from_message(tap.object_pose), from_message(tap.predicted_pose.pose)
    covariance = covariance_from_message(tap.predicted_pose.covariance)
    along = math.sqrt(max(float(np.max(np.linalg.eigvalsh(covariance[:2, :2]))), 0.0))
    turn = math.sqrt(max(float(covariance[2, 2]), 0.0))
    effort = expected_effort(tap.expected_taps, tap.expected_seconds)
    why = f"; expected to the goal: {effort}" if effort else ""
    why += f"; {tap.reason}" if tap.reason else ""
    return (
        f"tap {tap.number} planned: striker {1000 * tap.striker_speed:.0f} mm/s, expected to move "
        f"the object {1000 * before.distance_to(after):.1f} mm (+- {1000 * along:.1f} mm) and turn "
        f"it {math.degrees(before.rotation_to(after)):+.1f} deg (+- {math.degrees(turn):.1f} deg), "
        f"to x {1000 * after.x:.1f} mm, y {1000 * after.y:.1f} mm{why}"
    )
