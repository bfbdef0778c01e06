"""Lines of text received from a controller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

LONGEST_LINE = 512
"""Number of bytes without an end of line after which the input is treated as noise."""

Frame = TypeVar("Frame")


@dataclass(frozen=True, slots=True)
class Bad:
    """A line that is noise or has an unknown format."""

    line: bytes
    why: str


@dataclass(frozen=True, slots=True)
class Decoded(Generic[Frame]):
    """A decoded frame (None if more bytes are needed), and the bytes not decoded yet."""

    frame: Frame | Bad | None
    rest: bytes


def decode_first_line(buffer: bytes, decode_line: Callable[[bytes], Frame]) -> Decoded[Frame]:
    """Decode the first line of ``buffer``. Empty lines are skipped, and ``decode_line`` receives
    the line without its line ending."""
    while True:
        end = buffer.find(b"\n")
        if end < 0:
            if len(buffer) > LONGEST_LINE:
                return Decoded(Bad(buffer[:32], f"{len(buffer)} bytes without an end of line"), b"")
            return Decoded(None, buffer)
        line, buffer = buffer[:end].strip(b"\r "), buffer[end + 1 :]
        if line:
            return Decoded(decode_line(line), buffer)
