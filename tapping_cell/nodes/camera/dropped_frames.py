"""Selection of the queued images to process when images arrive faster than they are processed."""

from __future__ import annotations

LONGEST_WAIT_S = 0.15
"""An image that waited longer than this time is dropped if a newer image is queued, so that the
node catches up immediately after a long delay. After shorter delays, every queued image is
processed, so that the track has no gaps. If images always arrive faster than they can be processed,
``SHORTEST_WAIT_S`` applies instead."""
SHORTEST_WAIT_S = 0.005
_SHARE = 0.2
"""Weight of the newest sample in the moving averages of arrival interval and processing time."""
_FULL = 0.9
"""Ratio of processing time to arrival interval above which the node cannot catch up."""


class Backlog:
    """Compare the arrival rate of images with their processing rate. All times are in s; the
    arrival interval and the processing time are moving averages."""

    def __init__(self) -> None:
        self.passed_over = 0
        self._arrived: float | None = None
        self._processed: float | None = None
        self._interval: float | None = None
        self._processing: float | None = None

    def arrived(self, when: float) -> None:
        """Record the arrival time ``when`` (s) of the image just taken from the queue."""
        if self._arrived is not None:
            self._interval = _mean(self._interval, when - self._arrived)
        self._arrived = when

    def processed(self, now: float) -> None:
        """Record that the last image has been processed."""
        last, arrived = self._processed, self._arrived
        # The processing time is known only if this image was already queued when the previous
        # image was finished, because its processing then began immediately.
        if last is not None and arrived is not None and arrived < last:
            self._processing = _mean(self._processing, now - last)
        self._processed = now

    def stale(self, now: float) -> bool:
        """Return whether the last image waited so long that a newer queued image should be
        processed instead."""
        assert self._arrived is not None
        waited = now - self._arrived
        return waited > LONGEST_WAIT_S or (waited > SHORTEST_WAIT_S and self.overrun)

    @property
    def overrun(self) -> bool:
        """Whether images arrive faster than they are processed."""
        if self._processing is None or self._interval is None:
            return False
        return self._processing > _FULL * self._interval

    @property
    def sentence(self) -> str:
        """Warning for diagnostics; empty if there is no overrun."""
        if not self.overrun:
            return ""
        assert self._processing is not None and self._interval is not None
        return (
            f"an image takes {1e3 * self._processing:.0f} ms to process, but images arrive every "
            f"{1e3 * self._interval:.0f} ms: only the newest is processed; lower the camera's "
            "rate or the load of the machine"
        )


def _mean(known: float | None, newest: float) -> float:
    return newest if known is None else known + _SHARE * (newest - known)
