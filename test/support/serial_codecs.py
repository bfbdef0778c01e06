"""Properties of the serial codecs for any bytes, and a fuzzer that searches for counterexamples.

    python test/support/serial_codecs.py --runs 1000000              # every target
    python test/support/serial_codecs.py grbl-in --runs 1000000

With atheris installed (``pip install atheris``) the inputs are guided by coverage; without it they
are mutations of real lines chosen by a seed. ``test_serial_codecs.py`` checks the same properties
with fewer inputs.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import random
import re
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import FunctionType

from tapping_cell.hardware import grbl, marlin, tapper_protocol
from tapping_cell.hardware.text_line import LONGEST_LINE, Bad
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.grbl_program import Modal, read_line
from tapping_cell.simulation.marlin_emulator import MarlinEmulator
from tapping_cell.simulation.tapper_emulator import TapperEmulator

SEEDS = (
    b"ok\r\n<Idle|MPos:0.000,-1.500,0.000,12.345|FS:0,0|WCO:0.000,0.000,0.000,0.000>\r\n",
    b"\r\nGrbl 1.1h ['$' for help]\r\n[MSG:'$H'|'$X' to unlock]\r\nALARM:1\r\nerror:9\r\n",
    b"$110=6900.000\r\n[VER:1.1h.20190825:]\r\n[GC:G0 G54 G18 G21 G90 G94 M5 M9 T0 F0 S0]\r\n",
    b"ok\nstart\necho:busy: processing\nError:checksum mismatch, Last Line: 1\nResend: 2\n",
    b"X:1.00 Y:2.00 Z:3.00 A:4.00 Count X:200 Y:400 Z:1200 A:400\nok N7 P15 B3\n",
    b"FIRMWARE_NAME:Marlin 2.1.2.4 SOURCE_CODE_URL:x\nCap:EMERGENCY_PARSER:1\n",
    b"echo:  M92 X80.00 Y80.00\nSoft endstops: ON  Min: X0.00 Y0.00  Max: X200.00 Y200.00\n",
    b"@7,1,WELCOME,SAFE,0,0,1,0,0,0,3,1.0.0*0000\n@7,2,OK,DRAWN,9,5000,1,0,8,316000,3*0000\n",
)


class Broken(AssertionError):
    """A property that does not hold."""


def _decode_all(decode: Callable[[bytes], object], data: bytes) -> tuple[list[object], bytes]:
    frames = []
    while True:
        decoded = decode(data)
        if decoded.frame is None:  # type: ignore[attr-defined]
            return frames, decoded.rest  # type: ignore[attr-defined]
        if len(decoded.rest) >= len(data):  # type: ignore[attr-defined]
            raise Broken(f"no byte of {data!r} was consumed")
        frames.append(decoded.frame)  # type: ignore[attr-defined]
        data = decoded.rest  # type: ignore[attr-defined]


def _incoming(decode: Callable[[bytes], object], longest: int, data: bytes) -> None:
    """Check that decoding never raises, always ends, keeps few bytes, and gives the same frames for
    split input."""
    whole, rest = _decode_all(decode, data)
    if len(rest) > longest:
        raise Broken(f"{len(rest)} bytes are kept")
    cut = data.rfind(b"\n", 0, len(data) // 2 + 1) + 1
    first, held = _decode_all(decode, data[:cut])
    second, _ = _decode_all(decode, held + data[cut:])
    # Splitting the input may change the invalid frames that are decoded from noise, but not the
    # valid frames.
    if [f for f in first + second if not _is_bad(f)] != [f for f in whole if not _is_bad(f)]:
        raise Broken(f"{data!r} is decoded differently in two parts")


def _is_bad(frame: object) -> bool:
    return isinstance(frame, Bad | tapper_protocol.Bad)


def grbl_in(data: bytes) -> None:
    """Check the decoding of lines from a Grbl."""
    _incoming(grbl.decode, LONGEST_LINE, data)


def marlin_in(data: bytes) -> None:
    """Check the decoding of lines from a Marlin."""
    _incoming(marlin.decode, LONGEST_LINE, data)


def tapper_in(data: bytes) -> None:
    """Check the decoding of replies from the tapper. The last frame is also tested with a correct
    checksum, so that its content is parsed, too."""
    _incoming(tapper_protocol.decode, tapper_protocol.LONGEST_FRAME, data)
    body = data.translate(None, b"@\n\r")[: tapper_protocol.LONGEST_FRAME - 8]
    frame = b"@%s*%04X\n" % (body, tapper_protocol.crc16(body))
    _incoming(tapper_protocol.decode, tapper_protocol.LONGEST_FRAME, frame)


def _numbers(data: bytes) -> tuple[float, ...]:
    return struct.unpack("<5d", data.ljust(40, b"\0")[:40])


def _fits(values: tuple[float, ...]) -> bool:
    return all(math.isfinite(value) and abs(value) < 1e6 for value in values)


def grbl_out(data: bytes) -> None:
    """Check move lines with the emulator's own parser."""
    *target, feed = _numbers(data)
    try:
        line = grbl.move_line("XYZA", target, feed)
    except ValueError:
        if _fits((*target, feed)) and feed > 0:
            raise Broken(f"{target} at {feed} was refused") from None
        return
    if not _fits((*target, feed)) or feed < 0.001:
        return
    read = read_line(line.decode().strip(), "XYZA", Modal())
    for axis, value in enumerate(target):
        if abs(read.axes[axis] - value) > 0.0006:
            raise Broken(f"{line!r} is read as {read.axes}")


def marlin_out(data: bytes) -> None:
    """Check numbered move lines with a checksum and a parser that are implemented in this
    function."""
    *target, feed = _numbers(data)
    number = int.from_bytes(data[:3], "little")
    try:
        line = marlin.numbered(number, marlin.move_code("XYZA", target, feed))
    except ValueError:
        if _fits((*target, feed)) and feed > 0:
            raise Broken(f"{target} at {feed} was refused") from None
        return
    body, _, check = line.strip().rpartition(b"*")
    value = 0
    for byte in body:
        value ^= byte
    found = re.fullmatch(rb"N(\d+) G1 X(\S+) Y(\S+) Z(\S+) A(\S+) F(\S+)", body)
    if value != int(check) or found is None or int(found[1]) != number:
        raise Broken(f"{line!r} is not a numbered line")
    for text, wanted in zip(found.groups()[1:], (*target, feed), strict=True):
        if abs(float(text) - wanted) > max(0.0006, 1e-9 * abs(wanted)):
            raise Broken(f"{line!r} does not contain {wanted}")


def tapper_out(data: bytes) -> None:
    """Check that the emulated board repeats the session and the number of a request in its
    answer."""
    session, sequence, which, shot = struct.unpack("<HHBQ", data.ljust(13, b"\0")[:13])
    command = list(tapper_protocol.Command)[which % len(tapper_protocol.Command)]
    arguments: tuple[int | tapper_protocol.Mode, ...] = {
        "CHARGE": (shot, shot % 100_000, 1000),
        "FIRE": (shot, shot % 2**32),
        "MODE": (list(tapper_protocol.Mode)[shot % 2],),
    }.get(command.value, ())
    try:
        frame = tapper_protocol.encode(session, sequence, command, *arguments)
    except ValueError:
        if session:
            raise Broken(f"{command} was refused") from None
        return
    board = TapperEmulator()
    board.receive(frame, 0.0)
    replies, _ = _decode_all(tapper_protocol.decode, board.take_output(1.0))
    keys = [(r.session, r.sequence) for r in replies if isinstance(r, tapper_protocol.Reply)]
    if keys != [(session, sequence)]:
        raise Broken(f"{frame!r} was answered with {replies}")


def boards(data: bytes) -> None:
    """Check that the emulated boards survive any bytes and that their output can be decoded."""
    for board, decode in (
        (GrblEmulator(), grbl.decode),
        (MarlinEmulator(), marlin.decode),
        (TapperEmulator(), tapper_protocol.decode),
    ):
        board.receive(data[:120], 0.0)
        frames, _ = _decode_all(decode, board.take_output(5.0))
        if isinstance(board, TapperEmulator) and any(_is_bad(frame) for frame in frames):
            raise Broken(f"{data!r} makes {type(board).__name__} send {frames}")


TARGETS: dict[str, Callable[[bytes], None]] = {
    "grbl-in": grbl_in,
    "marlin-in": marlin_in,
    "tapper-in": tapper_in,
    "grbl-out": grbl_out,
    "marlin-out": marlin_out,
    "tapper-out": tapper_out,
}
"""The properties to check, by name: each codec in each direction."""


def mutated(generator: random.Random) -> bytes:
    """Return a few real lines with changed, lost, duplicated and added bytes."""
    data = bytearray(b"".join(generator.choices(SEEDS, k=generator.randint(1, 3))))
    for _ in range(generator.randint(0, 12)):
        place = generator.randrange(len(data) + 1)
        length = generator.randint(1, 8)
        kind = generator.randrange(4)
        if kind == 0:
            data[place : place + length] = generator.randbytes(length)
        elif kind == 1:
            del data[place : place + length]
        elif kind == 2:
            data[place:place] = data[place : place + length]
        else:
            data[place:place] = generator.randbytes(length)
    return bytes(data)


def _run_here(name: str, runs: int, seed: int) -> None:
    target = TARGETS[name]
    if importlib.util.find_spec("atheris") is None:
        generator = random.Random(seed)
        for _ in range(runs):
            target(mutated(generator) if name.endswith("-in") else generator.randbytes(40))
        return
    import atheris

    for module in (grbl, marlin, tapper_protocol):
        for key, value in vars(module).items():
            ours = isinstance(value, FunctionType) and value.__module__ == module.__name__
            if ours and key != "crc16":
                setattr(module, key, atheris.instrument_func(value))
    with tempfile.TemporaryDirectory() as corpus:
        for number, line in enumerate(SEEDS):
            (Path(corpus) / str(number)).write_bytes(line)
        arguments = [name, f"-runs={runs}", f"-seed={seed}", "-max_len=256", "-verbosity=0", corpus]
        atheris.Setup(arguments, target)
        atheris.Fuzz()


def main() -> int:
    """Fuzz each requested target in a process of its own, because atheris ends the process in which
    it runs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", choices=[*TARGETS, []], default=[])
    parser.add_argument("--runs", type=int, default=1_000_000, help="inputs a target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.here:
        _run_here(arguments.targets[0], arguments.runs, arguments.seed)
        return 0
    failed = 0
    for name in arguments.targets or TARGETS:
        began = time.monotonic()
        command = [sys.executable, __file__, name, "--here"]
        command += ["--runs", str(arguments.runs), "--seed", str(arguments.seed)]
        status = subprocess.run(command, check=False).returncode
        failed += status != 0
        words = "held" if status == 0 else f"BROKEN (status {status})"
        print(f"{name}: {arguments.runs} inputs, {words}, {time.monotonic() - began:.0f} s")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
