"""Solver of goals for fixed tappers, with a cache; goals can be solved in separate processes.

Solving a goal takes seconds of processor time. A solver in a thread would keep the other threads
from running, and the planner's heartbeat would stop. The first tap waits for the coarse solution,
so one process computes only coarse solutions. A second process refines them at a lower priority, so
that it does not delay the processing of camera images.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Thread

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
"""Step ratios (see ``Grading``) of the finer grids, which are solved in the background after the
coarse grid."""

SOLVING_NICENESS, REFINING_NICENESS = 0, 10
"""Niceness of the process that solves goals on the coarse grid and of the process that refines the
solutions."""


class SolvedGoal:
    """A goal that is solved or being solved, first on the coarse grid and then on finer grids."""

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
    """A goal to be solved in the background.

    finer: step ratios of the grids that are solved after the coarse grid. done: solutions of this
    goal so far, from the coarse to the finest grid.
    """

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

    ``background``: solve in separate processes and return the best solution so far. ``finer``: step
    ratios of the grids after the coarse one.
    """

    def __init__(self, *, background: bool = False, finer: tuple[float, ...] = FINER) -> None:
        self._finer = finer
        self._kept: OrderedDict[str, SolvedGoal] = OrderedDict()
        self._solving: _Worker | None = None
        self._refining: _Worker | None = None
        if background:
            self._solving = _Worker("goal solver", self._take_coarse, SOLVING_NICENESS)
            if finer:
                self._refining = _Worker("goal refiner", self._take, REFINING_NICENESS)

    def goal(self, space: FixedStrikeSpace, settings: PlannerSettings, goal: Array) -> SolvedGoal:
        """Return the solved goal. Without background processes a new goal takes seconds."""
        turn = 0.0 if space.is_round else float(goal[2])
        place = np.array([goal[0], goal[1], turn])
        key = f"{space.key()};{settings.key()};{np.round(place, 6).tolist()}"
        if key not in self._kept:
            made = self._kept[key] = SolvedGoal()
            if self._solving is not None:
                self._solving.ask(Job(key, space, settings, place, ()))
            else:
                solution = solve_coarse(space, settings, place)
                for step in self._finer:
                    solution = solve_finer(space, settings, solution, step)
                made.take(solution)
            while len(self._kept) > KEPT_SOLUTIONS:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    def _take_coarse(self, job: Job, result: Solution | Exception) -> None:
        self._take(job, result)
        if self._refining is not None and isinstance(result, Solution):
            self._refining.ask(replace(job, finer=self._finer, done=[result]))

    def _take(self, job: Job, result: Solution | Exception) -> None:
        kept = self._kept.get(job.key)
        if kept is not None:
            kept.take(result)


class _Worker:
    """A process that solves goals. It starts immediately and ends with the process that created it.

    ``take`` is called in a thread for each solution, with the job and this solution. If solving
    fails, it is called with the job and the error.
    """

    def __init__(
        self, name: str, take: Callable[[Job, Solution | Exception], None], niceness: int
    ) -> None:
        self._take = take
        self._asked: dict[str, Job] = {}
        self._unsent: SimpleQueue[Job] = SimpleQueue()
        context = multiprocessing.get_context("spawn")
        self._line, far = context.Pipe()
        process = context.Process(target=_work, args=(far, niceness), name=name, daemon=True)
        process.start()
        far.close()
        Thread(target=self._send, name=f"{name}: requests", daemon=True).start()
        Thread(target=self._receive, name=f"{name}: solutions", daemon=True).start()

    def ask(self, job: Job) -> None:
        """Request the solutions of a goal; this goal is solved before the goals requested
        earlier."""
        self._asked[job.key] = job
        # A job is larger than the pipe's buffer, so sending blocks while the process is busy. The
        # thread of ``_send`` therefore sends it.
        self._unsent.put(job)

    def _send(self) -> None:
        while True:
            job = self._unsent.get()
            try:
                self._line.send(job)
            except OSError:
                self._take(job, _solver_ended())

    def _receive(self) -> None:
        while True:
            try:
                key, result, ended = self._line.recv()
            except (EOFError, OSError):
                for job in list(self._asked.values()):
                    self._take(job, _solver_ended())
                return
            asked = self._asked.pop(key, None) if ended else self._asked.get(key)
            if asked is not None:  # otherwise the goal was requested twice and is solved already
                self._take(asked, result)


def _solver_ended() -> PlanningError:
    return PlanningError(
        "the process that computes the plans for goals has ended; start the planner again"
    )


def _work(line: Connection, niceness: int) -> None:
    """Solve the requested goals until the connection is closed.

    Goals on a coarser grid come first; among goals on the same grid, the latest request comes
    first.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(niceness)
    jobs: list[Job] = []
    with suppress(EOFError, OSError):
        while True:
            while not jobs or line.poll():
                jobs.append(line.recv())
            job = max(jobs, key=lambda job: (-len(job.done), jobs.index(job)))
            try:
                result: Solution | Exception = job.next_solution(line.poll)
            except Abandoned:
                continue
            # sent to the requesting process, because this process has no caller
            except Exception as error:
                result = error
            ended = job.is_done or isinstance(result, Exception)
            if ended:
                jobs.remove(job)
            line.send((job.key, result, ended))
