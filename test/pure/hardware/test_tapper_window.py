"""The striker is fired only within the time window of the last check, however long the driver's
process is frozen."""

from __future__ import annotations

from random import Random

from tapping_cell.hardware.faults import HardwareFault
from tapping_cell.hardware.tapper import FireOutcome, TapperDriver
from tapping_cell.hardware.tapper_protocol import State
from tapping_cell.simulation.fault_layer import FaultLayer
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.simulation.virtual_line import VirtualClock, VirtualTransport

SHOTS = 250


class FreezingTransport(VirtualTransport):
    """A line whose driver is frozen for 1 ms to 5 s before or after some calls."""

    def __init__(self, line: FaultLayer, clock: VirtualClock, random: Random) -> None:
        super().__init__(line, clock, "tapper")
        self.random = random
        self.armed = False
        self.frozen = 0

    def freeze(self) -> None:
        """Randomly let time pass, as for a process that is frozen."""
        if self.armed and self.random.random() < 0.15:
            self.frozen += 1
            self.sleep(10 ** self.random.uniform(-3.0, 0.7))

    def write(self, data: bytes, timeout: float = 1.0) -> None:
        self.freeze()
        super().write(data, timeout)
        self.freeze()

    def read(self, timeout: float) -> bytes:
        self.freeze()
        data = super().read(timeout)
        self.freeze()
        return data


def test_the_striker_never_fires_outside_the_window_of_the_last_check() -> None:
    random, clock = Random(7), VirtualClock()
    device = TapperEmulator(now=clock.now)
    transport = FreezingTransport(FaultLayer(device), clock, random)
    driver = TapperDriver(transport, draw_number=random.randrange)
    clock.limit = float("inf")
    outcomes: dict[FireOutcome | str, int] = {}
    for shot in range(1, SHOTS + 1):
        transport.armed = False
        if not driver.connected:
            driver.connect()
        assert driver.charge(shot, 0.001).state is State.CHARGED
        checked: list[tuple[float, float]] = []

        def last_check(release_by: float, checked: list[tuple[float, float]] = checked) -> bool:
            checked.append((clock.now, release_by))
            transport.freeze()
            return True

        before = len(device.fires)
        transport.armed = True
        try:
            result = driver.fire(shot, random.uniform(0.02, 0.1), last_check)
            outcome: FireOutcome | str = result.outcome
        except HardwareFault as fault:
            outcome = fault.reason.value
        transport.armed = False
        outcomes[outcome] = outcomes.get(outcome, 0) + 1
        if outcome is FireOutcome.UNKNOWN:
            assert clock.now >= checked[0][1]
        device.advance(clock.now)
        fired = len(device.fires)
        transport.sleep(6.0)
        device.advance(clock.now)
        assert len(device.fires) == fired, "released after the call had returned"
        fired = device.fires[before:]
        assert len(fired) <= 1
        if outcome is FireOutcome.FIRED:
            assert len(fired) == 1
        elif outcome is not FireOutcome.UNKNOWN:
            assert not fired, outcome
        for _, _, at in fired:
            asked, release_by = checked[0]
            assert asked <= at and at + device.machine.release_time <= release_by
    assert transport.frozen > SHOTS / 2
    assert outcomes[FireOutcome.FIRED] > SHOTS / 5
    assert outcomes[FireOutcome.NOT_FIRED] > SHOTS / 10
