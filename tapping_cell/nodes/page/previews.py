"""Answers to drags of the goal's preview, computed in a thread of their own.

Of each page only its newest request is kept: what a dragging hand asked before is worth nothing.
Pages are served in turn, so that one that asks often does not keep the others waiting.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Asked = TypeVar("Asked")

_logger = logging.getLogger(__name__)


class Previews(Generic[Asked]):
    """Serves the newest request of each page."""

    def __init__(self, serve: Callable[[Asked], None]) -> None:
        self._serve = serve
        self._waiting: dict[object, Asked] = {}
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="goal previews", daemon=True)
        self._thread.start()

    def ask(self, page: object, asked: Asked) -> None:
        """Serve a page's request, unless a newer one of the same page comes first."""
        with self._changed:
            self._waiting[page] = asked  # a page that waits already keeps its turn
            self._changed.notify()

    def close(self) -> None:
        """End the thread after what it serves now."""
        with self._changed:
            self._closing = True
            self._waiting.clear()
            self._changed.notify()
        self._thread.join(2.0)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                if self._closing:
                    return
                page = next(iter(self._waiting))
                asked = self._waiting.pop(page)
            try:
                self._serve(asked)
            except Exception:
                # A defect in one preview must not end all others.
                _logger.exception("a goal's preview failed")
