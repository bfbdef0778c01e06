"""Discrete-event scheduler in virtual time, with threads of which only one runs at a time.

Drivers block, so each driver runs in its own thread, a *fiber*. A fiber runs only while the
scheduler waits for it, and returns control whenever it waits. Because nothing runs concurrently,
the order of events depends only on the seed.
"""

from __future__ import annotations

import heapq
import math
import threading
from collections.abc import Callable
from itertools import count

Action = Callable[[], None]

MOST_EVENTS_AT_ONCE = 100_000
"""Maximum number of events at the same virtual time; with more, the run counts as hanging."""


class HangError(Exception):
    """Virtual time no longer advances."""


class Killed(BaseException):
    """Raised in a waiting fiber when its process is killed.

    It is not an ``Exception``, so that no driver handles it as a fault of a device.
    """


class Timer:
    """An event that is due at ``time`` (s) and can be cancelled."""

    __slots__ = ("action", "time")

    def __init__(self, time: float, action: Action) -> None:
        self.time = time
        self.action: Action | None = action

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
        self._baton = threading.Lock()
        self._baton.acquire()
        self._failure: BaseException | None = None

    def at(self, time: float, action: Action) -> Timer:
        """Schedule ``action`` at ``time``, or immediately if that time has passed."""
        timer = Timer(max(time, self.now), action)
        heapq.heappush(self._queue, (timer.time, next(self._numbers), timer))
        return timer

    def after(self, delay: float, action: Action) -> Timer:
        """Schedule ``action`` in ``delay`` s."""
        return self.at(self.now + delay, action)

    def run(self, until: float, done: Callable[[], bool] = lambda: False) -> None:
        """Process events up to the time ``until``, or until ``done()`` is true after an event.

        Raises:
            HangError: too many events occurred at the same time.
        """
        while self._queue and self._queue[0][0] <= until and not done():
            time, _, timer = heapq.heappop(self._queue)
            action = timer.action
            if action is None:
                continue
            self._at_once = self._at_once + 1 if time <= self.now else 0
            if self._at_once > MOST_EVENTS_AT_ONCE:
                raise HangError(f"{self._at_once} events at {self.now:.3f} s")
            self.now = time
            action()
            self.after_event()
        if not done() and math.isfinite(until):
            self.now = max(self.now, until)

    # Fibers

    def switch_to(self, fiber: Fiber) -> None:
        """Run a fiber until it waits or ends; re-raise its exception, if any."""
        fiber.baton.release()
        self._baton.acquire()
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def switch_back(self, failure: BaseException | None = None) -> None:
        """Return control from a fiber to the event that started it."""
        self._failure = failure
        self._baton.release()


class Fiber:
    """A thread that executes ``body``, but only while the scheduler waits for it."""

    def __init__(self, scheduler: Scheduler, name: str, body: Action) -> None:
        self.baton = threading.Lock()
        self.baton.acquire()
        self.ended = False
        self.frozen_until = 0.0
        """Time before which the fiber does not continue, whatever it waits for."""
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
            self._wake = self._scheduler.at(max(time, self.frozen_until), self._resume)
        self._scheduler.switch_back()
        self.baton.acquire()
        if self._killed:
            raise Killed

    def wake(self) -> None:
        """Continue the fiber now, or when it is no longer frozen, whatever it waits for."""
        if self._wake is not None:
            self._wake.cancel()
        self._wake = self._scheduler.at(self.frozen_until, self._resume)

    def freeze(self, until: float) -> None:
        """Freeze the fiber's process: the fiber does not continue before ``until``."""
        self.frozen_until = max(self.frozen_until, until)
        if self._wake is not None and self._wake.time < self.frozen_until:
            self.wake()

    def kill(self) -> None:
        """End the waiting fiber."""
        if self.ended or self._killed:
            return
        self._killed = True
        if self._wake is not None:
            self._wake.cancel()
        self._scheduler.switch_to(self)

    def _resume(self) -> None:
        self._wake = None
        if not self.ended:
            self._scheduler.switch_to(self)

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
        self._scheduler.switch_back(failure)
