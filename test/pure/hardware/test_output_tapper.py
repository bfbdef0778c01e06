"""A tapper that is fired by a digital output: what its driver guarantees, and what it reports as
not guaranteed."""

from __future__ import annotations

import math

import pytest
from event_clock import EventClock
from hardware_faults import expect_fault
from hypothesis import given, settings
from hypothesis import strategies as st
from virtual_output_link import OutputDevice, VirtualOutputLink

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.output_tapper import OutputTapperDriver, OutputTapperSettings
from tapping_cell.hardware.tapper import FireOutcome, FireResult
from tapping_cell.hardware.tapper_protocol import MAXIMUM_SHOT, Mode, Reply, Result, State

SETTINGS = OutputTapperSettings((1e-4, 1e-2, 4e-2), (0.004, 0.02, 0.036), latency=0.02)


class Memory:
    """Storage that survives a restart, like a disk."""

    def __init__(self) -> None:
        self.shot = 0
        self.broken = False

    def recall(self) -> int:
        return self.shot

    def keep(self, shot: int) -> None:
        if self.broken:
            raise OSError("no space left on device")
        self.shot = shot


class Cell(EventClock):
    """The emulated output and the driver, in virtual time."""

    def __init__(self, interface: str = "service", reads_back: bool = True) -> None:
        super().__init__(50.0)
        self.device = OutputDevice()
        self.memory = Memory()
        self.link = VirtualOutputLink(
            self.device, lambda: self.time, self.sleep, interface, reads_back
        )
        self.driver = OutputTapperDriver(self.link, SETTINGS, self.memory)

    def shoot(self, shot: int, energy: float = 1e-2, allowed: bool = True) -> FireResult:
        reply = self.driver.charge(shot, energy)
        assert reply.state is State.CHARGED and reply.shot == shot
        return self.driver.fire(shot, 0.04, lambda release_by: allowed)


@pytest.fixture(params=["service", "topic", "pulse"])
def cell(request: pytest.FixtureRequest) -> Cell:
    made = Cell(request.param)
    made.driver.connect()
    return made


def test_a_shot_is_one_pulse_of_the_length_for_the_energy(cell: Cell) -> None:
    asked = cell.time
    assert cell.shoot(7).outcome is FireOutcome.FIRED
    ((on, off),) = cell.device.pulses()
    assert off - on == pytest.approx(0.02, abs=1e-6)
    assert asked < on and off <= cell.time
    assert cell.driver.status().last_fired == 7
    assert cell.driver.counters.fired == 1


@given(st.floats(1e-4, 4e-2))
def test_the_pulse_length_increases_with_energy_and_matches_the_table(energy: float) -> None:
    pulse = SETTINGS.pulse_for(energy)
    assert SETTINGS.pulses[0] <= pulse <= SETTINGS.pulses[-1]
    assert SETTINGS.pulse_for(min(1.1 * energy, 4e-2)) >= pulse
    for known, length in zip(SETTINGS.energies, SETTINGS.pulses, strict=True):
        assert SETTINGS.pulse_for(known) == pytest.approx(length)


@pytest.mark.parametrize("interface", ["service", "topic", "pulse"])
def test_without_a_read_back_the_outcome_is_unknown_until_seen(interface: str) -> None:
    cell = Cell(interface, reads_back=False)
    cell.driver.connect()
    result = cell.shoot(7)
    assert result.outcome is FireOutcome.UNKNOWN
    assert "the output is not read back" in result.sentence
    ((_, off),) = cell.device.pulses()
    assert off <= cell.time, "it was told before the pulse was over"
    assert cell.shoot(8).outcome is FireOutcome.UNKNOWN, "the next shot is taken"


def test_a_sent_shot_is_never_sent_again_after_a_restart(cell: Cell) -> None:
    cell.shoot(7)
    again = OutputTapperDriver(cell.link, SETTINGS, cell.memory)
    again.connect()
    for shot in (6, 7):
        with expect_fault(FaultReason.SHOT_SPENT):
            again.charge(shot, 1e-2)
    cell.driver = again
    assert cell.shoot(8).outcome is FireOutcome.FIRED
    assert len(cell.device.pulses()) == 2


def test_a_shot_that_cannot_be_stored_is_not_fired(cell: Cell) -> None:
    cell.memory.broken = True
    result = cell.shoot(7)
    assert result.outcome is FireOutcome.NOT_FIRED and "no space left" in result.sentence
    assert result.fault is not None and result.fault.reason is FaultReason.REJECTED
    assert not cell.device.pulses()


def test_the_output_is_not_switched_if_the_last_check_refuses_or_is_too_old(cell: Cell) -> None:
    assert cell.shoot(7, allowed=False).outcome is FireOutcome.NOT_FIRED
    cell.driver.charge(8, 1e-2)

    def slow(release_by: float) -> bool:
        cell.sleep(0.5)
        return True

    late = cell.driver.fire(8, 0.04, slow)
    assert late.outcome is FireOutcome.NOT_FIRED and "too slow" in late.sentence
    assert late.fault is not None and late.fault.reason is FaultReason.TIMEOUT
    assert not cell.device.pulses()


def test_the_guard_must_be_closed_and_its_state_received(cell: Cell) -> None:
    cell.device.guard_closed = False
    with expect_fault(FaultReason.INTERLOCK):
        cell.driver.charge(7, 1e-2)
    cell.device.guard_closed = True
    cell.driver.charge(7, 1e-2)
    cell.device.guard_closed = False
    opened = cell.driver.fire(7, 0.04, lambda by: True)
    assert opened.outcome is FireOutcome.NOT_FIRED
    assert opened.fault is not None and opened.fault.reason is FaultReason.INTERLOCK
    cell.device.guard_closed = True
    cell.device.faults.silent_inputs = True
    cell.sleep(1.0)
    with pytest.raises(HardwareFault, match="guard names has been silent"):
        cell.driver.charge(8, 1e-2)
    assert not cell.device.pulses()


@pytest.mark.parametrize("interface", ["service", "topic"])
def test_a_stop_during_a_pulse_switches_off(interface: str) -> None:
    cell = Cell(interface)
    cell.driver.connect()
    cell.driver.charge(7, 4e-2)
    cell.after(0.010, cell.driver.stop)
    result = cell.driver.fire(7, 0.04, lambda by: True)
    assert result.outcome is FireOutcome.UNKNOWN
    ((on, off),) = cell.device.pulses()
    assert off - on < 0.012
    with expect_fault(FaultReason.STOPPED):
        cell.driver.charge(8, 1e-2)
    assert cell.driver.clear().state is State.SAFE


def test_an_output_that_is_not_proven_off_ends_the_session() -> None:
    cell = Cell("service")
    cell.driver.connect()
    cell.device.faults.lost_off = 1
    result = cell.shoot(7)
    assert result.outcome is FireOutcome.FIRED
    assert "did not confirm that it is off" in cell.driver.counters.last_error
    with expect_fault(FaultReason.DISCONNECTED) as caught:
        cell.driver.status()
    assert "did not confirm that it is off" not in caught.value.sentence
    cell.driver.connect()
    assert not cell.device.level(cell.time)
    assert cell.shoot(8).outcome is FireOutcome.FIRED


def test_an_output_that_stays_on_is_refused_with_a_message() -> None:
    cell = Cell("topic")
    cell.device.set_at(cell.time, True)
    cell.device.faults.lost_off = 99
    with pytest.raises(HardwareFault, match="reads back as on"):
        cell.driver.connect()
    cell.device.faults.lost_off = 0
    cell.driver.connect()
    cell.device.set_at(cell.time, True)
    cell.sleep(0.05)
    with expect_fault(FaultReason.REJECTED) as caught:
        cell.driver.status()
    assert "supply off" in caught.value.sentence
    cell.sleep(0.05)
    assert not cell.device.level(cell.time), "it was not switched off"


def test_a_refused_request_is_not_fired_only_where_the_read_back_agrees() -> None:
    for reads_back, outcome in ((True, FireOutcome.NOT_FIRED), (False, FireOutcome.UNKNOWN)):
        cell = Cell("service", reads_back)
        cell.driver.connect()
        cell.device.faults.refuses = True
        result = cell.shoot(7)
        assert result.outcome is outcome
        if result.fault is not None:
            assert result.fault.reason is FaultReason.REJECTED
        assert not cell.device.pulses()


def test_silent_topics_are_reported_at_connect() -> None:
    cell = Cell()
    cell.device.faults.present = False
    with expect_fault(FaultReason.PORT_MISSING):
        cell.driver.connect(1.0)


def test_a_session_begins_with_connect_and_ends_when_the_output_is_lost() -> None:
    cell = Cell()
    assert not cell.driver.connected and not cell.driver.version
    cell.driver.connect()
    assert cell.driver.connected and cell.driver.version == "digital output by service"
    assert cell.driver.counters.reconnects == 0
    cell.link.close()
    assert not cell.driver.connected
    cell.driver.connect()
    assert cell.driver.counters.reconnects == 1
    cell.device.faults.present = False
    with expect_fault(FaultReason.PORT_MISSING):
        cell.driver.connect(0.1)
    assert not cell.driver.version


def test_close_switches_off_and_may_be_repeated(cell: Cell) -> None:
    cell.device.set_at(cell.time, True)
    for _ in range(2):
        cell.driver.close()
        cell.sleep(0.05)
        assert not cell.device.level(cell.time)
        assert not cell.link.is_open and not cell.driver.version
        assert not cell.driver.counters.last_error
    with expect_fault(FaultReason.DISCONNECTED):
        cell.driver.status()


def test_a_latched_stop_leaves_the_link_open_but_begins_no_session(cell: Cell) -> None:
    cell.driver.stop()
    with expect_fault(FaultReason.STOPPED):
        cell.driver.connect()
    assert cell.link.is_open and not cell.driver.connected
    assert cell.driver.counters.stops == 1
    cell.driver.close()
    assert not cell.driver.counters.last_error


@pytest.mark.parametrize("name", ["guard", "read_back"])
def test_connect_waits_for_the_first_message_of_each_input(name: str) -> None:
    cell = Cell()
    began = cell.time
    cell.link.published[name] = began + 0.3, math.inf
    cell.driver.connect(1.0)
    assert cell.time >= began + 0.3
    cell = Cell()
    cell.link.published[name] = began + 2.0, math.inf
    with expect_fault(FaultReason.TIMEOUT, rf"tapper\.output\.{name} names"):
        cell.driver.connect(1.0)
    assert began + 1.0 <= cell.time < began + 1.1
    assert cell.driver.counters.timeouts == 1
    assert not cell.link.is_open


@pytest.mark.parametrize("published", [(-math.inf, 50.2), (math.inf, math.inf)])
@pytest.mark.parametrize("name", ["guard", "read_back"])
def test_an_input_that_falls_silent_ends_the_session(cell: Cell, name, published) -> None:
    cell.driver.charge(7, 1e-2)
    cell.link.published[name] = published
    cell.sleep(0.8)
    with expect_fault(FaultReason.DISCONNECTED, f"{name} names has been silent"):
        cell.driver.status()
    assert not cell.driver.connected
    cell.link.published[name] = -math.inf, math.inf
    assert cell.driver.connect().state is State.SAFE


def test_the_state_is_reported_like_that_of_a_board(cell: Cell) -> None:
    assert cell.driver.status() == Reply(
        0, 0, Result.OK, State.SAFE, 0, 0.0, True, False, 0, None, 0, 0, Mode.RUN, False,
        version="digital output",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("shot", "energy"),
    [(0, 1e-2), (MAXIMUM_SHOT + 1, 1e-2), (7, 0.9e-4), (7, 4.1e-2), (7, math.nan)],
)
def test_a_shot_number_or_an_energy_out_of_range_is_refused(cell: Cell, shot, energy) -> None:
    with expect_fault(FaultReason.OUT_OF_RANGE):
        cell.driver.charge(shot, energy)
    assert cell.driver.status().state is State.SAFE


@pytest.mark.parametrize(("shot", "energy"), [(1, 1e-4), (MAXIMUM_SHOT, 4e-2)])
def test_the_limits_of_shot_number_and_energy_are_accepted(cell: Cell, shot, energy) -> None:
    assert cell.shoot(shot, energy).outcome is FireOutcome.FIRED


def test_an_output_has_one_channel(cell: Cell) -> None:
    with expect_fault(FaultReason.SETTINGS_MISMATCH):
        cell.driver.charge(7, 1e-2, channel=1)


def test_only_the_prepared_shot_is_fired_and_only_once(cell: Cell) -> None:
    given_up = cell.driver.charge(6, 1e-2, lambda: False)
    assert given_up.state is State.SAFE
    for prepared, shot in ((None, 6), (7, 8)):
        if prepared is not None:
            cell.driver.charge(prepared, 1e-2)
        other = cell.driver.fire(shot, 0.04, lambda by: True)
        assert other.outcome is FireOutcome.NOT_FIRED
        assert other.fault is not None and other.fault.reason is FaultReason.REJECTED
    assert cell.memory.shot == 0 and not cell.device.pulses()
    assert cell.driver.fire(7, 0.04, lambda by: True).outcome is FireOutcome.FIRED
    with expect_fault(FaultReason.SHOT_SPENT):
        cell.driver.fire(7, 0.04, lambda by: True)
    assert len(cell.device.pulses()) == 1


def test_a_number_is_spent_even_if_the_last_check_refused_or_the_storage_was_lost(cell) -> None:
    assert cell.shoot(7, allowed=False).outcome is FireOutcome.NOT_FIRED
    with expect_fault(FaultReason.SHOT_SPENT):
        cell.driver.charge(7, 1e-2)
    cell.memory.shot = 0
    cell.driver.connect()
    with expect_fault(FaultReason.SHOT_SPENT):
        cell.driver.charge(7, 1e-2)


def test_a_stopped_tapper_does_not_begin_a_shot(cell: Cell) -> None:
    cell.driver.charge(7, 1e-2)
    cell.driver.stop()
    with expect_fault(FaultReason.STOPPED):
        cell.driver.fire(7, 0.04, lambda by: True)
    assert cell.memory.shot == 0


@pytest.mark.parametrize(
    ("took", "outcome"), [(0.015, FireOutcome.FIRED), (0.025, FireOutcome.NOT_FIRED)]
)
def test_the_last_check_may_take_as_long_as_the_latency(cell: Cell, took, outcome) -> None:
    def check(release_by: float) -> bool:
        assert release_by == pytest.approx(cell.time + 0.036 + 2 * SETTINGS.latency)
        cell.sleep(took)
        return True

    cell.driver.charge(7, 4e-2)
    assert cell.driver.fire(7, 0.04, check).outcome is outcome
    assert cell.driver.counters.late == (outcome is FireOutcome.NOT_FIRED)


def test_an_unknown_outcome_is_reported_when_the_output_is_off_at_the_latest(cell: Cell) -> None:
    promised: list[float] = []
    cell.driver.charge(7, 4e-2)
    cell.after(0.010, cell.driver.stop)
    result = cell.driver.fire(7, 0.04, lambda by: promised.append(by) is None)
    assert result.outcome is FireOutcome.UNKNOWN
    assert cell.time >= promised[0]
    assert not cell.driver.connected


def test_a_shot_ends_as_soon_as_the_read_back_has_shown_the_pulse(cell: Cell) -> None:
    promised: list[float] = []
    cell.driver.charge(7, 4e-2)
    cell.driver.fire(7, 0.04, lambda by: promised.append(by) is None)
    assert cell.time < promised[0] - SETTINGS.latency


@pytest.mark.parametrize(("delay", "told"), [(0.0, False), (0.002, False), (0.01, True)])
def test_a_pulse_that_this_computer_made_too_long_is_reported(monkeypatch, delay, told) -> None:
    cell = Cell("topic")
    cell.driver.connect()
    monkeypatch.setattr(cell.link, "sleep", lambda duration: cell.sleep(duration + delay))
    assert cell.shoot(7, energy=1e-2).outcome is FireOutcome.FIRED
    assert ("faster than planned" in cell.driver.counters.last_error) is told


def test_an_output_that_stays_on_after_the_shot_ends_the_session(cell: Cell) -> None:
    cell.device.faults.stuck = True
    assert cell.shoot(7).outcome is FireOutcome.FIRED
    assert not cell.driver.connected
    with expect_fault(FaultReason.TIMEOUT, "reads back as on"):
        cell.driver.connect()


@pytest.mark.parametrize(
    ("fault", "value", "reason"),
    [("lost_off", 1, FaultReason.TIMEOUT), ("refuses_off", True, FaultReason.REJECTED)],
)
def test_a_discharge_that_is_not_confirmed_ends_the_session(fault, value, reason) -> None:
    cell = Cell(reads_back=False)
    cell.driver.connect()
    cell.driver.charge(7, 1e-2)
    setattr(cell.device.faults, fault, value)
    began = cell.time
    with expect_fault(reason):
        cell.driver.discharge()
    assert not cell.driver.connected
    if reason is FaultReason.TIMEOUT:
        assert cell.time - began == pytest.approx(1.0, abs=0.01)
        assert cell.driver.counters.timeouts == 1


@pytest.mark.parametrize("fault", ["lost_off", "refuses_off"])
def test_a_session_ends_if_switching_off_is_not_answered_after_a_shot(fault: str) -> None:
    cell = Cell(reads_back=False)
    cell.driver.connect()
    setattr(cell.device.faults, fault, True)
    assert cell.shoot(7).outcome is FireOutcome.UNKNOWN
    assert not cell.driver.connected
    ended = cell.time
    for call in (cell.driver.status, cell.driver.discharge, lambda: cell.driver.charge(8, 1e-2)):
        with expect_fault(FaultReason.DISCONNECTED):
            call()
    assert cell.time == ended


def test_a_discharged_shot_is_not_fired(cell: Cell) -> None:
    cell.driver.charge(7, 1e-2)
    assert cell.driver.discharge().state is State.SAFE
    assert cell.driver.fire(7, 0.04, lambda by: True).outcome is FireOutcome.NOT_FIRED
    assert not cell.device.pulses()


def test_a_prepared_shot_is_discarded_if_the_output_reads_back_as_on(cell: Cell) -> None:
    cell.driver.charge(7, 1e-2)
    cell.device.set_at(cell.time, True)
    cell.sleep(0.05)
    with expect_fault(FaultReason.REJECTED):
        cell.driver.status()
    cell.sleep(0.05)
    assert cell.driver.status().state is State.SAFE


FAULTS = st.sampled_from(
    ["none", "lost_on", "lost_off", "refuses", "lost_answers", "broken_wire", "stop", "gone"]
)


@settings(max_examples=4 * settings.default.max_examples)
@given(
    st.sampled_from(["service", "topic", "pulse"]),
    st.booleans(),
    st.lists(st.tuples(FAULTS, st.floats(1e-4, 4e-2), st.floats(0.0, 0.06)), max_size=6),
)
def test_no_failure_causes_a_second_shot_or_a_false_report(interface, reads_back, plan):
    cell = Cell(interface, reads_back)
    for number, (fault, energy, when) in enumerate(plan, start=1):
        faults = cell.device.faults
        faults.present, faults.refuses, faults.lost_answers = True, False, False
        faults.broken_wire, faults.lost_on, faults.lost_off = False, 0, 0
        cell.events.clear()
        cell.driver.clear()
        before = len(cell.device.pulses())
        cell.driver.charge(number, energy)
        if fault == "stop":
            cell.after(when, cell.driver.stop)
        elif fault == "gone":
            cell.after(when, lambda: setattr(cell.device.faults, "present", False))
        elif fault in ("lost_on", "lost_off"):
            setattr(faults, fault, 1)
        elif fault != "none":
            setattr(faults, fault, True)
        promised: list[float] = []

        def allow(release_by: float, promised: list[float] = promised) -> bool:
            promised.append(release_by)
            return True

        result = cell.driver.fire(number, 0.04, allow)
        cell.sleep(0.2)
        new = cell.device.pulses()[before:]
        assert len(new) <= 1, "more than one pulse for a shot"
        if result.outcome is FireOutcome.FIRED:
            assert new, "told as fired, but it was not"
            assert reads_back
        if result.outcome is FireOutcome.NOT_FIRED:
            assert not new, "told as not fired, but it was"
        for _, off in new:
            if off > promised[0]:
                # The output stayed on longer than the driver had stated. The driver must notice
                # this and disconnect, so that nothing is fired until the output is proven off. It
                # can notice this only by a read-back or by an answer of the service.
                blind = interface != "service" and not reads_back
                assert blind or not cell.driver.connected or fault in ("lost_answers", "gone")
