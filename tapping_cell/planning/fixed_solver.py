"""Goals of fixed tappers, solved once and kept; in a process of its own where nobody can wait.

Solving takes seconds of processor time. In a thread it would keep the interpreter from whoever else
needs it, and the planner from telling that it is alive.
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
"""Of the solving process: the cell's nodes come first."""


class SolvedGoal:
    """A goal that is solved, or being solved: coarse first, then fine."""

    def __init__(self) -> None:
        self._solution: Solution | None = None
        self._failure: Exception | None = None

    @property
    def solution(self) -> Solution | None:
        """The best solution so far; None while there is none.

        Raises what solving it raised.
        """
        if self._failure is not None and self._solution is None:
            raise self._failure
        return self._solution

    def take(self, result: Solution | Exception) -> None:
        """A better solution, or why there will be none."""
        if isinstance(result, Exception):
            self._failure = result
        else:
            self._solution = result


class GoalSolver:
    """Solves goals and keeps the last ones solved, for one object and cell.

    ``background``: in a process of its own; who asks gets the best solution so far. ``step``: of
    the fine grid where it is solved here.
    """

    def __init__(self, *, background: bool = False, step: float = FINE) -> None:
        self._step = step
        self._kept: OrderedDict[str, SolvedGoal] = OrderedDict()
        self._worker = _Worker(self._take) if background else None

    def goal(self, space: FixedStrikeSpace, settings: PlannerSettings, goal: Array) -> SolvedGoal:
        """The solved goal; where it is new and not for the background, after seconds."""
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
    """The solving process, started at once; it ends with this one."""

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
        """Have a goal solved after those that were asked for before."""
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
    """Solve what is asked for, until nobody asks any more."""
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
        except Exception as error:  # told to whoever asked: this process has no caller
            line.send((key, error))
