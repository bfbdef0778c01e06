"""The expectation that a driver reports a fault."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tapping_cell.hardware.faults import FaultReason, HardwareFault


@contextmanager
def expect_fault(
    reason: FaultReason, match: str | None = None
) -> Iterator[pytest.ExceptionInfo[HardwareFault]]:
    """Expect a fault for this reason, whose sentence contains the pattern ``match``."""
    with pytest.raises(HardwareFault, match=match) as caught:
        yield caught
    assert caught.value.reason is reason
