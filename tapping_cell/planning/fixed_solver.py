"""Cache of solved goals of fixed tappers; goals can be solved in a separate process.

Solving a goal takes seconds of processor time. A solving thread would block the interpreter for the
other threads, so that the planner's heartbeat would stop.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import OrderedDict
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any

import numpy as np

from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.fixed_iteration import FINE, solve_coarse, solve_finer
from tapping_cell.planning.fixed_policy import Solution
from tapping_cell.planning.fixed_tappers import FixedStrikeSpace
from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import PlannerSettings

KEPT_SOLUTIONS = 16

NICENESS = 5
"""Niceness of the solving process, so that the cell's nodes have priority."""


class SolvedGoal:
    """A goal that is solved or being solved, first on the coarse grid, then on the fine grid."""

    def __init__(self) -> None:
        self._solution: Solution | None = None
        self._failure: Exception | None = None

    @property
    def solution(self) -> Solution | None:
        """Best solution so far, or None.

        Raises the exception of the solver if it failed before the first solution.
        """
        if self._failure is not None and self._solution is None:
            raise self._failure
        return self._solution

    def take(self, result: Solution | Exception) -> None:
        """Store a better solution or the error of the solver."""
        if isinstance(result, Exception):
            self._failure = result
        else:
            self._solution = result


class GoalSolver:
    """Solves goals for one object and cell, and caches the last solutions.

    ``background``: solve in a separate process; callers get the best solution so far. ``step``:
    step of the fine grid if the goal is solved in this process.
    """

    def __init__(self, *, background: bool = False, step: float = FINE) -> None:
        self._step = step
        self._kept: OrderedDict[str, SolvedGoal] = OrderedDict()
        self._worker = _Worker(self._take) if background else None

    def goal(self, space: FixedStrikeSpace, settings: PlannerSettings, goal: Array) -> SolvedGoal:
        """Return the solved goal. Without a background process a new goal takes seconds."""
        turn = 0.0 if space.is_round else float(goal[2])
        place = np.array([goal[0], goal[1], turn])
        key = f"{space.key()};{settings.key()};{np.round(place, 6).tolist()}"
        if key not in self._kept:
            made = self._kept[key] = SolvedGoal()
            if self._worker is not None:
                self._worker.ask(key, space, settings, place)
            else:
                coarse = solve_coarse(space, settings, place)
                made.take(solve_finer(space, settings, coarse, self._step))
            while len(self._kept) > KEPT_SOLUTIONS:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    def _take(self, key: str, result: Solution | Exception) -> None:
        kept = self._kept.get(key)
        if kept is not None:
            kept.take(result)


class _Worker:
    """The solving process, which starts immediately and ends with this process."""

    def __init__(self, take: Any) -> None:
        self._take = take
        self._asked: list[str] = []
        context = multiprocessing.get_context("spawn")
        self._line, far = context.Pipe()
        process = context.Process(target=_work, args=(far,), name="goal solver", daemon=True)
        process.start()
        far.close()
        Thread(target=self._hear, name="goal solver", daemon=True).start()

    def ask(
        self, key: str, space: FixedStrikeSpace, settings: PlannerSettings, place: Array
    ) -> None:
        """Queue a goal for solving."""
        self._asked.append(key)
        try:
            self._line.send((key, space, settings, place))
        except OSError:
            self._take(key, _gone())

    def _hear(self) -> None:
        while True:
            try:
                key, result = self._line.recv()
            except (EOFError, OSError):
                for asked in self._asked:
                    self._take(asked, _gone())
                return
            self._take(key, result)


def _gone() -> PlanningError:
    return PlanningError("the process that solves goals has ended; start the planner again")


def _work(line: Connection) -> None:
    """Solve the goals received on the pipe until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    while True:
        try:
            key, space, settings, place = line.recv()
        except EOFError:
            return
        try:
            coarse = solve_coarse(space, settings, place)
            line.send((key, coarse))
            line.send((key, solve_finer(space, settings, coarse)))
        except OSError:
            return
        except Exception as error:  # sent to the parent, because this process has no caller
            line.send((key, error))
