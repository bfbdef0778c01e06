"""A board whose serial line runs at another baud rate than the host's."""

from __future__ import annotations

from tapping_cell.simulation.device_emulator import DeviceEmulator


def sampled(data: bytes, sent: float, read: float) -> bytes:
    """Return the bytes that a receiver at ``read`` baud decodes from ``data`` sent at ``sent``
    baud, 8N1.

    The receiver waits for a falling edge and samples the middle of each bit in its own period. The
    receiver forwards bytes with a wrong stop bit, as Linux does by default.
    """
    levels = [
        level
        for byte in data
        for level in (0, *(byte >> bit & 1 for bit in range(8)), 1)  # start, data, stop
    ]

    def level(time: float) -> int:
        index = int(time * sent)
        return levels[index] if index < len(levels) else 1

    received = bytearray()
    time, end = 0.0, len(levels) / sent
    while time < end:
        if level(time):
            time = (int(time * sent) + 1) / sent + 1e-12
            continue
        bits = [level(time + (1.5 + bit) / read) for bit in range(8)]
        received.append(sum(bit << place for place, bit in enumerate(bits)))
        time += 9.5 / read
        while time < end and not level(time):
            time = (int(time * sent) + 1) / sent + 1e-12
    return bytes(received)


class WrongBaud:
    """An emulated board that runs at ``board`` baud, connected to a host that runs at ``host``
    baud."""

    def __init__(self, emulator: DeviceEmulator, host: float, board: float) -> None:
        self._emulator = emulator
        self._host, self._board = host, board

    def receive(self, data: bytes, now: float) -> None:
        """Forward the host's bytes as the board decodes them."""
        self._emulator.receive(sampled(data, self._host, self._board), now)

    def advance(self, now: float) -> None:
        """Advance the board."""
        self._emulator.advance(now)

    def take_output(self, now: float) -> bytes:
        """Return the board's bytes as the host decodes them."""
        return sampled(self._emulator.take_output(now), self._board, self._host)

    def next_event(self) -> float | None:
        """Return the time of the board's next event."""
        return self._emulator.next_event()

    def power_cycle(self, now: float) -> None:
        """Restart the board."""
        self._emulator.power_cycle(now)
