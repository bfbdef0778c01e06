"""The tapper's driver with a board whose replies each test determines: the requests that the driver
sends, the replies that it takes, and the reasons that it reports."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hardware_faults import expect_fault

from tapping_cell.hardware import tapper_protocol as protocol
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.tapper import FireOutcome, FireResult, TapperDriver, TapperSettings
from tapping_cell.hardware.tapper_protocol import Mode, State

SAID: dict[str, object] = {
    "result": "OK", "state": "SAFE", "shot": 0, "uj": 0, "closed": 1, "stop": 0, "fired": 0,
    "speed": 0, "boot": 3, "ms": 500, "mode": "RUN", "enabled": 0, "channel": 0, "channels": 1,
    "mounts": 0, "version": "",
}  # fmt: skip
"""What the board replies unless a test changes it."""
CHARGED: dict[str, object] = {"state": "CHARGED", "shot": 7, "uj": 10_000}
DAMAGED = b"@7,12,OK,CHAR*0000\n"
NOISE = b"\xff" * 200
LOST: list[object] = []
IMPATIENT = TapperSettings(home_timeout=1.0, charge_timeout=0.5)

Said = dict[str, object] | list[object]
"""Changes of one reply, or several replies and other bytes that follow each other."""


class Board:
    """A line to a board, in virtual time. Each reply arrives at once."""

    name = "port"

    def __init__(self) -> None:
        self.time, self.is_open, self.stopped, self.broken = 1000.0, False, False, False
        self.always: dict[str, object] = {}
        """Changes of all replies."""
        self.script: dict[str, list[Said]] = {}
        """Replies to the next requests of each command; the last one is repeated."""
        self.requests: list[str] = []
        self.numbers: list[tuple[int, int]] = []
        """Session and sequence number of each request."""
        self.stops: list[bytes] = []
        self.output = b""

    def now(self) -> float:
        return self.time

    def sleep(self, duration: float) -> None:
        assert duration >= 0
        self.time += duration

    def open(self, timeout: float) -> None:
        self.is_open = True

    def close(self) -> None:
        self.is_open = False

    def stop(self, data: bytes) -> bool:
        self.stopped = True
        self.stops.append(data)
        return True

    def release(self) -> None:
        self.stopped = False

    def read(self, timeout: float) -> bytes:
        self._require()
        output, self.output = self.output, b""
        self.time += 0.0 if output else timeout
        return output

    def write(self, data: bytes, timeout: float = 1.0) -> None:
        self._require()
        session, sequence, *words = data[1:].split(b"*")[0].decode().split(",")
        self.requests.append(" ".join(words))
        assert len(self.requests) < 2000, "a call does not end"
        self.numbers.append((int(session), int(sequence)))
        planned: list[Said] = self.script.get(words[0], [{}])
        said = planned.pop(0) if len(planned) > 1 else planned[0]
        for each in said if isinstance(said, list) else [said]:
            self.output += each if isinstance(each, bytes) else self._reply(words, each)

    def _reply(self, words: list[str], change: object) -> bytes:
        assert isinstance(change, dict)
        session, sequence = self.numbers[-1]
        own = {"session": session, "sequence": sequence} | SAID
        if words[0] == "HELLO":
            own |= {"result": "WELCOME", "version": "2.1.0"}
        elif words[0] == "MODE":
            own["mode"] = words[1]
        fields = own | self.always | change
        body = ",".join(str(value) for value in fields.values() if value != "").encode()
        return b"@%s*%04X\n" % (body, protocol.crc16(body))

    def _require(self) -> None:
        if self.stopped or self.broken:
            reason = FaultReason.STOPPED if self.stopped else FaultReason.DISCONNECTED
            raise HardwareFault(reason, "the line")


class Cell:
    """A board and its driver with an open session."""

    def __init__(self, settings: TapperSettings | None = None, **always: object) -> None:
        self.board = Board()
        self.board.always = always
        self.driver = TapperDriver(self.board, settings, lambda below: below - 1)
        self.driver.connect()
        self.board.requests.clear()
        self.board.numbers.clear()

    def fire(
        self, window: float = 0.04, allowed: Callable[[float], bool] = lambda by: True
    ) -> FireResult:
        self.board.script["STATUS"] = [CHARGED]
        return self.driver.fire(7, window, allowed)


class Times:
    """A condition that is true a given number of times."""

    def __init__(self, count: int) -> None:
        self.left = count

    def __call__(self, _: float = 0.0) -> bool:
        self.left -= 1
        return self.left >= 0


# Settings


@pytest.mark.parametrize(
    "values",
    [
        {"attempts": 0},
        {"reply_timeout": 0.0},
        {"fire_reply_timeout": 0.0},
        {"poll_period": 0.2, "reply_timeout": 0.1},
    ],
)
def test_settings_with_which_the_driver_cannot_work_are_refused(values) -> None:
    with pytest.raises(ValueError, match="must be"):
        TapperSettings(**values)


def test_the_limits_of_the_settings_are_accepted() -> None:
    assert TapperSettings(attempts=1, poll_period=0.04, reply_timeout=0.2).attempts == 1


# Sessions


@pytest.mark.parametrize(("drawn", "session"), [(0, 1), (0xFFFE, 0xFFFF)])
def test_a_session_begins_with_a_greeting_and_the_mode(drawn: int, session: int) -> None:
    board = Board()
    board.always = {"channels": 8}

    def draw(below: int) -> int:
        assert below == 0xFFFF
        return drawn

    driver = TapperDriver(board, TapperSettings(mode=Mode.SETUP), draw)
    assert (driver.connected, driver.version, driver.channels) == (False, "", 1)
    driver.connect()
    assert board.requests == ["HELLO", "MODE SETUP"]
    assert [number for number, _ in board.numbers] == [session, session]
    assert (driver.connected, driver.version, driver.channels) == (True, "2.1.0", 8)
    assert driver.counters.reconnects == 0
    driver.connect()
    assert driver.counters.reconnects == 1
    driver.close()
    assert not board.is_open and not driver.connected
    with expect_fault(FaultReason.DISCONNECTED):
        driver.status()
    driver.connect()
    assert driver.counters.reconnects == 1, "nothing was lost"


def test_sequence_numbers_increase_by_one_and_wrap() -> None:
    cell = Cell()
    cell.driver._sequence = 0xFFFE
    for _ in range(3):
        cell.driver.status()
    assert [number for _, number in cell.board.numbers] == [0xFFFF, 0, 1]
    for last, next_one in ((0x7FFF, 0x8000), (0xFFFF, 0)):
        cell.driver._sequence = last
        cell.board.numbers.clear()
        cell.driver.connect()
        assert [number for _, number in cell.board.numbers] == [next_one, next_one + 1]


@pytest.mark.parametrize("first", [LOST, {"result": "OK"}, [b"@7,"]])
def test_a_greeting_is_repeated_until_it_is_answered(first: Said) -> None:
    board = Board()
    board.script["HELLO"] = [first, {}]
    driver = TapperDriver(board)
    driver.connect(0.0)
    assert board.requests == ["HELLO", "HELLO", "MODE RUN"]


def test_a_silent_board_is_refused_after_the_time_limit() -> None:
    board = Board()
    board.script["HELLO"] = [LOST]
    driver = TapperDriver(board)
    with expect_fault(FaultReason.UNKNOWN_FIRMWARE, "nothing on port answers"):
        driver.connect(1.0)
    assert 1001.0 <= board.time < 1001.3
    assert not board.is_open and not driver.connected


@pytest.mark.parametrize(
    "greeting",
    [
        {"version": "1.9.0"},
        {"version": "3.0.0"},
        [
            b"@1,1,WELCOME,other,words,1.9.0*%04X\n"
            % protocol.crc16(b"1,1,WELCOME,other,words,1.9.0")
        ],
    ],
)
def test_another_version_of_the_protocol_is_refused(greeting: Said) -> None:
    board = Board()
    board.script["HELLO"] = [greeting]
    with expect_fault(FaultReason.UNKNOWN_FIRMWARE, r"firmware \S+ uses another protocol"):
        TapperDriver(board).connect()


def test_a_latched_stop_leaves_the_line_open_but_begins_no_session() -> None:
    cell = Cell()
    assert cell.driver.stop()
    assert cell.board.stops == [protocol.STOP] and cell.driver.counters.stops == 1
    with expect_fault(FaultReason.STOPPED):
        cell.driver.connect()
    assert cell.board.is_open and not cell.driver.connected


def test_the_rest_of_a_frame_of_an_earlier_session_is_discarded() -> None:
    cell = Cell()
    cell.board.script["STATUS"] = [[{}, b"@7,12,"]]
    cell.driver.status()
    cell.driver.connect()
    assert cell.driver.counters.bad_frames == 0


@pytest.mark.parametrize("change", [{"boot": 4}, {"result": "SESSION"}])
def test_a_board_that_restarted_or_was_taken_over_ends_the_session(change) -> None:
    cell = Cell()
    cell.board.script["STATUS"] = [change]
    with expect_fault(FaultReason.BOARD_RESET, "restarted" if "boot" in change else "taken over"):
        cell.driver.status()
    assert not cell.driver.connected


def test_a_line_that_is_lost_ends_the_session_but_a_stop_of_the_line_does_not() -> None:
    cell = Cell()
    cell.board.stopped = True
    with expect_fault(FaultReason.STOPPED):
        cell.driver.status()
    assert cell.driver.connected
    cell.board.stopped = False
    cell.board.broken = True
    with expect_fault(FaultReason.DISCONNECTED):
        cell.driver.status()
    assert not cell.driver.connected and cell.driver.counters.last_error == "the line"
    cell = Cell()
    cell.board.is_open = False
    assert not cell.driver.connected


# Requests and replies


@pytest.mark.parametrize("foreign", [{"session": 9}, {"sequence": 9}])
def test_a_reply_to_another_request_is_not_taken(foreign) -> None:
    cell = Cell()
    foreign = foreign | {"state": "CHARGED"}
    for said in ([foreign], [foreign, {}]):
        cell.board.script["STATUS"] = [said, {}]
        assert cell.driver.status().state is State.SAFE
        assert cell.driver.last_reply is not None and cell.driver.last_reply.state is State.SAFE
    assert len(cell.board.requests) == 3
    assert cell.driver.counters.retries == cell.driver.counters.timeouts == 1


def test_a_request_is_repeated_unchanged_until_it_is_answered() -> None:
    cell = Cell()
    cell.board.script["STATUS"] = [LOST, LOST, LOST, LOST, {}]
    began = cell.board.time
    cell.driver.status()
    assert cell.board.requests == 5 * ["STATUS"] and len(set(cell.board.numbers)) == 1
    assert cell.board.time - began == pytest.approx(4 * cell.driver.settings.reply_timeout)
    assert cell.driver.counters.retries == 4 and cell.driver.counters.timeouts == 4
    cell.board.script["STATUS"] = [LOST]
    with expect_fault(FaultReason.TIMEOUT, "does not answer STATUS"):
        cell.driver.status()
    assert len(cell.board.requests) == 10
    assert cell.driver.connected


@pytest.mark.parametrize(
    ("replies", "reason"),
    [
        ([[DAMAGED], LOST], FaultReason.TIMEOUT),
        ([[DAMAGED], [DAMAGED], LOST], FaultReason.PROTOCOL),
        ([[NOISE], LOST], FaultReason.PROTOCOL),
        ([[b"ok\n"]], FaultReason.PROTOCOL),
    ],
)
def test_mostly_damaged_replies_are_distinguished_from_silence(replies, reason) -> None:
    cell = Cell(TapperSettings(attempts=len(replies)))
    for _ in range(2):  # each request is counted on its own
        cell.board.script["STATUS"] = list(replies)
        with expect_fault(reason):
            cell.driver.status()
    cell.board.script["STATUS"] = [[NOISE, {}], LOST]
    cell.driver.status()
    with expect_fault(FaultReason.TIMEOUT):
        cell.driver.status()
    cell.board.script |= {"STATUS": [[DAMAGED]], "HELLO": [LOST]}
    with expect_fault(FaultReason.PROTOCOL):
        cell.driver.status()
    with expect_fault(FaultReason.UNKNOWN_FIRMWARE):
        cell.driver.connect(0.0)


def test_damaged_frames_and_other_bytes_are_counted() -> None:
    cell = Cell()
    cell.board.script["STATUS"] = [[DAMAGED, b"noise", {}]]
    cell.driver.status()
    assert (cell.driver.counters.bad_frames, cell.driver.counters.damaged_frames) == (2, 1)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"result": "NEEDS_PERSON", "stop": 1}, FaultReason.NEEDS_PERSON),
        ({"result": "BUSY", "stop": 1, "closed": 0}, FaultReason.STOPPED),
        ({"result": "STOPPED"}, FaultReason.STOPPED),
        ({"result": "BUSY", "closed": 0}, FaultReason.INTERLOCK),
        ({"result": "INTERLOCK"}, FaultReason.INTERLOCK),
        ({"result": "LATE"}, FaultReason.TIMEOUT),
        ({"result": "SPENT"}, FaultReason.SHOT_SPENT),
        ({"result": "JUMP"}, FaultReason.OUT_OF_RANGE),
        ({"result": "NOT_ENABLED"}, FaultReason.NOT_ENABLED),
        ({"result": "RANGE"}, FaultReason.OUT_OF_RANGE),
        ({"result": "CHANNEL"}, FaultReason.SETTINGS_MISMATCH),
        ({"result": "BUSY", "state": "UNHOMED", "channels": 2}, FaultReason.STRIKER_AWAY),
        ({"result": "BUSY", "state": "UNHOMED"}, FaultReason.POSITION_LOST),
        ({"result": "BUSY", "mode": "SETUP", "uj": 6000}, FaultReason.NOT_ENABLED),
        ({"result": "BUSY", "channels": 2}, FaultReason.REJECTED),
    ],
)
def test_the_reason_of_a_refusal_follows_from_the_reply(change, reason) -> None:
    cell = Cell()
    cell.board.script["HOME"] = [change]
    with expect_fault(reason):
        cell.driver.home()
    assert cell.board.requests == ["HOME"]
    assert cell.driver.counters.last_error


def test_the_strikers_that_are_away_are_named() -> None:
    cell = Cell()
    cell.board.script["HOME"] = [
        {"result": "BUSY", "state": "UNHOMED", "channels": 4, "mounts": 0b0101}
    ]
    with expect_fault(FaultReason.STRIKER_AWAY, "of channel 1, 3 did not"):
        cell.driver.home()


@pytest.mark.parametrize("change", [{"mode": "RUN"}, {"result": "UNKNOWN"}])
def test_a_mode_that_the_board_does_not_accept_is_refused(change) -> None:
    cell = Cell()
    cell.board.script["MODE"] = [change]
    with expect_fault(FaultReason.REJECTED):
        cell.driver.set_mode(Mode.SETUP)
    assert cell.driver.mode is Mode.RUN
    cell.board.script.clear()
    assert cell.driver.set_mode(Mode.SETUP).mode is Mode.SETUP
    assert cell.driver.mode is Mode.SETUP


# Homing and return


def test_homing_is_awaited() -> None:
    cell = Cell()
    cell.board.script = {"HOME": [{"state": "HOMING"}], "STATUS": [{"state": "HOMING"}, {}]}
    assert cell.driver.home().state is State.SAFE
    assert cell.board.requests == ["HOME", "STATUS", "STATUS"]


def test_homing_that_is_given_up_is_ended_by_a_discharge() -> None:
    cell = Cell()
    cell.board.script = {
        "HOME": [{"state": "HOMING"}],
        "STATUS": [{"state": "HOMING"}],
        "DISCHARGE": [{"state": "UNHOMED"}],
    }
    assert cell.driver.home(Times(1)).state is State.UNHOMED
    assert cell.board.requests == ["HOME", "STATUS", "DISCHARGE"]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({}, FaultReason.HOMING_FAILED),
        ({"stop": 1}, FaultReason.STOPPED),
        ({"closed": 0}, FaultReason.INTERLOCK),
        ({"channels": 2}, FaultReason.STRIKER_AWAY),
    ],
)
def test_the_reason_of_a_failed_homing_is_reported(change, reason) -> None:
    cell = Cell()
    cell.board.script = {
        "HOME": [{"state": "HOMING"}],
        "STATUS": [{"state": "UNHOMED"} | change],
    }
    with expect_fault(reason):
        cell.driver.home()


def test_homing_that_does_not_end_is_ended_after_the_time_limit() -> None:
    cell = Cell(IMPATIENT, state="HOMING")
    began = cell.board.time
    with expect_fault(FaultReason.HOMING_FAILED):
        cell.driver.home()
    assert 1.0 <= cell.board.time - began < 1.1
    assert cell.board.requests[-1] == "DISCHARGE"


@pytest.mark.parametrize("state", ["RELEASING", "DISCHARGING", "HOMING"])
def test_the_return_of_the_striker_is_awaited_without_a_discharge(state: str) -> None:
    cell = Cell(IMPATIENT)
    cell.board.script["STATUS"] = [{"state": state}, {"state": state}, {}]
    assert cell.driver.wait_for_return().state is State.SAFE
    cell.board.script["STATUS"] = [{"state": state}]
    assert cell.driver.wait_for_return(Times(1)).state is State(state)
    assert cell.board.requests == 5 * ["STATUS"]
    began = cell.board.time
    assert cell.driver.wait_for_return().state is State(state)
    assert 1.0 <= cell.board.time - began < 1.1
    assert set(cell.board.requests) == {"STATUS"}


def test_a_board_at_rest_is_not_awaited() -> None:
    cell = Cell(state="UNHOMED")
    assert cell.driver.wait_for_return().state is State.UNHOMED
    assert cell.board.requests == ["STATUS"]


# Charging


@pytest.mark.parametrize(
    ("shot", "energy"),
    [
        (0, 0.01),
        (protocol.MAXIMUM_SHOT + 1, 0.01),
        *((7, energy) for energy in (0.0, 1e-7, -0.01, 10.000001, 1e300)),
        *((7, energy) for energy in (math.nan, math.inf, -math.inf)),
    ],
)
def test_a_shot_number_or_an_energy_out_of_range_is_not_sent(shot: int, energy: float) -> None:
    cell = Cell()
    with expect_fault(FaultReason.OUT_OF_RANGE):
        cell.driver.charge(shot, energy)
    assert not cell.board.requests


@pytest.mark.parametrize("channel", [-1, 2])
def test_a_channel_that_the_board_does_not_have_is_not_sent(channel: int) -> None:
    cell = Cell(channels=2)
    with expect_fault(FaultReason.SETTINGS_MISMATCH):
        cell.driver.charge(7, 0.01, channel=channel)
    assert not cell.board.requests


@pytest.mark.parametrize(
    ("shot", "energy", "channel", "request_sent"),
    [
        (1, 1e-6, 0, "CHARGE 1 1 3000"),
        (protocol.MAXIMUM_SHOT, 10.0, 0, f"CHARGE {protocol.MAXIMUM_SHOT} 10000000 3000"),
        (7, 0.0125, 1, "CHARGE 7 12500 3000 1"),
    ],
)
def test_charging_is_requested_once_and_awaited(shot, energy, channel, request_sent) -> None:
    cell = Cell(channels=2, shot=shot, uj=round(energy * 1e6), channel=channel)
    cell.board.script = {
        "CHARGE": [{"state": "CHARGING"}],
        "STATUS": [{"state": "CHARGING"}, {"state": "CHARGED"}],
    }
    reply = cell.driver.charge(shot, energy, timeout=3.0, channel=channel)
    assert reply.state is State.CHARGED and reply.energy == pytest.approx(energy)
    assert cell.board.requests == [request_sent, "STATUS", "STATUS"]


@pytest.mark.parametrize(
    ("charging", "requests"),
    [
        ({"state": "CHARGING", "shot": 7}, ["STATUS", "DISCHARGE"]),
        ({"result": "BUSY", "state": "DISCHARGING"}, ["CHARGE 7 10000 10000", "DISCHARGE"]),
    ],
)
def test_charging_that_is_given_up_is_ended_by_a_discharge(charging, requests) -> None:
    cell = Cell()
    cell.board.script = {"CHARGE": [charging], "STATUS": [charging]}
    assert cell.driver.charge(7, 0.01, Times(1)).state is State.SAFE
    assert cell.board.requests == ["CHARGE 7 10000 10000", *requests]


@pytest.mark.parametrize("change", [{"state": "SAFE"}, {"state": "CHARGING", "shot": 6}])
def test_charging_that_the_board_ended_is_refused(change) -> None:
    cell = Cell()
    cell.board.script = {
        "CHARGE": [{"state": "CHARGING", "shot": 7}],
        "STATUS": [{"shot": 7} | change, CHARGED],
    }
    with expect_fault(FaultReason.REJECTED):
        cell.driver.charge(7, 0.01)


def test_charging_that_does_not_end_is_ended_after_the_time_limit() -> None:
    cell = Cell(IMPATIENT, state="CHARGING", shot=7)
    began = cell.board.time
    with expect_fault(FaultReason.TIMEOUT, "was not charged after 0.5 s"):
        cell.driver.charge(7, 0.01)
    assert 0.5 <= cell.board.time - began < 0.6
    assert cell.board.requests[-1] == "DISCHARGE"


@pytest.mark.parametrize("result", ["BUSY", "NOT_HOMED"])
@pytest.mark.parametrize("state", ["RELEASING", "DISCHARGING", "HOMING"])
def test_a_carriage_that_returns_is_awaited_before_charging(result: str, state: str) -> None:
    cell = Cell(IMPATIENT)
    returning: Said = {"result": result, "state": state}
    cell.board.script["CHARGE"] = [returning, returning, CHARGED]
    assert cell.driver.charge(7, 0.01).state is State.CHARGED
    assert cell.board.requests == 3 * ["CHARGE 7 10000 10000"]
    assert len(set(cell.board.numbers)) == 3
    cell.board.script["CHARGE"] = [returning]
    began = cell.board.time
    with expect_fault(FaultReason.REJECTED):
        cell.driver.charge(8, 0.01)
    assert 1.0 <= cell.board.time - began < 1.1


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"result": "BUSY", "state": "CHARGED"}, FaultReason.REJECTED),
        ({"result": "SPENT", "state": "DISCHARGING"}, FaultReason.SHOT_SPENT),
        ({"result": "SPENT", "state": "UNHOMED"}, FaultReason.SHOT_SPENT),
    ],
)
def test_a_charge_that_is_refused_for_another_reason_is_not_repeated(change, reason) -> None:
    cell = Cell()
    cell.board.script["CHARGE"] = [change, CHARGED]
    with expect_fault(reason):
        cell.driver.charge(7, 0.01)
    assert len(cell.board.requests) == 1


def test_a_carriage_at_an_unknown_position_is_homed_before_charging() -> None:
    cell = Cell()
    lost: Said = {"result": "NOT_HOMED", "state": "UNHOMED"}
    cell.board.script["CHARGE"] = [lost, CHARGED]
    assert cell.driver.charge(7, 0.01).state is State.CHARGED
    assert cell.board.requests == ["CHARGE 7 10000 10000", "HOME", "CHARGE 7 10000 10000"]
    cell.board.requests.clear()
    cell.board.script = {
        "CHARGE": [lost],
        "HOME": [{"state": "HOMING"}],
        "STATUS": [{"state": "HOMING"}],
        "DISCHARGE": [{"state": "UNHOMED"}],
    }
    assert cell.driver.charge(8, 0.01, Times(2)).state is State.UNHOMED
    assert cell.board.requests == ["CHARGE 8 10000 10000", "HOME", "STATUS", "DISCHARGE"]


# A shot


def test_a_shot_is_one_request_with_the_deadline_on_the_clock_of_the_board() -> None:
    cell = Cell()
    cell.board.script["FIRE"] = [{"result": "FIRED", "fired": 7}]
    promised: list[float] = []
    result = cell.fire(0.04, lambda by: promised.append(by) is None)
    assert result.outcome is FireOutcome.FIRED and result.shot == 7
    assert cell.board.requests == ["STATUS", "FIRE 7 540"]
    assert promised == [pytest.approx(1000.0 + (0.04 + 0.033) * 1.01, abs=1e-6)]
    assert cell.driver.counters.fired == 1
    with expect_fault(FaultReason.SHOT_SPENT):
        cell.fire()
    with expect_fault(FaultReason.SHOT_SPENT):
        cell.driver.charge(7, 0.01)
    assert len(cell.board.requests) == 2


def test_a_shot_names_the_channel_that_was_charged() -> None:
    cell = Cell(channels=4, channel=3, fired=7)
    cell.board.script["CHARGE"] = [CHARGED]
    cell.driver.charge(7, 0.01, channel=3)
    assert cell.fire().outcome is FireOutcome.FIRED
    assert cell.board.requests[-1] == "FIRE 7 540 3"


@pytest.mark.parametrize("window", [0.0, 0.0009, 0.101, math.nan])
def test_a_window_out_of_range_is_not_sent(window: float) -> None:
    cell = Cell()
    with expect_fault(FaultReason.OUT_OF_RANGE):
        cell.fire(window)
    assert not cell.board.requests


@pytest.mark.parametrize("window", [0.001, 0.1])
def test_the_limits_of_the_window_are_accepted(window: float) -> None:
    assert Cell(fired=7).fire(window).outcome is FireOutcome.FIRED


@pytest.mark.parametrize("change", [{"state": "SAFE"}, {"shot": 6}])
def test_a_shot_that_is_not_charged_is_not_sent(change) -> None:
    cell = Cell()
    cell.board.script["STATUS"] = [CHARGED | change]
    result = cell.driver.fire(7, 0.04, lambda by: True)
    assert result.outcome is FireOutcome.NOT_FIRED
    assert result.fault is not None and result.fault.reason is FaultReason.REJECTED
    assert cell.board.requests == ["STATUS"]


def test_a_stopped_or_unconnected_tapper_sends_nothing() -> None:
    cell = Cell()
    cell.driver.close()
    with expect_fault(FaultReason.DISCONNECTED):
        cell.fire(math.nan)
    cell.driver.connect()
    cell.board.requests.clear()
    cell.driver.stop()
    with expect_fault(FaultReason.STOPPED, "make the cell safe"):
        cell.fire(math.nan)
    assert not cell.board.requests


def test_a_shot_that_the_last_check_forbids_is_discharged_and_can_be_charged_again() -> None:
    cell = Cell()
    cell.board.script["CHARGE"] = [CHARGED]
    result = cell.fire(allowed=lambda by: False)
    assert result.outcome is FireOutcome.NOT_FIRED and result.fault is None
    assert cell.board.requests == ["STATUS", "DISCHARGE"]
    assert cell.driver.charge(7, 0.01).state is State.CHARGED


@pytest.mark.parametrize(("window", "allowed", "sent"), [(0.1, 9, 4), (0.1, 2, 2), (0.02, 9, 1)])
def test_fire_is_repeated_within_its_window_while_it_is_allowed(window, allowed, sent) -> None:
    cell = Cell()
    cell.board.script["FIRE"] = [LOST]
    result = cell.fire(window, Times(allowed))
    assert result.outcome is FireOutcome.NOT_FIRED
    fires = sent * [f"FIRE 7 {500 + round(1e3 * window)}"]
    assert cell.board.requests == ["STATUS", *fires, "DISCHARGE"]
    assert len(set(cell.board.numbers)) == 3


def test_a_shot_whose_reply_is_lost_is_told_by_the_next_reply() -> None:
    cell = Cell()
    cell.board.script |= {"FIRE": [LOST], "DISCHARGE": [{"fired": 7}]}
    assert cell.fire().outcome is FireOutcome.FIRED
    assert cell.driver.counters.fired == 1


@pytest.mark.parametrize(
    ("answer", "connected", "why"),
    [
        (LOST, True, "does not answer"),
        ({"boot": 4, "fired": 7}, False, "restarted"),
    ],
)
def test_an_unknown_outcome_is_told_when_a_release_is_impossible(answer, connected, why) -> None:
    cell = Cell()
    cell.board.script |= {"FIRE": [answer], "DISCHARGE": [answer]}
    promised: list[float] = []
    result = cell.fire(0.1, lambda by: promised.append(by) is None)
    assert result.outcome is FireOutcome.UNKNOWN and why in result.sentence
    assert cell.board.time >= promised[0]
    assert cell.board.time < promised[0] + 5 * cell.driver.settings.reply_timeout
    assert cell.driver.connected is connected
    assert cell.driver.counters.unknown == 1 and cell.driver.counters.fired == 0


def test_a_line_that_is_lost_at_the_shot_gives_an_unknown_outcome() -> None:
    cell = Cell()

    def cut(release_by: float) -> bool:
        cell.board.broken = True
        return True

    result = cell.fire(0.1, cut)
    assert result.outcome is FireOutcome.UNKNOWN
    assert cell.board.time == pytest.approx(1000.0 + (0.1 + 0.033) * 1.01)
    assert cell.driver.counters.last_error == "the line"


@pytest.mark.parametrize(
    ("change", "reason", "late", "connected"),
    [
        ({"result": "LATE"}, FaultReason.TIMEOUT, 1, True),
        ({"result": "SESSION"}, FaultReason.REJECTED, 0, False),
        ({"result": "INTERLOCK", "fired": 6}, FaultReason.INTERLOCK, 0, True),
    ],
)
def test_a_shot_that_the_board_refused_is_not_fired(change, reason, late, connected) -> None:
    cell = Cell()
    cell.board.script["FIRE"] = [change]
    result = cell.fire()
    assert result.outcome is FireOutcome.NOT_FIRED
    assert result.fault is not None and result.fault.reason is reason
    assert cell.driver.counters.late == late
    assert cell.driver.connected is connected
    with expect_fault(FaultReason.SHOT_SPENT if connected else FaultReason.DISCONNECTED):
        cell.fire()


# Stop and reset


def test_a_stop_is_cleared_only_by_clear_which_the_board_must_accept() -> None:
    cell = Cell()
    cell.driver.stop()
    assert cell.driver.stopped
    with expect_fault(FaultReason.STOPPED):
        cell.driver.status()
    cell.board.script["CLEAR"] = [{"result": "NEEDS_PERSON"}, {}]
    with expect_fault(FaultReason.NEEDS_PERSON):
        cell.driver.clear()
    assert cell.driver.clear().state is State.SAFE
    assert cell.board.requests == ["CLEAR", "CLEAR"] and not cell.driver.stopped
    cell.driver.close()
    cell.board.requests.clear()
    cell.driver.clear()
    assert cell.board.requests == ["HELLO", "MODE RUN", "CLEAR"]
    assert cell.driver.discharge().state is State.SAFE
    assert cell.board.requests[-1] == "DISCHARGE"


def test_clear_restores_the_mode() -> None:
    cell = Cell()
    cell.board.script["CLEAR"] = [{"mode": "SETUP"}]
    assert cell.driver.clear().mode is Mode.RUN
    assert cell.board.requests == ["CLEAR", "MODE RUN"]
