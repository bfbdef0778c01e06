"""One thread that makes a driver's blocking calls, so that the node's executor never waits."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

Job = Callable[[], None]


class Worker:
    """Runs jobs one after the other and, while there are none, ``idle`` every ``period`` seconds.

    A job or ``idle`` that raises ends the thread; ``error`` then holds what it raised, and the node
    must look at it: a failure that is to be expected is caught in the job itself.
    """

    def __init__(self, name: str, idle: Job, period: float) -> None:
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
        """Queue a job; from any thread."""
        self._jobs.put(job)

    def close(self, patience: float = 3.0) -> None:
        """End the thread after the job under way."""
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
