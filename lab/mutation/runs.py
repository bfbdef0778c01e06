"""Runs the tests against mutants: a plugin of pytest that forks a process for each mutant.

The tests are imported once. A first process runs them all and records which lines of the product
each test executes. A mutant then needs only the tests that execute its statement, those first that
have found most mutants so far, until one fails. If none fails, a campaign in virtual time follows.
"""

from __future__ import annotations

import ast
import inspect
import os
import pickle
import resource
import signal
import sys
import threading
import time
from bisect import bisect
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from hypothesis import Phase, settings

import tapping_cell
from lab.mutation.mutants import CannotPlant, Mutant, Source

TIME_FACTOR, LEAST_TIME_S = 4.0, 10.0
"""Limit of a mutant's processor time: multiple of the time of its tests, and a minimum."""
A_GOAL_S = 3.0
"""Processor time that a campaign may take for each goal."""
MEMORY_B = 4 << 30
"""Limit of a mutant's address space."""
TESTS_S = 30.0
"""Processor time of the tests that a mutant meets, s: first those that are short and have found
most mutants."""
PATIENCE = 20
"""Multiple of the limit of the processor time after which a mutant that waits for ever is ended."""
ROOMS = tuple(str(Path(tapping_cell.__path__[0]) / room) for room in ("logic", "hardware"))
"""Folders of the product whose executed lines are recorded."""

Place = tuple[str, int]
"""File and line."""
Campaign = Callable[[], str]
"""Runs goals in virtual time; returns the first violation, or ""."""


@dataclass(frozen=True, slots=True)
class Result:
    """What became of a mutant."""

    mutant: Mutant
    test: str
    """Test that failed, or what ended the process; "" if all tests passed."""
    violation: str
    """Violation that the campaign found; "" if it found none or was not run."""
    seconds: float
    """Processor time."""


@dataclass(slots=True)
class Covered:
    """What each test needs with the unchanged code: executed places, and processor time in s."""

    places: list[set[Place]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


class Runner:
    """Plugin of pytest that runs mutants on ``jobs`` processes, and calls ``found`` with each
    result. ``campaign_s``: limit of the campaign's processor time, s."""

    def __init__(
        self,
        mutants: Iterable[tuple[Source, Mutant]],
        jobs: int,
        found: Callable[[Result], None],
        campaign: Campaign | None,
        campaign_s: float,
    ) -> None:
        self._mutants, self._jobs, self._found = mutants, jobs, found
        self._campaign, self._campaign_s = campaign, campaign_s
        self._failed = False
        self._running: dict[int, tuple[Mutant, int]] = {}
        self._kills: Counter[int] = Counter()
        """Number of mutants that each test has found."""
        self._tracer = _Tracer()
        self._begun: dict[Path, set[Place]] = defaultdict(set)
        """Places that the set-ups of the tests of a file execute. Its first test may compute what
        the others use, so they count for all."""

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection(self) -> None:
        """Make hypothesis repeatable and quick: a failure is neither stored nor simplified."""
        phases = (Phase.explicit, Phase.generate)
        quick = settings(settings.default, derandomize=True, database=None, phases=phases)
        settings.register_profile("mutation", quick)
        settings.load_profile("mutation")

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_call(self, item: pytest.Item) -> None:
        """Note what the set-up of a test has executed."""
        self._begun[item.path] |= self._tracer.places

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note a failure."""
        self._failed = self._failed or report.failed

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run the mutants in place of the tests."""
        if session.testsfailed:
            raise session.Interrupted("the tests cannot be imported")
        items = session.items
        covered = _receive(*_fork(lambda: self._measure(items)))
        if not isinstance(covered, Covered):
            raise session.Interrupted(f"without a mutant, {covered or 'the tests end the process'}")
        uses = _uses(covered)
        texts = [inspect.getsource(getattr(item, "obj", type(item))) for item in items]
        for source, mutant in self._mutants:
            tests = _tests_of(source, mutant, covered, uses)
            if isinstance(mutant.place, ast.Assign):
                tests = sorted({*tests, *_naming(mutant.name.split(":")[1], texts)})
            tests.sort(key=lambda test: covered.seconds[test] / (1 + self._kills[test]))
            spent = list(accumulate(covered.seconds[test] for test in tests))
            del tests[bisect(spent, TESTS_S) + 1 :]
            while len(self._running) >= self._jobs:
                self._end_one(items)
            limit = LEAST_TIME_S + TIME_FACTOR * sum(covered.seconds[test] for test in tests)
            limit += self._campaign_s
            pid, pipe = _fork(lambda: self._try(source, mutant, items, tests), limit)  # noqa: B023
            self._running[pid] = mutant, pipe
        while self._running:
            self._end_one(items)
        return True

    def _end_one(self, items: list[pytest.Item]) -> None:
        """Wait until one process ends, and report its result."""
        pid, _, used = os.wait3(0)
        mutant, pipe = self._running.pop(pid)
        with os.fdopen(pipe, "rb") as stream:
            written = stream.read()
        test, violation = pickle.loads(written) if written else ("the process ended", "")
        if isinstance(test, int):
            self._kills[test] += 1
            test = items[test].nodeid
        self._found(Result(mutant, test, violation, used.ru_utime + used.ru_stime))

    def _try(
        self, source: Source, mutant: Mutant, items: list[pytest.Item], tests: list[int]
    ) -> tuple[int | str, str]:
        """Return the number of the first test that fails, or the violation in the campaign."""
        try:
            source.plant(mutant)
        except CannotPlant as error:
            return f"{error}", ""
        for test, following in zip(tests, [*tests[1:], None], strict=True):
            self._run(items[test], None if following is None else items[following])
            if self._failed:
                return test, ""
        return "", self._campaign() if self._campaign else ""

    def _run(self, item: pytest.Item, following: pytest.Item | None) -> None:
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)

    def _measure(self, items: list[pytest.Item]) -> Covered | str:
        """Run all tests, and return what they need, or the test that fails."""
        covered = Covered()
        known: dict[Place, Place] = {}  # each place once, which keeps the result small
        for item, following in zip(items, [*items[1:], None], strict=True):
            self._tracer.places = set()
            start = time.process_time()
            with self._tracer:
                self._run(item, following)
            covered.seconds.append(time.process_time() - start)
            covered.places.append({known.setdefault(each, each) for each in self._tracer.places})
            if self._failed:
                return f"{item.nodeid} fails"
        for item, places in zip(items, covered.places, strict=True):
            places |= {known.setdefault(each, each) for each in self._begun[item.path]}
        return covered


class _Tracer:
    """Records the places that are executed in the folders ``ROOMS``, in every thread."""

    def __init__(self) -> None:
        self.places: set[Place] = set()

    def __enter__(self) -> None:
        threading.settrace(self._call)
        sys.settrace(self._call)

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)
        threading.settrace(None)  # type: ignore[arg-type]

    def _call(self, frame: FrameType, event: str, _: Any) -> Any:
        return self._line if frame.f_code.co_filename.startswith(ROOMS) else None

    def _line(self, frame: FrameType, event: str, _: Any) -> Any:
        self.places.add((frame.f_code.co_filename, frame.f_lineno))
        return self._line


def _tests_of(
    source: Source, mutant: Mutant, covered: Covered, uses: dict[str, set[Place]]
) -> list[int]:
    """Return the numbers of the tests that execute the changed statement, or a statement that uses
    the changed constant."""
    wanted = {(source.file, line) for line in mutant.lines}
    if isinstance(mutant.place, ast.Assign):
        wanted = uses[mutant.name.split(":")[1]]
    return [test for test, places in enumerate(covered.places) if not wanted.isdisjoint(places)]


def _naming(constant: str, texts: list[str]) -> list[int]:
    """Return the numbers of the tests whose source names a constant."""
    return [number for number, text in enumerate(texts) if constant in text]


def _uses(covered: Covered) -> dict[str, set[Place]]:
    """Return the places at which each name in capitals is used."""
    found: dict[str, set[Place]] = defaultdict(set)
    for file in {file for places in covered.places for file, _ in places}:
        for node in ast.walk(ast.parse(Path(file).read_text(encoding="utf-8"))):
            name = getattr(node, "id", getattr(node, "attr", ""))
            if isinstance(name, str) and name.isupper():
                found[name].add((file, getattr(node, "lineno", 0)))
    return found


def _fork(work: Callable[[], object], limit: float | None = None) -> tuple[int, int]:
    """Do some work in a process of its own that prints nothing; return the process and the pipe
    for its result. ``limit``: of the processor time, s."""
    reading, writing = os.pipe()
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        os.close(writing)
        return pid, reading
    code = 1
    try:
        nowhere = os.open(os.devnull, os.O_RDWR)
        for number in (0, 1, 2):
            os.dup2(nowhere, number)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_B, MEMORY_B))
        if limit is not None:
            whole = int(limit) + 1
            resource.setrlimit(resource.RLIMIT_CPU, (whole, whole))
            signal.alarm(PATIENCE * whole)
        result = pickle.dumps(work())
        with os.fdopen(writing, "wb") as stream:
            stream.write(result)
        code = 0
    finally:
        os._exit(code)


def _receive(pid: int, pipe: int) -> object:
    """Return the result of a process, or None if it ended without one."""
    with os.fdopen(pipe, "rb") as stream:
        written = stream.read()
    os.waitpid(pid, 0)
    return pickle.loads(written) if written else None
