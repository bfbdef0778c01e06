"""Progress of a long command: a bar in a terminal, otherwise a line every few seconds."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import Protocol

from rich.console import Console
from rich.progress import Progress, TextColumn, TimeElapsedColumn

PERIOD_S = 10.0
"""Time between two lines of progress in a log file or pipe."""


class Advance(Protocol):
    """Function that advances the progress by ``count``. ``note``: text on the last step."""

    def __call__(self, count: int = 1, note: str = "") -> None:
        """Advance."""


@contextlib.contextmanager
def progress(
    name: str, total: int, *, completed: int = 0, console: Console | None = None
) -> Iterator[Advance]:
    """Show the progress of ``total`` steps, of which some may be ``completed``, on ``console``
    (default: stderr). Yield a function that advances it."""
    console = Console(stderr=True) if console is None else console
    if console.is_terminal and not console.quiet:
        columns = (*Progress.get_default_columns(), TimeElapsedColumn())
        last = TextColumn("{task.fields[note]}")
        with Progress(*columns, last, console=console, transient=True) as shown:
            task = shown.add_task(name, total=total, completed=completed, note="")
            yield lambda count=1, note="": shown.update(task, advance=count, note=note)
        return
    began = printed = time.monotonic()
    done = completed

    def advance(count: int = 1, note: str = "") -> None:
        nonlocal done, printed
        done, now = done + count, time.monotonic()
        if now >= printed + PERIOD_S:
            printed = now
            last = f", {note}" if note else ""
            console.print(
                f"{name}: {done} of {total} after {now - began:.0f} s{last}",
                highlight=False,
                markup=False,
                soft_wrap=True,
            )

    yield advance
