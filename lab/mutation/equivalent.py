"""Mutants that change no behaviour, or only one that nobody needs: their ids, with the reason."""

from __future__ import annotations

COUNTS = "only equality of the counts before and after a request matters"
INSTANT = "differs at a single instant of a continuous time"

REASONS: dict[str, str] = {
    "logic.permit:longest_hold:7:operand:1": "check-config refuses a cell that exceeds the limit",
    "logic.permit:shortfall:4:compare:0": "a grant of 0 s falls short by the whole time either way",
    "logic.stops:StopLatch.__init__:6:value:0": COUNTS,
    "logic.stops:StopLatch.begin_reset:2:compare:0": INSTANT,
    "logic.stops:StopLatch.receive:8:operand:1": "no level is asserted unless a stop is latched",
    "logic.stops:StopLatch.try_reset:23:drop:0": "every new stop cancels the confirmation",
}
