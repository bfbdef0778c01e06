"""The tapper's real firmware: its logic compiled for this computer, and its AVR binary in simavr
with the driver."""

from __future__ import annotations

import binascii
import ctypes
import queue
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.hardware.tapper import FireOutcome, FireResult, TapperDriver, TapperSettings
from tapping_cell.hardware.tapper_protocol import Mode, State
from tapping_cell.simulation.spring_drive import SpringMechanism, Status
from tapping_cell.simulation.tapper_emulator import TapperEmulator, TapperMachine

SOURCE = Path(__file__).resolve().parents[2] / "firmware" / "tapper"


def make(folder: Path, *targets: str) -> None:
    built = subprocess.run(
        ["make", "-s", "-C", str(SOURCE), f"BUILD={folder}", *targets],
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stdout + built.stderr


needs_compiler = pytest.mark.skipif(
    not (shutil.which("make") and shutil.which("cc")), reason="no make or no C compiler here"
)
needs_simavr = pytest.mark.skipif(
    not (
        shutil.which("avr-gcc")
        and shutil.which("cc")
        and Path("/usr/include/simavr/sim_avr.h").exists()
    ),
    reason="gcc-avr, avr-libc and libsimavr-dev are not all installed here",
)


@needs_compiler
def test_the_logic_on_the_host(tmp_path: Path) -> None:
    make(tmp_path, "test")


@pytest.mark.skipif(not shutil.which("avr-gcc"), reason="avr-gcc is not installed here")
@pytest.mark.parametrize("drive", ["SPRING", "SOLENOID"])
def test_it_builds_for_the_board(tmp_path: Path, drive: str) -> None:
    make(tmp_path, "all", f"DRIVE={drive}")
    assert (tmp_path / "tapper.hex").stat().st_size > 0


# The firmware and the emulated tapper are independent implementations and must give the same
# answers.


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("firmware")
    make(folder, "host-library")
    loaded = ctypes.CDLL(str(folder / "libtapper_host.so"))
    loaded.host_start.argtypes = [
        ctypes.c_uint32,
        ctypes.c_uint64,
        ctypes.c_uint32,
        ctypes.c_double,
        ctypes.c_uint32,
    ]
    loaded.host_reset.argtypes = [ctypes.c_uint32, ctypes.c_uint64, ctypes.c_uint32]
    loaded.host_kept.restype = ctypes.c_uint64
    loaded.host_place.restype = ctypes.c_double
    loaded.host_output.restype = ctypes.c_char_p
    return loaded


def framed(body: str) -> bytes:
    data = body.encode()
    return b"@%s*%04X\n" % (data, binascii.crc_hqx(data, 0xFFFF))


sessions = st.sampled_from([7, 7, 7, 8])
shots = st.integers(0, 9)
energies = st.sampled_from([0, 20, 30, 999, 1000, 5000, 5001, 12500, 400_000, 2_000_000])
bodies = st.one_of(
    st.sampled_from(["HELLO", "STATUS", "DISCHARGE", "CLEAR", "HOME", "HOME", "MODE,RUN"]),
    st.sampled_from(["CHARGE,1", "FIRE", "FIRE,x,1", "JUMP", "STATUS,1", "MODE", "MODE,SETUP"]),
    st.tuples(shots, energies).map(lambda both: f"CHARGE,{both[0]},{both[1]},3000"),
    st.just(f"CHARGE,{2**64 - 1},1000,3000"),
)
WINDOWS = (-30, 0, 1, 40, 100, 101, 2**31)
events = st.one_of(
    st.tuples(st.just("frame"), sessions, st.integers(-2, 3), bodies),
    st.tuples(st.just("fire"), shots, st.sampled_from(WINDOWS)),
    st.tuples(st.just("wait"), st.sampled_from([10, 90, 250, 600, 5200])),
    st.tuples(st.sampled_from(["press", "guard", "enabling", "motor"]), st.booleans()),
    st.tuples(st.just("switch"), st.sampled_from([None, True, False])),
    st.tuples(st.just("lose"), st.sampled_from([0, 16, 10_000])),
    st.tuples(st.sampled_from(["!", "loop", "reset"])),
)
START_MS = 2**32 - 2000
EDGE_MS = 8
"""Replies are not compared this close to a change of state, because both boards update once per
millisecond."""


class BoardPair:
    """The firmware's logic and the emulated tapper, which receive the same inputs."""

    def __init__(self, library: ctypes.CDLL, place: int) -> None:
        self.library = library
        spring = SpringMechanism(back_drive=0.0)
        self.emulator = TapperEmulator(
            TapperMachine(
                spring, carriage=place, first_time_ms=START_MS, reply_latency=0.0, baud=10**9
            ),
            boot=3,
        )
        library.host_start(3, 0, START_MS, float(place), 1)
        library.host_back_drive(ctypes.c_double(0.0))
        library.host_no_bounce()
        self.now = 0
        self.started = 0
        self.sequence = 10

    def board_ms(self) -> int:
        return (START_MS + self.now - self.started) % 2**32

    def run(self, duration: int) -> None:
        """Let ``duration`` ms pass, and continue until neither board is about to change its
        state."""
        end = self.now + duration
        while self.now < end:
            before = self.emulator.state
            due = self.emulator.next_event()
            self.now += 1
            self.emulator.advance(self.now / 1e3)
            if self.emulator.state != before:
                end = max(end, self.now + EDGE_MS)
            elif self.now == end and due is not None and due * 1e3 < self.now + EDGE_MS:
                end += 1
        self.library.host_run(self.board_ms())

    def both(self, data: bytes) -> None:
        self.library.host_receive(data, len(data), self.board_ms())
        self.emulator.receive(data, self.now / 1e3)

    def do(self, event: tuple[object, ...]) -> None:
        now = self.now / 1e3
        match event:
            case ("frame", session, ahead, body):
                self.sequence = (self.sequence + int(str(ahead))) % 65536
                self.both(framed(f"{session},{self.sequence},{body}"))
            case ("fire", shot, window):
                self.sequence += 1
                deadline = (self.board_ms() + int(str(window))) % 2**32
                self.both(framed(f"7,{self.sequence},FIRE,{shot},{deadline}"))
            case ("!",):
                self.both(b"!")
            case ("press", pressed):
                self.library.host_button(pressed)
                self.library.host_step()
                self.now += 1
                self.emulator.set_clear_button(bool(pressed), self.now / 1e3)
            case ("guard", closed):
                self.library.host_interlock(closed)
                self.emulator.set_interlock(bool(closed), now)
            case ("enabling", held):
                self.library.host_enabling(held)
                self.emulator.set_enabling_switch(bool(held), now)
            case ("motor" | "switch" | "lose", _) if self.emulator.drive.status is Status.MOVING:
                pass  # firmware and emulator both detect a failure in motion, but at other steps
            case ("motor", powered):
                self.library.host_motor(powered)
                self.emulator.drive.set_power(bool(powered), now)
            case ("switch", stuck):
                self.library.host_front_switch({None: 0, True: 1, False: -1}[stuck])  # type: ignore[index]
                self.emulator.drive.set_switch(stuck, now)  # type: ignore[arg-type]
            case ("lose", steps):
                self.library.host_lose_steps(steps)
                self.emulator.drive.lose_steps(int(str(steps)), now)
            case ("loop",):
                self.library.host_wire(1)
                self.library.host_step()
                self.library.host_wire(0)
                self.now += 1
                self.emulator.open_stop_loop(self.now / 1e3)
            case ("reset",):
                kept = self.library.host_kept()
                boot = int(self.emulator._boot) + 1
                self.started = self.now
                self.library.host_reset(boot, kept, self.board_ms())
                self.emulator.power_cycle(now)


@needs_compiler
@settings(max_examples=400, deadline=None)
@given(st.sampled_from([0, 300]), st.lists(events, max_size=30))
def test_firmware_and_emulator_answer_alike(
    library: ctypes.CDLL, place: int, script: list[tuple[object, ...]]
) -> None:
    boards = BoardPair(library, place)
    start: list[tuple[object, ...]] = [("frame", 7, 1, "HELLO"), ("frame", 7, 1, "MODE,RUN")]
    homing: list[tuple[object, ...]] = [("frame", 7, 1, "HOME"), ("wait", 250)]
    for event in start + homing + script:
        boards.run(int(str(event[1])) if event[0] == "wait" else EDGE_MS)
        library.host_forget_output()
        boards.emulator.take_output(boards.now / 1e3 + 1e-6)
        boards.do(event)
        compare(boards, event)
        boards.run(EDGE_MS)
        library.host_forget_output()
        boards.emulator.take_output(boards.now / 1e3 + 1e-6)
        boards.do(("frame", 7, 1, "STATUS"))
        compare(boards, event)


def compare(boards: BoardPair, event: tuple[object, ...]) -> None:
    emulated = boards.emulator.take_output(boards.now / 1e3 + 1e-6).decode()
    firmware = boards.library.host_output().decode()
    assert strip_version(firmware) == strip_version(emulated), (event, boards.now)


def strip_version(text: str) -> list[str]:
    """Return the replies without their checksums, and each WELCOME reply also without its
    version."""
    bodies = [line.split("*")[0] for line in text.splitlines()]
    return [body.rsplit(",", 1)[0] if "WELCOME" in body else body for body in bodies]


# The AVR binary in simavr.


class Board:
    """The firmware in simavr, with access to its inputs and to its release output."""

    def __init__(self, folder: Path, place: int = 300, elf: str = "tapper.elf") -> None:
        self.process = subprocess.Popen(
            [str(folder / "simavr_board"), str(folder / elf), str(place)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        assert self.process.stdout is not None
        lines = iter(self.process.stdout.readline, "")
        self.port = next(line.split()[1] for line in lines if line.startswith("PORT"))
        self.edges: list[tuple[int, int]] = []
        self.places: list[float] = []
        """Position of the carriage at each release, in steps."""
        self.times: queue.Queue[tuple[int, float]] = queue.Queue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith("RELEASE"):
                _, level, at, place = line.split()
                self.edges.append((int(level), int(at)))
                if int(level):
                    self.places.append(float(place))
            elif line.startswith("TIME"):
                _, at, place = line.split()
                self.times.put((int(at), float(place)))

    def command(self, order: str) -> None:
        """Give an order to the simulated board and wait until it has been executed."""
        assert self.process.stdin is not None
        self.process.stdin.write(order + "\n")
        self.clock()

    def _ask(self) -> tuple[int, float]:
        assert self.process.stdin is not None
        self.process.stdin.write("time\n")
        return self.times.get(timeout=20.0)

    def clock(self) -> float:
        """Return the board's own time, s. On a busy machine it falls behind real time."""
        return self._ask()[0] * 1e-6

    def place(self) -> float:
        """Return the true position of the carriage, in steps from its front switch."""
        return self._ask()[1]

    def rest(self, duration: float) -> None:
        """Wait until ``duration`` s of the board's own time have passed."""
        end = self.clock() + duration
        while self.clock() < end:
            time.sleep(0.005)

    def pulses(self) -> list[int]:
        """Return the lengths of the release pulses, us."""
        ups = [at for level, at in self.edges if level]
        downs = [at for level, at in self.edges if not level and ups and at > ups[0]]
        return [down - up for up, down in zip(ups, downs, strict=False)]

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join()
        for stream in (self.process.stdin, self.process.stdout):
            assert stream is not None
            stream.close()


@pytest.fixture(scope="module")
def binaries(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("avr")
    make(folder, "simavr")
    return folder


@pytest.fixture
def board(binaries: Path) -> Iterator[Board]:
    running = Board(binaries)
    yield running
    running.close()


def fire(driver: TapperDriver, shot: int) -> FireResult:
    return driver.fire(shot, 0.1, lambda release_by: True)


def press_clear(board: Board, duration: float = 0.6) -> None:
    board.command("clear 1")
    board.rest(duration)
    board.command("clear 0")
    board.rest(0.01)


PATIENT = TapperSettings(attempts=50, charge_timeout=60.0, home_timeout=60.0)
"""The simulated board runs slower than real time on a busy machine."""


def connected(board: Board, mode: Mode = Mode.RUN) -> TapperDriver:
    driver = TapperDriver(SerialTransport(board.port), replace(PATIENT, mode=mode))
    driver.connect(60.0)
    return driver


@contextmanager
def fault(reason: FaultReason) -> Iterator[None]:
    with pytest.raises(HardwareFault) as caught:
        yield
    assert caught.value.reason is reason, str(caught.value)


NEAR = 4
"""Tolerance of the carriage's position, in steps, after it has moved to its front switch. The
switch bounces."""


def stored(place: float) -> float:
    """Return the energy in J of a spring of 500 N/m at ``place`` steps of 5 um."""
    return float(0.5 * 500.0 * (place * 5e-6) ** 2)


@needs_simavr
def test_the_driver_fires_the_real_firmware_once(board: Board) -> None:
    driver = connected(board)
    assert f'#define TAPPER_VERSION "{driver.version}"' in (SOURCE / "tapper.h").read_text()
    assert driver.charge(5, 0.002).state is State.CHARGED
    assert fire(driver, 5).outcome is FireOutcome.FIRED
    board.rest(0.2)
    (pulse,) = board.pulses()
    assert pulse == pytest.approx(20_000, abs=100)
    assert stored(board.places[0]) == pytest.approx(0.002, rel=0.03)
    with fault(FaultReason.SHOT_SPENT):
        fire(driver, 5)
    driver.charge(6, 0.002)
    assert fire(driver, 6).outcome is FireOutcome.FIRED
    board.rest(0.2)
    assert len(board.pulses()) == 2


@needs_simavr
def test_the_real_firmware_does_not_move_unasked_and_homes_correctly(board: Board) -> None:
    board.command("push 0")
    place = board.place()
    driver = connected(board)
    board.rest(0.4)
    assert driver.status().state is State.UNHOMED and board.place() == place
    driver.home()
    assert abs(board.place()) <= NEAR
    driver.charge(1, 0.01)
    assert stored(board.place()) == pytest.approx(0.01, rel=0.03)
    # A reset while the spring is charged: the position is unknown, regardless of the counted steps.
    board.command("reset")
    with fault(FaultReason.BOARD_RESET):
        driver.status()
    assert driver.connect().state is State.UNHOMED
    assert board.place() > 1000
    driver.charge(2, 0.01)
    assert fire(driver, 2).outcome is FireOutcome.FIRED
    board.rest(0.1)
    assert stored(board.places[0]) == pytest.approx(0.01, rel=0.03)


@needs_simavr
@pytest.mark.parametrize("wrong", ["motor 0", "switch -1", "switch 1"])
def test_the_real_firmware_is_not_homed_with_a_dead_motor_or_switch(
    board: Board, wrong: str
) -> None:
    board.command("push 0")
    board.command(wrong)
    driver = connected(board)
    with fault(FaultReason.HOMING_FAILED):
        driver.charge(1, 0.001)
    assert driver.status().state is State.UNHOMED


@needs_simavr
def test_the_real_firmware_detects_missed_steps(board: Board) -> None:
    driver = connected(board)
    driver.home()
    board.command("motor 0")
    with fault(FaultReason.POSITION_LOST):
        driver.charge(1, 0.01)
    board.command("motor 1")
    driver.charge(2, 0.01)
    board.command("lose 32")
    driver.discharge()
    board.rest(0.8)
    assert driver.status().state is State.UNHOMED
    driver.charge(3, 0.01)
    assert stored(board.place()) == pytest.approx(0.01, rel=0.03)


@needs_simavr
def test_the_real_firmware_discharges(board: Board) -> None:
    driver = connected(board)
    driver.charge(1, 0.002)
    board.rest(0.8)  # long enough without messages for the board to discharge
    assert driver.status().state is State.SAFE and abs(board.place()) <= NEAR
    assert fire(driver, 1).outcome is FireOutcome.NOT_FIRED
    driver.charge(2, 0.002)
    board.command("interlock 0")
    assert fire(driver, 2).outcome is FireOutcome.NOT_FIRED
    with fault(FaultReason.INTERLOCK):
        driver.charge(3, 0.002)
    with fault(FaultReason.INTERLOCK):
        driver.home()
    board.command("interlock 1")
    driver.charge(3, 0.002)
    assert driver.discharge().state is State.DISCHARGING
    board.rest(0.4)
    assert driver.status().state is State.SAFE and abs(board.place()) <= NEAR
    driver.charge(4, 0.002)
    assert driver.connect().state in (State.DISCHARGING, State.SAFE)
    assert board.pulses() == []


@needs_simavr
def test_the_real_firmware_requires_a_button_press_after_a_stop(board: Board) -> None:
    driver = connected(board)
    driver.charge(1, 0.002)
    press_clear(board)  # a press before the stop has no effect
    assert driver.stop()
    with fault(FaultReason.NEEDS_PERSON):
        driver.clear()
    press_clear(board, 0.2)  # pressed too briefly
    with fault(FaultReason.NEEDS_PERSON):
        driver.clear()
    board.command("clear 1")
    board.rest(0.7)
    with fault(FaultReason.NEEDS_PERSON):  # the button is still pressed
        driver.clear()
    board.command("clear 0")
    board.rest(0.01)
    assert driver.clear().state is State.SAFE
    # While the circuit of the stop input is open, pressing the clear button has no effect. After
    # the stop is cleared, the carriage is homed again.
    driver.charge(2, 0.002)
    board.command("stop 1")
    press_clear(board)
    with fault(FaultReason.NEEDS_PERSON):
        driver.clear()
    board.command("stop 0")
    press_clear(board)
    assert driver.clear().state is State.UNHOMED
    driver.charge(3, 0.002)
    assert fire(driver, 3).outcome is FireOutcome.FIRED


@needs_simavr
def test_the_real_firmware_keeps_shot_numbers_until_an_operator_resets_them(board: Board) -> None:
    driver = connected(board)
    first = driver.status().boot
    driver.charge(8, 0.002)
    with fault(FaultReason.OUT_OF_RANGE):
        driver.charge(2**64 - 1, 0.002)

    asked: list[float] = []

    def reset(release_by: float) -> bool:
        if not asked:
            board.command("reset")
        asked.append(release_by)
        return True

    assert driver.fire(8, 0.1, reset).outcome is FireOutcome.UNKNOWN
    assert driver.connect().boot == first + 1
    second = TapperDriver(driver._transport, PATIENT)
    second.connect()
    with fault(FaultReason.SHOT_SPENT):
        second.charge(8, 0.002)
    press_clear(board, 5.2)
    board.rest(1.5)  # time to clear the shot numbers, which are 320 bytes of EEPROM
    with fault(FaultReason.BOARD_RESET):
        second.status()
    assert second.connect().boot == first + 2
    second.charge(1, 0.002)
    assert board.pulses() == []


@needs_simavr
def test_the_real_firmware_in_set_up_mode(board: Board) -> None:
    driver = connected(board, Mode.SETUP)
    assert driver.status().mode is Mode.SETUP
    with fault(FaultReason.NOT_ENABLED):
        driver.charge(1, 0.006)
    assert driver.charge(1, 0.005).state is State.CHARGED
    board.command("enabling 1")
    driver.discharge()
    driver.charge(2, 0.006)
    board.command("enabling 0")
    assert fire(driver, 2).outcome is FireOutcome.NOT_FIRED
    assert board.pulses() == []


@needs_simavr
def test_the_real_firmware_refuses_every_late_fire(board: Board) -> None:
    """FIRE is delayed by a random time after the last check, as if the process were frozen."""
    driver = connected(board)
    random = Random(1)
    late = 0
    for shot in range(1, 31):
        driver.charge(shot, 0.0005)
        window = random.uniform(0.02, 0.1)

        def freeze(release_by: float) -> bool:
            time.sleep(random.choice([0.0, random.uniform(0.0, 0.12), random.uniform(0.1, 0.45)]))
            return True

        before = len(board.places)
        result = driver.fire(shot, window, freeze)
        assert result.outcome is not FireOutcome.UNKNOWN
        board.rest(0.05)
        assert len(board.places) - before == (result.outcome is FireOutcome.FIRED)
        late += result.outcome is FireOutcome.NOT_FIRED
    assert late >= 5


@needs_simavr
def test_the_solenoid_build_charges_without_a_carriage(binaries: Path) -> None:
    make(binaries / "solenoid", "all", "DRIVE=SOLENOID")
    board = Board(binaries, elf="solenoid/tapper.elf")
    try:
        driver = connected(board)
        assert driver.status().state is State.SAFE
        driver.charge(1, 0.005)
        assert fire(driver, 1).outcome is FireOutcome.FIRED
        board.rest(0.1)
        (pulse,) = board.pulses()
        assert pulse == pytest.approx(4_000, abs=100)
    finally:
        board.close()
