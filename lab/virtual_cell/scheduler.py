"""Discrete-event scheduler in virtual time. The scheduler uses threads, but only one of them runs
at a time.

Drivers make blocking calls, so each driver runs in its own thread, a *fiber*. When a fiber waits,
its thread processes the following events itself until one of them resumes another fiber. Threads
are therefore switched only from one fiber to another, because a switch is slow while other
processes use the core. Nothing runs concurrently, so the order of events depends only on the seed.
"""

from __future__ import annotations

import heapq
import math
import threading
from collections.abc import Callable
from itertools import count

Action = Callable[[], None]

MAX_EVENTS_AT_ONCE = 100_000
"""Maximum number of events at the same virtual time. A run with more events counts as hanging."""


class HangError(Exception):
    """Virtual time no longer advances."""


class Killed(BaseException):
    """Raised in a waiting fiber when its process is killed.

    The class is not derived from ``Exception``, so that no driver handles it as a fault of a
    device.
    """


class Timer:
    """An event that is due at ``time`` (s) and can be cancelled."""

    __slots__ = ("action", "fiber", "in_main", "time")

    def __init__(self, time: float, action: Action, in_main: bool, fiber: Fiber | None) -> None:
        self.time = time
        self.action: Action | None = action
        self.in_main = in_main
        self.fiber = fiber
        """Fiber that continues after the action."""

    def cancel(self) -> None:
        """Cancel the event."""
        self.action = None


class Scheduler:
    """Event queue of one run. Times are in s from the start of the run."""

    def __init__(self) -> None:
        self.now = 0.0
        self.after_event: Action = lambda: None
        """Called after every event, to check the invariants."""
        self._queue: list[tuple[float, int, Timer]] = []
        self._numbers = count()
        self._at_once = 0
        self._until = 0.0
        self._done: Callable[[], bool] = lambda: False
        self._finished = False
        self._main = threading.get_ident()
        self._baton = threading.Lock()
        self._baton.acquire()
        self._failure: BaseException | None = None

    def at(
        self, time: float, action: Action, in_main: bool = False, fiber: Fiber | None = None
    ) -> Timer:
        """Schedule ``action`` at ``time``, or immediately if that time has passed.

        ``in_main``: run the action outside all fibers. This is necessary if the action kills a
        fiber.
        ``fiber``: the fiber that continues after the action.
        """
        timer = Timer(max(time, self.now), action, in_main, fiber)
        heapq.heappush(self._queue, (timer.time, next(self._numbers), timer))
        return timer

    def after(self, delay: float, action: Action, in_main: bool = False) -> Timer:
        """Schedule ``action`` in ``delay`` s."""
        return self.at(self.now + delay, action, in_main)

    def run(self, until: float, done: Callable[[], bool] = lambda: False) -> None:
        """Process events up to the time ``until``, or until ``done()`` is true after an event.

        Raises:
            HangError: too many events occurred at the same time.
        """
        self._until, self._done, self._finished = until, done, False
        while not self._finished:
            fiber = self._process(in_main=True)
            if fiber is not None:
                fiber.baton.release()
                self._baton.acquire()
            self._raise_failure()
        if not done() and math.isfinite(until):
            self.now = max(self.now, until)

    def _process(self, in_main: bool) -> Fiber | None:
        """Process events until one of them resumes a fiber, and return this fiber. Return None if
        the main thread continues.

        ``in_main``: whether this is the main thread.
        """
        queue, done = self._queue, self._done
        try:
            while queue and queue[0][0] <= self._until and not done():
                time, _, timer = queue[0]
                action = timer.action
                if timer.in_main and not in_main and action is not None:
                    return None
                heapq.heappop(queue)
                if action is None:
                    continue
                self._at_once = self._at_once + 1 if time <= self.now else 0
                if self._at_once > MAX_EVENTS_AT_ONCE:
                    raise HangError(f"{self._at_once} events at {self.now:.3f} s")
                self.now = time
                action()
                if timer.fiber is not None and not timer.fiber.ended:
                    return timer.fiber
                self.after_event()
        except BaseException as failure:
            self._failure = failure
        else:
            self._finished = True
        return None

    def _raise_failure(self) -> None:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    # Fibers

    def pass_on(self, fiber: Fiber, failure: BaseException | None = None) -> None:
        """End the event that resumed ``fiber``, and process further events until one resumes
        ``fiber`` again.

        If the fiber has ended, return as soon as another thread has taken over. ``failure``: the
        exception that ended the fiber.
        """
        heir = None
        try:
            if failure is not None:
                raise failure
            self.after_event()
        except BaseException as error:
            self._failure = error
        else:
            heir = self._process(in_main=False)
        if heir is fiber:
            return
        (self._baton if heir is None else heir.baton).release()
        if not fiber.ended:
            fiber.baton.acquire()

    def end(self, fiber: Fiber) -> None:
        """Let a killed fiber run until it has ended. If an exception ended the fiber, raise this
        exception again."""
        if threading.get_ident() != self._main:
            raise RuntimeError("only an event in the main thread may end a fiber")
        fiber.baton.release()
        self._baton.acquire()
        self._raise_failure()

    def ended(self, failure: BaseException | None) -> None:
        """Return control to the main thread while the main thread waits in ``end`` for a killed
        fiber. The fiber calls this method when it has ended."""
        self._failure = failure
        self._baton.release()


class Fiber:
    """A thread that executes ``body``, but only while the scheduler waits for it."""

    def __init__(self, scheduler: Scheduler, name: str, body: Action) -> None:
        self.baton = threading.Lock()
        self.baton.acquire()
        self.ended = False
        self.frozen_until = 0.0
        """Time before which the fiber does not continue, regardless of its wait condition."""
        self._scheduler = scheduler
        self._body = body
        self._killed = False
        self._wake: Timer | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def start(self) -> None:
        """Schedule the start of the fiber as a separate event."""
        self.wake()

    def wait_until(self, time: float) -> None:
        """Wait, inside the fiber, until virtual time reaches ``time`` or :meth:`wake` is called.

        Raises:
            Killed: the process was killed while waiting.
        """
        self._wake = None
        if math.isfinite(time):
            self._continue_at(max(time, self.frozen_until))
        if not self._killed:
            self._scheduler.pass_on(self)
        if self._killed:
            raise Killed

    def wake(self) -> None:
        """Continue the fiber now, or when it is no longer frozen, regardless of its wait
        condition."""
        if self._wake is not None:
            self._wake.cancel()
        self._continue_at(self.frozen_until)

    def freeze(self, until: float) -> None:
        """Freeze the fiber's process: the fiber does not continue before ``until``."""
        self.frozen_until = max(self.frozen_until, until)
        if self._wake is not None and self._wake.time < self.frozen_until:
            self.wake()

    def kill(self) -> None:
        """End the waiting fiber; call this method in the main thread, outside all fibers."""
        if self.ended or self._killed:
            return
        self._killed = True
        if self._wake is not None:
            self._wake.cancel()
        self._scheduler.end(self)

    def _continue_at(self, time: float) -> None:
        self._wake = self._scheduler.at(time, self._woken, fiber=self)

    def _woken(self) -> None:
        self._wake = None

    def _run(self) -> None:
        self.baton.acquire()
        failure: BaseException | None = None
        try:
            if not self._killed:
                self._body()
        except Killed:
            pass
        except BaseException as error:
            failure = error
        self.ended = True
        if self._killed:
            self._scheduler.ended(failure)
        else:
            self._scheduler.pass_on(self, failure)
