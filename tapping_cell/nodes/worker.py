"""Thread for a driver's blocking calls, so that the node's executor never waits."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

Job = Callable[[], None]


class Worker:
    """Run jobs one after another. While no job is queued, call ``idle`` every ``period`` seconds,
    or never if ``period`` is None.

    An exception from a job or from ``idle`` ends the thread and is stored in ``error``, which the
    node must check. A job must catch the failures that it expects.
    """

    def __init__(self, name: str, idle: Job = lambda: None, period: float | None = None) -> None:
        self._idle = idle
        self._period = period
        self._jobs: queue.Queue[Job] = queue.Queue()
        self._ending = threading.Event()
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def submit(self, job: Job) -> None:
        """Queue a job, from any thread."""
        self._jobs.put(job)

    def close(self, patience: float = 3.0) -> None:
        """Stop the thread after the current job."""
        self._ending.set()
        self._jobs.put(lambda: None)
        if self._thread.is_alive():
            self._thread.join(patience)

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                try:
                    job = self._jobs.get(timeout=self._period)
                except queue.Empty:
                    job = self._idle
                job()
        except BaseException as error:
            self.error = error
            raise
