"""Responses to drags of the goal preview, computed in a separate thread.

Only the newest request of each page is kept, because a drag makes earlier requests obsolete. Pages
are served in turn, so that a page with many requests does not delay the others.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Asked = TypeVar("Asked")

_logger = logging.getLogger(__name__)


class Previews(Generic[Asked]):
    """Process the newest request of each page."""

    def __init__(self, serve: Callable[[Asked], None]) -> None:
        self._serve = serve
        self._waiting: dict[object, Asked] = {}
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="goal previews", daemon=True)
        self._thread.start()

    def ask(self, page: object, asked: Asked) -> None:
        """Queue a page's request. A newer request of the same page replaces it."""
        with self._changed:
            self._waiting[page] = asked  # a page that is already waiting keeps its position
            self._changed.notify()

    def close(self) -> None:
        """End the thread after its current request."""
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
                # A defect in one preview must not end the thread.
                _logger.exception("a goal's preview failed")
