"""Fixture for emulated devices on real pseudo-terminals."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tapping_cell.simulation.device_emulator import DeviceEmulator
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal

Plug = Callable[..., PseudoTerminal]


@pytest.fixture
def plug(tmp_path: Path) -> Iterator[Plug]:
    """Return a function that connects an emulator to a pseudo-terminal; its ``path`` is the
    port."""
    with ExitStack() as stack:

        def put(emulator: DeviceEmulator, name: str = "device", **options: bool) -> PseudoTerminal:
            port = PseudoTerminal(emulator, tmp_path / name, time.monotonic, **options)
            return stack.enter_context(port)

        yield put
