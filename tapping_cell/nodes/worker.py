"""One thread that makes a driver's blocking calls, so that the node's executor never waits."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

Job = Callable[[], None]


class Worker:
    """Runs jobs one after the other. A job raises nothing."""

    def __init__(self, name: str) -> None:
        self._jobs: queue.Queue[Job] = queue.Queue()
        self._ending = threading.Event()
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
        while not self._ending.is_set():
            self._jobs.get()()
