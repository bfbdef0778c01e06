"""Check whether received bytes are text. A wrong baud rate or a bad cable causes bytes that are not
text."""

from __future__ import annotations

from dataclasses import dataclass

TEXT = bytes((*b"\t\r\n", *range(0x20, 0x7F)))
NOISE_SHARE = 0.1
"""A line counts as noise if more than this fraction of its bytes is not text. Controllers send only
text. At a wrong baud rate, more than a third of the bytes are not text."""


@dataclass(slots=True)
class ReceivedBytes:
    """Counts of received bytes and of those that cannot be part of a text."""

    total: int = 0
    strange: int = 0

    def take(self, data: bytes) -> None:
        """Count received bytes."""
        self.total += len(data)
        self.strange += len(data.translate(None, TEXT))

    @property
    def are_noise(self) -> bool:
        """Whether the share of bytes that are not text is so large that the baud rate or the cable
        must be wrong."""
        return self.strange > NOISE_SHARE * self.total
