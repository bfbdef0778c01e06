"""Driver that combines all tapper boards of a cell into one device, so that at most one striker is
charged at a time.

All boards belong to one driver and one thread. A board is charged and fired only after every other
board has replied that it is at rest with its strikers at their mounts. This needs no messages
between processes, so a late message cannot make two boards fire at once.

Channels are numbered across the boards: :func:`cell_channel` gives the number of a board's channel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.tapper import FireOutcome, FireResult, TapperCounters, TapperDriver
from tapping_cell.hardware.tapper_protocol import Reply, State

CHANNELS_PER_BOARD = 32
"""Difference between the channel numbers of consecutive boards."""
OTHERS_ASKED_S = 0.1
"""Maximum age of the other boards' replies at the last check before FIRE, s."""
PRECEDENCE = (
    State.STOPPED,
    State.CHARGED,
    State.CHARGING,
    State.RELEASING,
    State.DISCHARGING,
    State.HOMING,
    State.UNHOMED,
    State.SAFE,
)
"""States by decreasing precedence. The common state of all boards is the first of these states that
a board is in."""


def cell_channel(board: int, channel: int) -> int:
    """Return the number of a board's channel among the channels of all boards."""
    return CHANNELS_PER_BOARD * board + channel


def numbered(port: str, board: int) -> str:
    """Return the port of board number ``board``, such as ``tapper``, ``tapper_1``. An empty port
    remains empty."""
    return f"{port}_{board}" if port and board else port


class TapperBoards:
    """The boards of a cell. All calls except ``stop`` block and must come from one thread.

    The calls and their faults are those of :class:`~tapping_cell.hardware.tapper.TapperDriver`. A
    fault of one board is raised as a fault of the whole device; its message names the board's port.
    """

    def __init__(self, drivers: Sequence[TapperDriver]) -> None:
        self._drivers = tuple(drivers)
        self._charged = 0
        """Index of the board that was charged last."""

    @property
    def counters(self) -> TapperCounters:
        """Counters of all boards, added up, with the last error of any board."""
        counters = [driver.counters for driver in self._drivers]
        sums = {
            item.name: sum(getattr(one, item.name) for one in counters)
            for item in fields(TapperCounters)
            if item.name != "last_error"
        }
        errors = [one.last_error for one in counters if one.last_error]
        return TapperCounters(**sums, last_error=errors[-1] if errors else "")

    @property
    def last_reply(self) -> Reply | None:
        """Last replies of all boards, merged; None until every board has replied."""
        replies = [driver.last_reply for driver in self._drivers]
        known = [reply for reply in replies if reply is not None]
        return self._merged(known) if len(known) == len(replies) else None

    @property
    def version(self) -> str:
        """Firmware versions, without repetition."""
        return ", ".join(dict.fromkeys(driver.version for driver in self._drivers))

    def connect(self, timeout: float = 5.0) -> Reply:
        """Open a session with every board; this discharges all tappers. If a board fails, all lines
        are closed."""
        try:
            return self._merged([driver.connect(timeout) for driver in self._drivers])
        except HardwareFault as fault:
            if fault.reason is not FaultReason.STOPPED:
                self.close()
            raise

    def close(self) -> None:
        """Close all lines."""
        for driver in self._drivers:
            driver.close()

    def status(self) -> Reply:
        """Query the state of all boards. A board that was charged is queried first."""
        return self._on_each(lambda driver: driver.status())

    def home(self, go_on: Callable[[], bool] = lambda: True) -> Reply:
        """Verify the strikers' positions on every board that has not verified them yet."""

        def verify(driver: TapperDriver) -> Reply:
            reply = driver.status()
            return reply if reply.state is State.SAFE else driver.home(go_on)

        return self._on_each(verify)

    def charge(
        self,
        shot: int,
        energy: float,
        go_on: Callable[[], bool] = lambda: True,
        timeout: float = 5.0,
        channel: int = 0,
    ) -> Reply:
        """Store ``energy`` in J for ``shot`` on a channel of the cell.

        Also raises HardwareFault OTHER_ACTIVE if another board is not at rest.
        """
        board, own = divmod(channel, CHANNELS_PER_BOARD)
        if not 0 <= board < len(self._drivers):
            raise HardwareFault(
                FaultReason.SETTINGS_MISMATCH,
                f"channel {channel} belongs to board {board}, but the cell's boards have the"
                f" numbers 0 to {len(self._drivers) - 1}; correct the channels in the cell file",
            )
        others = self._require_rest(board)
        spent = max((reply.shot for reply in others), default=0)
        if shot <= spent:
            raise HardwareFault(
                FaultReason.SHOT_SPENT,
                f"shot {shot} may already have been fired by another board (greatest shot number"
                f" charged there: {spent}): use a greater number",
            )
        self._charged = board
        self._drivers[board].charge(shot, energy, go_on, timeout, own)
        return self._last()

    def fire(self, shot: int, window: float, still_allowed: Callable[[float], bool]) -> FireResult:
        """Fire the charged ``shot`` once, or not at all.

        Also raises HardwareFault OTHER_ACTIVE if another board is not at rest. The shot is then not
        fired but discharged.
        """
        driver = self._drivers[self._charged]
        asked_at = checked_at = driver.now()
        try:
            self._require_rest(self._charged)
        except HardwareFault:
            driver.discharge()
            raise

        def allowed(by: float) -> bool:
            # If this process was frozen after the queries, the other boards' replies are too old to
            # allow the shot.
            nonlocal checked_at
            checked_at = driver.now()
            return driver.now() - asked_at <= OTHERS_ASKED_S and still_allowed(by)

        result = driver.fire(shot, window, allowed if len(self._drivers) > 1 else still_allowed)
        age = checked_at - asked_at
        if result.outcome is not FireOutcome.NOT_FIRED or result.fault or age <= OTHERS_ASKED_S:
            return result
        late = HardwareFault(
            FaultReason.TIMEOUT,
            f"the replies of the other boards were {age:.3f} s old at the last check before shot"
            f" {shot} (limit {OTHERS_ASKED_S:.3f} s), so it was not fired: this computer or a line"
            " was too slow; reduce the computer's load and check the cables of all boards",
        )
        return replace(result, sentence=late.sentence, fault=late)

    def wait_for_return(self, go_on: Callable[[], bool] = lambda: True) -> Reply:
        """Wait until the released striker is back, and return the state of all boards."""
        self._drivers[self._charged].wait_for_return(go_on)
        return self.status()

    def discharge(self) -> Reply:
        """Discharge every board."""
        return self._on_each(lambda driver: driver.discharge())

    def stop(self) -> bool:
        """Latch the stop of every board, from any thread; return whether it was sent to all
        boards."""
        return all([driver.stop() for driver in self._drivers])

    def clear(self, timeout: float = 5.0) -> Reply:
        """Clear the latched stop of every board."""
        return self._on_each(lambda driver: driver.clear(timeout))

    def _on_each(self, act: Callable[[TapperDriver], Reply]) -> Reply:
        """Call ``act`` for every board, beginning with the board that was charged last. If calls
        fail, the other boards are still called; then the first fault is raised."""
        order = sorted(range(len(self._drivers)), key=lambda board: board != self._charged)
        first: HardwareFault | None = None
        for board in order:
            try:
                act(self._drivers[board])
            except HardwareFault as fault:
                first = first or fault
        if first is not None:
            raise first
        return self._last()

    def _last(self) -> Reply:
        reply = self.last_reply
        assert reply is not None, "every board has replied since it was connected"
        return reply

    def _require_rest(self, board: int) -> list[Reply]:
        """Query all boards except ``board`` and return their replies; raise if one is not at rest.

        Raises HardwareFault: STOPPED, INTERLOCK, STRIKER_AWAY, OTHER_ACTIVE.
        """
        replies = []
        for driver in (one for index, one in enumerate(self._drivers) if index != board):
            reply = driver.status()
            if reply.state is not State.SAFE or reply.stop_latched or not reply.interlock_closed:
                raise _rest_fault(driver, reply)
            replies.append(reply)
        return replies

    def _merged(self, replies: Sequence[Reply]) -> Reply:
        """Return one reply for all boards. The shot's energy and channel are those of the board
        that was charged last; the speed is that of the board that fired last."""
        own = replies[self._charged]
        fired = max(replies, key=lambda reply: reply.last_fired)
        fitted = all(reply.channels > 1 or reply.at_mounts for reply in replies)
        at_mounts = sum(
            reply.at_mounts << cell_channel(board, 0) for board, reply in enumerate(replies)
        )
        return replace(
            own,
            state=min((reply.state for reply in replies), key=PRECEDENCE.index),
            shot=max(reply.shot for reply in replies),
            interlock_closed=all(reply.interlock_closed for reply in replies),
            stop_latched=any(reply.stop_latched for reply in replies),
            last_fired=fired.last_fired,
            speed=fired.speed,
            boot=sum(reply.boot for reply in replies) & 0xFFFFFFFF,
            enabled=any(reply.enabled for reply in replies),
            channel=cell_channel(self._charged, own.channel),
            # If a board has no switches, the strikers of all boards count as not confirmed at their
            # mounts.
            channels=sum(reply.channels for reply in replies) if fitted else 1,
            at_mounts=at_mounts if fitted else 0,
        )


def _rest_fault(driver: TapperDriver, reply: Reply) -> HardwareFault:
    """Return the fault to raise because another board is not at rest."""
    if reply.stop_latched:
        reason, text = (
            FaultReason.STOPPED,
            "its stop is latched; make the cell safe, then clear the fault",
        )
    elif not reply.interlock_closed:
        reason, text = FaultReason.INTERLOCK, "its interlock is open; close the guard"
    elif reply.state is State.UNHOMED:
        reason, text = (
            FaultReason.STRIKER_AWAY,
            "its strikers are not confirmed to be at their mounts; free them and check their"
            " switches",
        )
    else:
        reason, text = (
            FaultReason.OTHER_ACTIVE,
            f"it is {reply.state.value}; only one tapper may be charged at a time, so wait and "
            "tap again",
        )
    return HardwareFault(reason, f"the tapper board on {driver.port} is not at rest: {text}")
