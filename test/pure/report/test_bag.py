"""Bags can be read by ROS's own tools, and remain readable if the recorder is killed."""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from ament_index_python.packages import get_package_share_directory
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("mcap", reason="mcap is not installed; it has no Debian package")
pytest.importorskip("rosbags", reason="rosbags is not installed; it has no Debian package")

from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from tapping_cell.report.bag import BagWriter, bag_file, read_bag, recover
from tapping_cell.report.message_files import UnknownMessageType
from tapping_cell.report.message_types import MessageTypes
from tapping_cell.report.recorded import BagError, Quality

STORE = get_typestore(Stores.ROS2_JAZZY)
MESSAGES = Path(__file__).resolve().parents[3] / "msg_defs" / "msg"
TEXT = "std_msgs/msg/String"


def text(value: str) -> bytes:
    return bytes(STORE.serialize_cdr(STORE.types[TEXT](value), TEXT))


def write(folder: Path, count: int = 50) -> None:
    with BagWriter(folder, notes={"goal": "x"}) as bag:
        bag.add_topic("/cell/words", TEXT, Quality(depth=1, latched=True))
        bag.add_topic("/cell/picture", "sensor_msgs/msg/CompressedImage", Quality(reliable=False))
        for number in range(count):
            bag.write("/cell/words", 10 + number, text(f"word {number}"))
            if number % 10 == 5:
                bag.flush()


def test_the_mcap_library_reads_messages_definitions_and_profile(tmp_path: Path) -> None:
    write(tmp_path / "bag")
    with bag_file(tmp_path / "bag").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        found = list(reader.iter_messages())
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == 50
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert {schema.name for schema in summary.schemas.values()} == {
        TEXT,
        "sensor_msgs/msg/CompressedImage",
    }
    schema, channel, message = found[7]
    assert (schema.name, channel.topic, channel.message_encoding) == (TEXT, "/cell/words", "cdr")
    assert (message.log_time, message.data) == (17, text("word 7"))
    picture = next(s for s in summary.schemas.values() if "Image" in s.name)
    assert b"MSG: std_msgs/Header" in picture.data
    assert b"MSG: builtin_interfaces/Time" in picture.data


def test_the_metadata_matches_rosbag2_and_a_latched_topic_is_played_latched(tmp_path: Path) -> None:
    write(tmp_path / "bag")
    content = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    content = content["rosbag2_bagfile_information"]
    assert content["storage_identifier"] == "mcap" and content["message_count"] == 50
    assert content["relative_file_paths"] == ["bag.mcap"]
    assert content["custom_data"] == {"goal": "x"}
    topics = {e["topic_metadata"]["name"]: e for e in content["topics_with_message_count"]}
    (latched,) = topics["/cell/words"]["topic_metadata"]["offered_qos_profiles"]
    assert (latched["durability"], latched["reliability"], latched["depth"]) == (
        "transient_local",
        "reliable",
        1,
    )
    (sensor,) = topics["/cell/picture"]["topic_metadata"]["offered_qos_profiles"]
    assert (sensor["durability"], sensor["reliability"]) == ("volatile", "best_effort")


@given(
    messages=st.lists(
        st.tuples(st.sampled_from("abc"), st.integers(1, 2**40), st.text(max_size=30)), max_size=40
    ),
    flush_every=st.integers(1, 10),
)
def test_written_bags_are_read_identically_by_our_reader_and_by_rosbags(
    messages, flush_every, tmp_path_factory
):
    folder = tmp_path_factory.mktemp("bag") / "bag"
    with BagWriter(folder) as bag:
        for name in "abc":
            bag.add_topic(f"/{name}", TEXT)
        for index, (name, stamp, words) in enumerate(messages):
            bag.write(f"/{name}", stamp, text(words))
            if index % flush_every == 0:
                bag.flush()
    ours = read_bag(folder)
    assert ours.whole
    with Reader(folder) as reader:
        theirs = sorted((stamp, c.topic, bytes(data)) for c, stamp, data in reader.messages())
    assert sorted((m.stamp, m.topic.name, m.data) for m in ours.messages) == theirs
    assert [m.stamp for m in ours.messages] == sorted(stamp for _, stamp, _ in messages)


def own_types() -> list[str]:
    return sorted(f"tapping_cell_msgs/msg/{file.stem}" for file in MESSAGES.glob("*.msg"))


@pytest.mark.parametrize("kind", own_types())
def test_our_messages_can_be_read_without_the_package(kind: str, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/state", kind)
        bag.write("/state", 5, b"\x00\x01\x00\x00" + bytes(100))
    with AnyReader([tmp_path / "bag"]) as reader:
        ((connection, _, raw),) = reader.messages()
        assert (connection.msgtype, bytes(raw[4:])) == (kind, bytes(100))
        names = [name for name, _ in reader.typestore.fielddefs[kind][1]]
    for name in names:
        source = (MESSAGES / f"{kind.rsplit('/', 1)[1]}.msg").read_text()
        assert name == "structure_needs_at_least_one_member" or f" {name} " in source


def test_a_definition_contains_its_constants_and_dependencies() -> None:
    definition, fingerprint = MessageTypes().definition("tapping_cell_msgs/msg/PlanState")
    assert "uint8 REACHED=7" in definition and "MSG: tapping_cell_msgs/TapRecord" in definition
    assert fingerprint.startswith("RIHS01_")


def test_the_type_hash_matches_that_of_the_build() -> None:
    try:
        folder = Path(get_package_share_directory("tapping_cell_msgs"))
    except (LookupError, OSError, ValueError):
        pytest.skip("the messages are not built here")
    for file in (folder / "msg").glob("*.json"):
        hashes = {
            e["type_name"]: e["hash_string"] for e in json.loads(file.read_text())["type_hashes"]
        }
        kind = f"tapping_cell_msgs/msg/{file.stem}"
        assert MessageTypes().definition(kind)[1] == hashes[kind]


def _write_for_ever(folder: Path, flushed: int, ready: multiprocessing.synchronize.Event) -> None:
    bag = BagWriter(folder)
    bag.add_topic("/words", TEXT)
    for number in range(flushed):
        bag.write("/words", 1 + number, text(f"word {number}"))
        if number % 7 == 0:
            bag.flush()
    bag.flush()
    bag.write("/words", 10_000, text("not flushed"))
    ready.set()
    signal.pause()


def test_a_killed_writer_leaves_all_flushed_messages(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    process = context.Process(target=_write_for_ever, args=(tmp_path / "bag", 40, ready))
    process.start()
    assert ready.wait(60)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join(10)
    bag = read_bag(tmp_path / "bag")
    assert not bag.whole
    assert [message.stamp for message in bag.messages] == list(range(1, 41))
    # The MCAP library reads the same records.
    stream = StreamReader(io.BytesIO(bag_file(tmp_path / "bag").read_bytes()))
    found = []
    with pytest.raises(Exception):  # noqa: B017 - the exception raised at the cut is not specified
        for record in stream.records:
            found.append(type(record).__name__)
    assert found.count("Message") == 40
    mended = recover(tmp_path / "bag", tmp_path / "mended")
    assert mended.whole and len(mended.messages) == 40
    with Reader(tmp_path / "mended") as reader:
        assert reader.message_count == 40


def test_a_bag_that_lacks_a_part_is_not_whole(tmp_path: Path) -> None:
    """A renamed file is no missing part."""
    write(tmp_path / "bag")
    bag_file(tmp_path / "bag").rename(tmp_path / "bag" / "other.mcap")
    assert read_bag(tmp_path / "bag").whole
    metadata = tmp_path / "bag" / "metadata.yaml"
    text = metadata.read_text()
    assert "  - bag.mcap\n" in text
    metadata.write_text(text.replace("  - bag.mcap\n", "  - other.mcap\n  - bag_1.mcap\n"))
    assert "lacks bag_1.mcap of the 2 files" in read_bag(tmp_path / "bag").missing


@given(share=st.floats(0.0, 1.0))
def test_a_truncated_bag_gives_the_messages_before_the_cut_or_an_error(share, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cut")
    write(folder / "bag")
    data = bag_file(folder / "bag").read_bytes()
    (folder / "cut.mcap").write_bytes(data[: int(share * (len(data) - 1))])
    try:
        bag = read_bag(folder / "cut.mcap")
    except BagError as error:
        assert "cut.mcap" in str(error)
        return
    assert not bag.whole
    stamps = [message.stamp for message in bag.messages]
    assert stamps == list(range(10, 10 + len(stamps)))


@given(seed=st.integers(0, 2**32))
def test_a_bag_with_corrupt_bytes_is_read_or_refused_with_a_message(seed, tmp_path_factory):
    folder = tmp_path_factory.mktemp("wrong")
    write(folder / "bag")
    data = bytearray(bag_file(folder / "bag").read_bytes())
    chance = random.Random(seed)
    for _ in range(5):
        data[chance.randrange(len(data))] = chance.randrange(256)
    (folder / "wrong.mcap").write_bytes(data)
    try:
        for message in (bag := read_bag(folder / "wrong.mcap")).messages:
            bag.decode(message)
    except BagError as error:
        assert "wrong.mcap" in str(error)


def test_a_bag_is_never_overwritten(tmp_path: Path) -> None:
    write(tmp_path / "bag")
    with pytest.raises(BagError, match="not overwritten"):
        BagWriter(tmp_path / "bag")


def test_a_closed_bag_survives_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synchronised: set[str] = set()

    def fsync(descriptor: int) -> None:
        synchronised.add(os.readlink(f"/proc/self/fd/{descriptor}"))

    monkeypatch.setattr(os, "fsync", fsync)
    folder = tmp_path / "bag"
    with BagWriter(folder) as bag:
        bag.add_topic("/x", TEXT)
        bag.write("/x", 1, text("hello"))
    assert synchronised == {str(folder), *(str(file) for file in folder.iterdir())}


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("String", "package/msg/Name"),
        ("no_such_msgs/msg/Thing", "no_such_msgs is not installed"),
        ("tapping_cell_msgs/msg/Nothing", "there is no"),
    ],
)
def test_an_unknown_type_is_refused_with_a_message(kind: str, words: str, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag, pytest.raises(UnknownMessageType, match=words):
        bag.add_topic("/x", kind)


def test_a_message_of_an_unknown_topic_or_a_closed_bag_is_refused(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "bag")
    with pytest.raises(BagError, match="add_topic"):
        bag.write("/x", 1, b"")
    bag.add_topic("/x", TEXT)
    bag.close()
    bag.close()
    with pytest.raises(BagError, match="closed"):
        bag.write("/x", 1, b"")


def test_a_file_that_is_not_a_bag_is_refused_with_a_message(tmp_path: Path) -> None:
    for name, content in (("a.mcap", b"hello"), ("b.mcap", b""), ("c.mcap", b"\x89MCAP0\r\n")):
        (tmp_path / name).write_bytes(content)
    with pytest.raises(BagError, match="not an MCAP"):
        read_bag(tmp_path / "a.mcap")
    with pytest.raises(BagError, match="is empty"):
        read_bag(tmp_path / "b.mcap")
    assert read_bag(tmp_path / "c.mcap").messages == ()
    with pytest.raises(BagError, match="found 3"):
        read_bag(tmp_path)


@pytest.mark.parametrize("line", ["from rosbags.nothing import x", "raise AttributeError('bool')"])
def test_a_damaged_rosbags_is_named(line: str, tmp_path: Path) -> None:
    (tmp_path / "rosbags").mkdir()
    (tmp_path / "rosbags" / "__init__.py").write_text(line)
    (tmp_path / "a.mcap").touch()
    command = [sys.executable, "-m", "tapping_cell", "report", str(tmp_path / "a.mcap")]
    places = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": places}
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert result.returncode == 2
    assert "rosbags is missing or damaged" in result.stderr and "Traceback" not in result.stderr
