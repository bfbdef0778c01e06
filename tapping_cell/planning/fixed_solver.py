"""Cache of solved goals of fixed tappers; goals can be solved in a separate process.

Solving a goal takes seconds of processor time. A solving thread would block the interpreter for the
other threads, so that the planner's heartbeat would stop.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any

import numpy as np

from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.fixed_iteration import (
    FINE,
    Abandoned,
    solve_coarse,
    solve_finer,
)
from tapping_cell.planning.fixed_policy import Solution
from tapping_cell.planning.fixed_tappers import FixedStrikeSpace
from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import PlannerSettings

KEPT_SOLUTIONS = 16

FINER = (0.33, FINE)
"""Steps of the grids that follow the coarse one in the background."""

NICENESS = 5
"""Niceness of the solving process, so that the cell's nodes have priority."""


class SolvedGoal:
    """A goal that is solved, or being solved: coarse first, then finer and finer."""

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


@dataclass(eq=False, slots=True)
class Job:
    """A goal to be solved in the background. finer: steps of the grids after the coarse one;
    done: its solutions so far."""

    key: str
    space: FixedStrikeSpace
    settings: PlannerSettings
    place: Array
    finer: tuple[float, ...]
    done: list[Solution] = field(default_factory=list)

    @property
    def is_done(self) -> bool:
        """Whether all solutions are computed."""
        return len(self.done) == 1 + len(self.finer)

    def next_solution(self, interrupted: Callable[[], bool]) -> Solution:
        """Compute the next, better solution; raises ``Abandoned`` as ``solve_finer`` does."""
        if not self.done:
            made = solve_coarse(self.space, self.settings, self.place)
        else:
            step = self.finer[len(self.done) - 1]
            made = solve_finer(self.space, self.settings, self.done[-1], step, interrupted)
        self.done.append(made)
        return made


class GoalSolver:
    """Solves goals for one object and cell, and caches the last solutions.

    ``background``: solve in a separate process and return the best solution so far. ``finer``:
    steps of the grids after the coarse one.
    """

    def __init__(self, *, background: bool = False, finer: tuple[float, ...] = FINER) -> None:
        self._finer = finer
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
                self._worker.ask(Job(key, space, settings, place, self._finer))
            else:
                solution = solve_coarse(space, settings, place)
                for step in self._finer:
                    solution = solve_finer(space, settings, solution, step)
                made.take(solution)
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
        Thread(target=self._receive, name="goal solver", daemon=True).start()

    def ask(self, job: Job) -> None:
        """Request the solution of a goal, which is solved before the goals requested earlier."""
        self._asked.append(job.key)
        try:
            self._line.send(job)
        except OSError:
            self._take(job.key, _solver_ended())

    def _receive(self) -> None:
        while True:
            try:
                key, result = self._line.recv()
            except (EOFError, OSError):
                for asked in self._asked:
                    self._take(asked, _solver_ended())
                return
            self._take(key, result)


def _solver_ended() -> PlanningError:
    return PlanningError("the process that solves goals has ended; start the planner again")


def _work(line: Connection) -> None:
    """Solve goals until the connection is closed: the last request first, and every goal on the
    coarse grid before any goal on a finer one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    jobs: list[Job] = []
    with suppress(EOFError, OSError):
        while True:
            while not jobs or line.poll():
                jobs.append(line.recv())
            job = max(jobs, key=lambda job: (-len(job.done), jobs.index(job)))
            try:
                result = job.next_solution(line.poll)
            except Abandoned:
                continue
            except Exception as error:  # sent to the requester, because this process has no caller
                jobs.remove(job)
                line.send((job.key, error))
                continue
            line.send((job.key, result))
            if job.is_done:
                jobs.remove(job)
