"""Processes that execute the runs of a campaign in parallel and end at Ctrl-C."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager


@contextmanager
def worker_processes(
    count: int, begin: Callable[[int], None] = lambda number: None
) -> Iterator[Executor]:
    """Provide ``count`` processes. ``begin`` is called at the beginning of each process, with the
    number of the process.

    If the block is left by an exception such as KeyboardInterrupt, the processes are ended at once
    and all runs that have not ended are lost.
    """
    started = multiprocessing.Value("i", 0)

    def prepare() -> None:
        # Ctrl-C is sent to every process of the terminal. Only the main process handles it.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        with started.get_lock():
            number = started.value
            started.value += 1
        begin(number)

    others = set(multiprocessing.active_children())
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(count, mp_context=context, initializer=prepare) as pool:
        try:
            yield pool
        except BaseException:
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
