"""Mutants that change no behaviour, or only one that nobody needs: their ids, with the reason."""

from __future__ import annotations

COUNTS = "only equality of the counts before and after a request matters"
INSTANT = "differs at a single instant of a continuous time"
LENGTH = "arm and tapper use the same function; any digest of at least 4 bytes does"
RANDOM = "any unpredictable number above 0 does"

REASONS: dict[str, str] = {
    "logic.permit:key_digest:6:value:0": LENGTH,
    "logic.permit:key_digest:6:value:2": LENGTH,
    "logic.permit:key_digest:6:value:3": LENGTH,
    "logic.permit:key_digest:7:operand:1": "the digest is 0 once in 2**64 keys",
    "logic.permit:key_digest:7:value:0": "the digest is 0 once in 2**64 keys",
    "logic.permit:key_digest:7:value:1": "the digest is 0 once in 2**64 keys",
    "logic.permit:longest_hold:7:operand:1": "check-config refuses a cell that exceeds the limit",
    "logic.permit:random_key:2:value:0": RANDOM,
    "logic.permit:random_key:2:value:1": "the number is 0 once in 2**63 keys",
    "logic.permit:random_key:2:value:5": RANDOM,
    "logic.permit:shortfall:4:compare:0": "a grant of 0 s falls short by the whole time either way",
    "logic.stops:StopLatch.__init__:6:value:0": COUNTS,
    "logic.stops:StopLatch.begin_reset:2:compare:0": INSTANT,
    "logic.stops:StopLatch.receive:8:operand:1": "no level is asserted unless a stop is latched",
    "logic.stops:StopLatch.try_reset:23:drop:0": "every new stop cancels the confirmation",
}
