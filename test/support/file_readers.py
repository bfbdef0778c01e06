"""Readers of files that people and other programs wrote, and a fuzzer that damages such files.

    python test/support/file_readers.py --count 100000        # every reader
    python test/support/file_readers.py csv --count 1000

A reader must refuse a damaged file in one sentence, or read the values that an independent reader
finds in it: ruamel.yaml, minidom, Pillow, rosbags, or for tables the numbers from which
they were written. ``test/pure/configuration/test_file_readers.py`` checks the same with fewer
files.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import functools
import io
import math
import random
import re
import struct
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any
from xml.dom import minidom

import numpy as np
import PIL.Image
from made_bags import TYPES, MadeRun
from rosbags.highlevel import AnyReader
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from tapping_cell.calibration.arm import RECORD_COLUMNS
from tapping_cell.calibration.csv_table import RecordError, read_csv
from tapping_cell.cli.check_config import SECTIONS, check
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import load_object
from tapping_cell.configuration.schema import ConfigurationError, load
from tapping_cell.configuration.table import load_camera_model
from tapping_cell.configuration.yaml_document import YamlError, parse_yaml
from tapping_cell.hardware.chain_urdf import chain_from_urdf
from tapping_cell.report.bag import BagWriter, read_bag
from tapping_cell.report.recorded import BagError
from tapping_cell.report.run_reader import illustrated_run
from tapping_cell.se2 import Pose
from tapping_cell.vision.images import ImageRefused, read_photograph

LONGEST_MESSAGE = 3000
DATA_END = 15
"""Type of the record of an MCAP file that ends its data."""
URDF = Path(__file__).parents[2] / "examples" / "six_axis_cell" / "six_axis_arm.urdf"
NUMBER = re.compile(r"(?<![\w.])-?\d+\.\d+|(?<![\w.])-?\d+(?![\w.])")
WORDS = (
    *("0,5", "1_0", "011", "0x10", "0o7", "0b1", "1:30", "1e-2", "1E3", "+7", ".5", "5.", "-.5"),
    *("\u22120.5", "1 000", "1,000", "5 mm", "17%", "90", "1e999", ".nan", ".inf", "", "~", "null"),
    *("[", "{", "}", "*a", "&a 1", "!!x", "!!str 1", "true", "no", "'1'", '"0.5"', "-180", "300"),
    *("0.0", "12.5", "\t1", "\xa01", "# 1", "|", "2026-11-28", "1.2.3", "\u201c1\u201d"),
)


class Broken(AssertionError):
    """A file that was accepted with a value that the independent reader does not find."""


class NoComparison(Exception):
    """A file that was accepted, but that the independent reader refuses, for example because of a
    tab after a colon."""


@functools.cache
def _shared(name: str) -> str:
    return (shared_folder() / name).read_text(encoding="utf-8")


@functools.cache
def _folder() -> Path:
    made = tempfile.TemporaryDirectory()
    _kept.append(made)
    return Path(made.name)


_kept: list[tempfile.TemporaryDirectory[str]] = []


def _refusal(error: Exception) -> str:
    if not 0 < len(str(error)) < LONGEST_MESSAGE or "\n" in str(error):
        raise Broken(f"the message is not one short sentence: {error!s:.200}")
    return "refused"


def damaged(generator: random.Random, text: str) -> str:
    """Replace numbers of a text; drop, repeat, exchange or indent lines; change characters."""
    for _ in range(generator.choice((0, 1, 1, 2, 3))):
        found = list(NUMBER.finditer(text))
        if found:
            match = generator.choice(found)
            new = generator.choice(WORDS)
            if generator.random() < 0.3:
                new = f"{generator.uniform(-1e4, 1e4):.6g}"
            text = text[: match.start()] + new + text[match.end() :]
    lines = text.split("\n")
    for _ in range(generator.choice((0, 0, 1, 2))):
        k = generator.randrange(len(lines))
        what = generator.randrange(5)
        if what == 0:
            del lines[k : k + 1 + (len(lines) == 1)]
            lines = lines or [""]
        elif what == 1:
            lines.insert(k, lines[k])
        elif what == 2:
            lines[k], lines[k - 1] = lines[k - 1], lines[k]
        elif what == 3:
            lines[k] = "  " + lines[k]
        else:
            place = generator.randrange(len(lines[k]) + 1)
            letter = generator.choice("\t:,-[]{}#'\"&*|>%@ \u00a0x0")
            lines[k] = lines[k][:place] + letter + lines[k][place + generator.randrange(2) :]
    return "\n".join(lines)


def _same(read: Any, expected: Any, place: str) -> None:
    """Compare a value with that of ruamel.yaml, which follows YAML 1.2."""
    if isinstance(expected, (datetime.date, datetime.datetime)):
        if not isinstance(read, str):
            raise Broken(f"{place}: the date {expected} was read as {read!r}")
    elif isinstance(expected, Mapping):
        if not isinstance(read, Mapping):
            raise Broken(f"{place}: read {read!r:.200}, but it is {dict(expected)!r:.200}")
        _same(list(read), list(expected), f"keys of {place}")
        _same(list(read.values()), list(expected.values()), place)
    elif isinstance(expected, list):
        if not isinstance(read, list) or len(read) != len(expected):
            raise Broken(f"{place}: read {read!r:.200}, but it is {expected!r:.200}")
        for index, pair in enumerate(zip(read, expected, strict=True)):
            _same(*pair, f"{place}[{index}]")
    elif type(read) is not type(expected) or (read != expected and read == read):
        raise Broken(f"{place}: read {read!r:.200}, but it is {expected!r:.200}")


def _independent(text: str) -> Any:
    try:
        return YAML(typ="safe", pure=True).load(text)
    except (YAMLError, ValueError) as error:  # ValueError: a date such as 2026-99-99
        raise NoComparison from error


def yaml(generator: random.Random) -> str:
    """A part of a YAML file."""
    source = generator.choice(("cell.yaml", "table.yaml", "objects/aluminium_disk.yaml"))
    lines = _shared(source).split("\n")
    first = generator.randrange(len(lines))
    text = damaged(generator, "\n".join(lines[first : first + generator.randint(1, 15)]))
    try:
        read = parse_yaml(text)
    except YamlError as error:
        return _refusal(error)
    _same(read, _independent(text), "document")
    return "accepted"


def _compare(section: Any, document: Any, place: str) -> None:
    """Compare the values of a section with those of the document, where the document has them."""
    if dataclasses.is_dataclass(section):
        for key, value in document.items():
            _compare(getattr(section, key), value, f"{place}.{key}")
    elif isinstance(section, tuple):
        if len(section) != len(document):
            raise Broken(f"{place}: read {section!r:.200}, but it is {document!r:.200}")
        for index, pair in enumerate(zip(section, document, strict=True)):
            _compare(*pair, f"{place}[{index}]")
    elif isinstance(section, Mapping):
        if list(section) != list(document):
            raise Broken(f"{place}: read {section!r:.200}, but it is {document!r:.200}")
        for key, value in document.items():
            _compare(section[key], value, f"{place}.{key}")
    elif isinstance(document, bool) != isinstance(section, bool) or section != document:
        raise Broken(f"{place}: read {section!r}, but it is {document!r}")


def _section(name: str, kind: str) -> Callable[[random.Random], str]:
    def target(generator: random.Random) -> str:
        text = damaged(generator, _shared(name))
        path = _folder() / "file.yaml"
        path.write_text(text, encoding="utf-8")
        errors = [sentence for entry in check(path, kind) for sentence in entry.errors]
        errors = [sentence for sentence in errors if "give the path of an existing" not in sentence]
        for sentence in errors:
            _refusal(ValueError(sentence))
        if errors:
            return "refused"
        section = load_object(path) if kind == "object" else load(SECTIONS[kind], path)
        _compare(section, _independent(text), kind)
        return "accepted"

    return target


def camera_info(generator: random.Random) -> str:
    """The camera_info file of the shipped cell."""
    text = damaged(generator, _shared("camera_info.yaml"))
    path = _folder() / "camera_info.yaml"
    path.write_text(text, encoding="utf-8")
    try:
        camera = load_camera_model(path)
    except ConfigurationError as error:
        return _refusal(error)
    document = _independent(text)
    if (camera.width, camera.height) != (document["image_width"], document["image_height"]):
        raise Broken(f"the size was read as {camera.width} x {camera.height}")
    _same(camera.matrix.ravel().tolist(), [float(v) for v in document["camera_matrix"]["data"]], "")
    stated = [float(value) for value in document["distortion_coefficients"]["data"]]
    _same([float(v) for v in camera.distortion][: len(stated)], stated, "distortion")
    return "accepted"


def urdf(generator: random.Random) -> str:
    """The URDF of the six-axis arm."""
    text = damaged(generator, URDF.read_text(encoding="utf-8"))
    names = tuple(f"joint_{number}" for number in range(1, 7))
    try:
        chain = chain_from_urdf(text, "base_link", "flange", names, np.eye(4), np.eye(4))
    except ValueError as error:
        return _refusal(error)
    elements = minidom.parseString(text).getElementsByTagName("joint")
    joints = {element.getAttribute("name"): element for element in elements}
    for joint in chain.joints:
        (limit,) = joints[joint.name].getElementsByTagName("limit")[:1]
        for value, key in (
            (joint.upper, "upper"),
            (joint.lower, "lower"),
            (joint.max_speed, "velocity"),
        ):
            written = float(Decimal(limit.getAttribute(key) or "0"))
            if value != written:
                raise Broken(f"{joint.name}: {key} was read as {value}, but it is {written}")
        if max(abs(joint.lower), abs(joint.upper)) > 2.01 * math.tau:
            raise Broken(f"{joint.name}: limits of more than two turns were accepted")
    return "accepted"


def csv(generator: random.Random) -> str:
    """A record of poses with known numbers, written as any spreadsheet may write it."""
    count = generator.randint(3, 12)
    units = [generator.choice(("", "_deg", "_mrad")) for _ in range(3)] + ["_mm", "_mm"]
    scale = {"": 1.0, "_deg": math.degrees(1.0), "_mrad": 1e3, "_mm": 1e3}
    places = generator.choice((0, 1, 2, 3, 3, 4, 6))
    names = [column.name for column in RECORD_COLUMNS[:5]]
    rows = []
    for _ in range(count):
        values = [generator.uniform(-2.0, 2.0) * scale[unit] for unit in units]
        rows.append([round(value, places) for value in values])
    mark = generator.choice(".,")
    grouping = generator.choice(("", "", "", " ", "'", "," if mark == "." else "."))
    separator = generator.choice(";\t|" if grouping == "." else ",;\t|")

    def written(value: float) -> str:
        text = f"{value:,.{places}f}"
        return text.replace(",", "G").replace(".", mark).replace("G", grouping)

    def cell(text: str) -> str:
        quoted = separator in text or generator.random() < 0.05
        return f'"{text}"' if quoted else " " * generator.randrange(2) + text

    header = [name + unit for name, unit in zip(names, units, strict=True)]
    order = generator.sample(range(5), 5)
    lines = [separator.join(cell(header[k]) for k in order)]
    lines += [separator.join(cell(written(row[k])) for k in order) for row in rows]
    harmed: set[int] = set()
    for _ in range(generator.choice((0, 0, 1, 2))):
        k = generator.randrange(1, len(lines))
        harmed.add(k)
        place = generator.randrange(len(lines[k]) + 1)
        letter = generator.choice((*"\t;,|.'\" -0#e", "\u2212", "\u00a0", "nan", "mm"))
        lines[k] = lines[k][:place] + letter + lines[k][place + generator.randrange(3) :]
    before = generator.sample(("# made by a test", f"sep={separator}", ""), generator.randrange(2))
    encoding = generator.choice(("utf-8", "utf-8", "utf-8-sig", "utf-16"))
    end = generator.choice(("\n", "\r\n"))
    path = _folder() / "poses.csv"
    path.write_bytes((end.join([*before, *lines]) + end).encode(encoding))
    try:
        table = read_csv(path, RECORD_COLUMNS)
    except RecordError as error:
        return _refusal(error)
    if not harmed and len(table.rows) + len(table.faults) != count:
        raise Broken(f"{len(table.rows)} rows of {count} were read")
    for index, row in enumerate(table.rows.tolist()):
        k = row - len(before) - 1
        if k in harmed:
            continue
        for name, unit, value in zip(names, units, rows[k - 1], strict=True):
            read = table.values[name][index] * scale[unit]
            if not math.isclose(read, value, rel_tol=1e-9, abs_tol=1e-9):
                raise Broken(f"row {row}: {name}{unit} was read as {read}, but it is {value}")
    return "accepted"


MODES = ("L", "RGB", "RGBA", "LA", "P", "1", "I;16", "CMYK")
FORMS = ("PNG", "JPEG", "BMP", "TIFF", "PPM", "WEBP")


def image(generator: random.Random) -> str:
    """A small image of any mode and format, with changed or missing bytes."""
    size = generator.randint(1, 40), generator.randint(1, 40)
    noise = np.random.default_rng(generator.randrange(2**32))
    mode, form = generator.choice(MODES), generator.choice(FORMS)
    if mode == "I;16":
        picture = PIL.Image.fromarray(noise.integers(0, 1 << 12, size, dtype=np.uint16))
    else:
        picture = PIL.Image.fromarray(noise.integers(0, 256, (*size, 3), dtype=np.uint8))
        picture = picture.convert(mode)
    stream = io.BytesIO()
    try:
        picture.save(stream, form)
    except (OSError, ValueError, KeyError):
        picture.convert("L").save(stream, "PNG")
    data = bytearray(stream.getvalue())
    for _ in range(generator.choice((0, 1, 1, 3))):
        place = generator.randrange(len(data))
        if generator.random() < 0.5:
            place = generator.randrange(min(len(data), 64))
        what = generator.randrange(4)
        if what == 0:
            data[place] = generator.randrange(256)
        elif what == 1:
            del data[place:]
        elif what == 2:
            data[place:place] = generator.randbytes(generator.randint(1, 8))
        else:
            del data[place : place + generator.randint(1, 8)]
        data = data or bytearray(b"\0")
    path = _folder() / "image"
    path.write_bytes(data)
    try:
        read = read_photograph(path)
    except ImageRefused as error:
        return _refusal(error)
    if read.pixels.shape[::-1] != picture.size:
        return "read with another size"  # refused by every verb, as it is not the calibration's
    if re.match(rb"P[56]\s+\d+\s+\d+\s+(?!(255|65535)\s)", data):
        return "read without comparison"  # Pillow scales the values to the stated maximum
    _compare_image(read.pixels, read.bits, bytes(data))
    return "accepted"


def _compare_image(pixels: np.ndarray, bits: int, data: bytes) -> None:
    """Compare grey pixels with those that Pillow reads."""
    try:
        opened = PIL.Image.open(io.BytesIO(data))
        opened.draft("L", opened.size)  # JPEG: without a conversion from its own grey to RGB
        opened.load()
    except Exception as error:
        raise Broken(f"Pillow refuses the image: {error!s:.200}") from error
    if opened.mode.startswith("I"):
        expected = np.minimum(np.asarray(opened).astype(int) >> (bits - 8), 255)
    elif "transparency" in opened.info or opened.mode in ("RGBA", "LA", "PA"):
        expected = np.asarray(opened.convert("RGBA").convert("RGB").convert("L")).astype(int)
    else:
        expected = np.asarray(opened.convert("RGB").convert("L")).astype(int)
    if pixels.shape != expected.shape:
        raise Broken(f"{opened.format} {opened.mode}: {pixels.shape} was read of {expected.shape}")
    # The decoders of WebP and the conversions of CMYK round differently.
    most = 12 if opened.format == "WEBP" else 40 if opened.mode == "CMYK" else 2
    apart = np.abs(pixels - expected)
    if apart.max() > most:
        raise Broken(f"{opened.format} {opened.mode}: pixels differ by up to {apart.max()}")


@functools.cache
def _bag() -> bytes:
    """Return the bag of a run, in chunks of a few messages."""
    run = MadeRun([Pose(0.1, 0.02, 0.3), Pose(0.06, 0.01, 0.4), Pose(0.0302, 0.0101, 0.402)])
    made = read_bag(run.write(_folder() / "run") / "bag")
    with BagWriter(_folder() / "bag", TYPES) as bag:
        for topic in made.topics:
            bag.add_topic(topic.name, topic.kind)
        for number, message in enumerate(made.messages):
            bag.write(message.topic.name, message.stamp, message.data)
            if number % 4 == 3:
                bag.flush()
    return (_folder() / "bag" / "bag.mcap").read_bytes()


def _mcap_records(data: bytes) -> tuple[list[bytes], bytes]:
    """Return the records of a bag up to the end of its data, and the rest of the file."""
    records, place = [], 8
    while data[place] != DATA_END:
        (length,) = struct.unpack_from("<Q", data, place + 1)
        records.append(data[place : place + 9 + length])
        place += 9 + length
    return records, data[place:]


def mcap(generator: random.Random) -> str:
    """The bag of a run, with lost, repeated and exchanged records and changed bytes."""
    data = _bag()
    records, summary = _mcap_records(data)
    # Two such damages can cancel out: a chunk lost, and another of the same size repeated.
    for _ in range(generator.choice((0, 1))):
        k, other = generator.randrange(len(records)), generator.randrange(len(records))
        what = generator.randrange(4)
        if what == 0:
            del records[k]
        elif what == 1:
            records.insert(k, records[other])
        elif what == 2:
            records[k], records[other] = records[other], records[k]
        else:
            # rosbags writes no checksum of the messages in a chunk, which begin at byte 49
            changed = bytearray(records[k])
            for _ in range(generator.randint(1, 3)):
                changed[generator.randrange(min(len(changed), 49))] = generator.randrange(256)
            records[k] = bytes(changed)
    made = bytearray(data[:8] + b"".join(records) + summary)
    if generator.random() < 0.3:
        del made[generator.randrange(len(made)) :]
    path = _folder() / "bag.mcap"
    path.write_bytes(made)
    try:
        bag = read_bag(path)
        run = illustrated_run(bag, "run")
    except BagError as error:
        return _refusal(error)
    read = Counter((m.topic.name, m.stamp, m.data) for m in bag.messages)
    if set(read) - set(_bag_messages()):
        raise Broken("messages were read that were not recorded")
    if bag.whole and read != _bag_messages():
        raise Broken("messages are missing or repeated without a word")
    if bag.whole and run.run.outcome != "reached":
        raise Broken(f"the outcome is {run.run.outcome}")
    return "accepted" if bag.whole else "read in part"


@functools.cache
def _bag_messages() -> Counter[tuple[str, int, bytes]]:
    """Return the messages of the bag as rosbags reads them."""
    _bag()
    with AnyReader([_folder() / "bag"]) as reader:
        return Counter((c.topic, stamp, bytes(data)) for c, stamp, data in reader.messages())


TARGETS: dict[str, Callable[[random.Random], str]] = {
    "yaml": yaml,
    "csv": csv,
    "camera_info": camera_info,
    "urdf": urdf,
    "object": _section("objects/aluminium_square.yaml", "object"),
    "table": _section("table.yaml", "table"),
    "cell": _section("cell.yaml", "cell"),
    "image": image,
    "mcap": mcap,
}
"""The readers by name. Each makes a file, reads it, and returns the outcome."""


def outcome_of(name: str, seed: int) -> str:
    """Damage one file and read it. Return the outcome.

    Raises:
        Broken: the reader accepted the file with a wrong value, or its message is no sentence.
    """
    try:
        return TARGETS[name](random.Random(seed))
    except NoComparison:
        return "accepted without comparison"


def main() -> int:
    """Damage ``--count`` files for each reader. Return 1 if a reader failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("readers", nargs="*", choices=[*TARGETS, []], default=[])
    parser.add_argument("--count", type=int, default=100_000, help="files a reader")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    failed = False
    for name in arguments.readers or TARGETS:
        outcomes: Counter[str] = Counter()
        longest = 0.0
        for number in range(arguments.seed, arguments.seed + arguments.count):
            began = time.process_time()
            try:
                outcome = outcome_of(name, number)
            except Exception as error:
                outcome = "FAILED"
                if outcomes[outcome] < 10:
                    frame = traceback.extract_tb(error.__traceback__)[-1]
                    kind = type(error).__name__
                    print(f"{name} {number}: {kind} ({frame.name}) {error}"[:600], flush=True)
            outcomes[outcome] += 1
            longest = max(longest, time.process_time() - began)
        failed |= bool(outcomes["FAILED"])
        counts = ", ".join(f"{count} {word}" for word, count in sorted(outcomes.items()) if count)
        print(f"{name}: {counts}; longest {longest:.2f} s of processor time", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
