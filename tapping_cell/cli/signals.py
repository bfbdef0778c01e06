"""Ctrl-C and SIGTERM end a verb in order.

This module imports no other module of the package, so that the verb `stop` starts fast.
"""

from __future__ import annotations

import signal


def end_on_signals() -> None:
    """Make Ctrl-C and SIGTERM raise KeyboardInterrupt, so that the verb ends in order.

    The SIGINT handler is set explicitly, because a shell starts background jobs with SIGINT
    ignored, and Python then keeps ignoring this signal.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt
