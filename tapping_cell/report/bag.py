"""Bags: what went over a cell's topics, as a rosbag2 folder with one MCAP file.

``ros2 bag info``, ``ros2 bag play`` and Foxglove open it as it is: messages as CDR bytes, every
definition included, and the quality of service of each topic, so that a latched topic is played
latched.

A bag is written in pieces (MCAP's chunks), each of which is whole in the file once :meth:`flush`
returns. A writer that is killed leaves every piece that was flushed, without the index at the end:
:func:`read_bag` reads such a file too, and :func:`recover` (or ``mcap recover``) makes it whole.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import McapWriter, decompress
from rosbags.serde.errors import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from tapping_cell.report.message_types import MessageTypes

_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 1, 2, 3, 4, 5, 6, 15
"""Kinds of records in an MCAP file: https://mcap.dev/spec."""
_DAMAGED = (KeyError, struct.error, UnicodeDecodeError, ReaderError)
"""What wrong bytes in a file lead to."""
_FOREVER = QosTime(9223372036, 854775807)
"""What rosbag2 writes for a deadline, lifespan or lease that never ends."""


class BagError(ValueError):
    """A bag that cannot be read or written; the sentence says which, why, and what to do."""


@dataclass(frozen=True, slots=True)
class Quality:
    """Quality of service of a topic's publisher."""

    depth: int = 10
    reliable: bool = True
    latched: bool = False


DEFAULT = Quality()
"""Reliable, not latched: rclpy's default."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag. ``kind`` is its message type, such as ``geometry_msgs/msg/Pose``."""

    name: str
    kind: str


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a bag: its topic, when it was heard (ns since 1970) and its CDR bytes."""

    topic: Topic
    stamp: int
    data: bytes


class BagWriter:
    """A bag under way; use as a context manager, or end it with :meth:`close`."""

    def __init__(
        self,
        folder: Path,
        types: MessageTypes | None = None,
        notes: Mapping[str, str] | None = None,
    ) -> None:
        """Begin ``folder``, which must not exist; ``notes`` stay readable in its metadata.

        Raises:
            BagError: the folder exists or cannot be made.
        """
        if folder.exists():
            raise BagError(f"{folder} exists already and is not overwritten; choose another folder")
        self.folder = folder
        self._types = types or MessageTypes()
        self._topics: dict[str, Connection] = {}
        self._fresh = 0
        self._writer = Writer(folder, version=Writer.VERSION_LATEST, storage_plugin=_MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        for key, value in (notes or {}).items():
            self._writer.set_custom_data(key, value)
        try:
            self._writer.open()
        except OSError as error:
            raise BagError(f"{folder} cannot be written ({error.strerror})") from error

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Bytes in the file so far."""
        return self._storage.bio.tell() + self._storage.chunk.bio.tell()

    @property
    def _storage(self) -> McapWriter:
        storage = self._writer.storage
        if not isinstance(storage, McapWriter):
            raise BagError(f"{self.folder} is closed; begin another bag")
        return storage

    def add_topic(self, name: str, kind: str, quality: Quality = DEFAULT) -> None:
        """Make a topic known before its first message.

        Raises:
            tapping_cell.report.message_types.UnknownMessageType: no definition of ``kind``.
            BagError: the topic is known already.
        """
        if name in self._topics:
            raise BagError(f"the topic {name} is in {self.folder} already")
        text, fingerprint = self._types.definition(kind)
        self._topics[name] = self._writer.add_connection(
            name, kind, msgdef=text, rihs01=fingerprint, offered_qos_profiles=(_profile(quality),)
        )

    def write(self, name: str, stamp: int, data: bytes) -> None:
        """Write one message as CDR bytes; ``stamp`` is when it was heard, in ns since 1970.

        Raises:
            BagError: the topic was not added.
            OSError: the disk is full or away.
        """
        topic = self._topics.get(name)
        if topic is None:
            raise BagError(
                f"the topic {name} was not added to {self.folder}; add_topic comes first"
            )
        self._storage  # noqa: B018 - says so where the bag is closed
        self._writer.write(topic, stamp, data)
        self._fresh += 1

    def flush(self) -> None:
        """Hand all that was written to the operating system as a whole piece of the file.

        It outlives a crash of this process. Not synchronised with the disk: that takes too long
        beside a moving arm, and a power cut may take the last seconds.

        Raises:
            OSError: the disk is full or away.
        """
        if self._fresh:
            self._storage.close_chunk()
            self._storage.bio.flush()
            self._fresh = 0

    def close(self) -> None:
        """Write index and metadata; a bag that is closed twice stays as it is.

        Raises:
            OSError: the disk is full or away; the pieces flushed before stay readable.
        """
        if self._writer.storage is None:
            return
        try:
            self._writer.close()
        except OSError:
            self._writer.abort()
            raise
        _synchronise(self.folder / f"{self.folder.name}.mcap")


@dataclass(frozen=True, slots=True)
class Bag:
    """A bag that was read. ``whole`` is False where its writer was killed before the end."""

    path: Path
    messages: tuple[Recorded, ...]
    whole: bool
    _store: Typestore

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics that have messages, by name."""
        return tuple(sorted({m.topic for m in self.messages}, key=lambda topic: topic.name))

    def of(self, name: str) -> Iterator[tuple[int, Any]]:
        """Stamps and decoded messages of a topic, whatever the namespace before its name.

        A decoded message has the fields of its definition as attributes.
        """
        for message in self.messages:
            if message.topic.name == name or message.topic.name.endswith("/" + name.lstrip("/")):
                yield message.stamp, self.decode(message)

    def decode(self, message: Recorded) -> Any:
        """The message with the fields of its definition as attributes.

        Raises:
            BagError: the bytes are not those of such a message.
        """
        try:
            return self._store.deserialize_cdr(message.data, message.topic.kind)
        except (SerdeError, KeyError, struct.error, ValueError, IndexError) as error:
            topic = message.topic
            raise BagError(
                f"{self.path}: a message of {topic.name} is no {topic.kind}: {error}"
            ) from error


def bag_file(path: Path) -> Path:
    """The MCAP file of a bag's folder, or ``path`` itself where it is one.

    Raises:
        BagError: there is none, or more than one.
    """
    if path.is_file():
        return path
    files = sorted(path.glob("*.mcap"))
    if len(files) != 1:
        found = f"{len(files)} of them" if files else "none"
        raise BagError(f"{path} must be an .mcap file, or a folder with one; there is {found}")
    return files[0]


def read_bag(path: Path) -> Bag:
    """A bag in order of time, from its folder or file, also where its writer was killed.

    Raises:
        BagError: no bag of ROS 2, or one that is damaged before its first message.
    """
    file = bag_file(path)
    schemas: dict[int, tuple[str, str, str]] = {}
    channels: dict[int, Topic] = {}
    messages: list[Recorded] = []
    whole = False
    try:
        with file.open("rb") as stream:
            for kind, body in _records(stream, file):
                if kind == _SCHEMA:
                    key, rest = struct.unpack_from("<H", body)[0], 2
                    name, rest = _text(body, rest)
                    form, rest = _text(body, rest)
                    schemas[key] = (name, form, _text(body, rest)[0])
                elif kind == _CHANNEL:
                    key, schema = struct.unpack_from("<HH", body)
                    channels[key] = Topic(_text(body, 4)[0], schemas[schema][0])
                elif kind == _MESSAGE:
                    key, _, stamp = struct.unpack_from("<HIQ", body)
                    messages.append(Recorded(channels[key], stamp, bytes(body[22:])))
                elif kind == _FOOTER:
                    whole = True
    except OSError as error:
        raise BagError(f"{file} cannot be read ({error.strerror})") from error
    except _DAMAGED as error:
        if not messages:
            raise BagError(f"{file} is damaged: {error}") from error
    messages.sort(key=lambda message: message.stamp)
    return Bag(file, tuple(messages), whole, _store_of(schemas, file))


def recover(path: Path, target: Path) -> Bag:
    """Write all that can be read of a bag into the new folder ``target``, with index and metadata.

    Raises:
        BagError: nothing can be read, or the target exists.
    """
    bag = read_bag(path)
    types = MessageTypes(bag._store)
    with BagWriter(target, types, {"recovered from": str(bag.path)}) as writer:
        for topic in bag.topics:
            writer.add_topic(topic.name, topic.kind)
        for message in bag.messages:
            writer.write(message.topic.name, message.stamp, message.data)
    return read_bag(target)


_MCAP = StoragePlugin.MCAP


def _profile(quality: Quality) -> Qos:
    return Qos(
        QosHistory.KEEP_LAST,
        quality.depth,
        QosReliability.RELIABLE if quality.reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if quality.latched else QosDurability.VOLATILE,
        _FOREVER,
        _FOREVER,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        False,
    )


def _synchronise(file: Path) -> None:
    with file.open("rb") as stream:
        os.fsync(stream.fileno())


def _records(stream: BinaryIO, file: Path) -> Iterator[tuple[int, memoryview]]:
    """The records of an MCAP file up to its data's end, those in chunks too, and the footer.

    A record that is cut off ends them: what comes before it is whole.
    """
    if stream.read(8) != _MAGIC:
        raise BagError(f"{file} is no MCAP file")
    size = os.fstat(stream.fileno()).st_size
    while len(head := stream.read(9)) == 9:
        kind, length = struct.unpack("<BQ", head)
        if length > size - stream.tell():
            return
        body = memoryview(stream.read(length))
        if kind == _HEADER and _text(body, 0)[0] not in ("ros2", ""):
            raise BagError(f"{file} is a bag of '{_text(body, 0)[0]}', not of ROS 2")
        if kind == _CHUNK:
            yield from _in_chunk(body)
        elif kind in (_SCHEMA, _CHANNEL, _MESSAGE):
            yield kind, body
        elif kind == _DATA_END:
            # What follows repeats the above for those who seek; the footer stands before the end.
            stream.seek(-37, os.SEEK_END)
            tail = stream.read()
            if tail[:1] == bytes([_FOOTER]) and tail.endswith(_MAGIC):
                yield _FOOTER, memoryview(b"")
            return


def _in_chunk(body: memoryview) -> Iterator[tuple[int, memoryview]]:
    size, checksum = struct.unpack_from("<QI", body, 16)
    compression, start = _text(body, 28)
    (length,) = struct.unpack_from("<Q", body, start)
    packed = bytes(body[start + 8 : start + 8 + length])
    try:
        records = memoryview(decompress(packed, compression, size, checksum))
    except Exception as error:  # each codec has classes of its own
        raise ReaderError(f"a piece cannot be unpacked: {error}") from error
    place = 0
    while place < len(records):
        kind, length = struct.unpack_from("<BQ", records, place)
        yield kind, records[place + 9 : place + 9 + length]
        place += 9 + length


def _text(body: memoryview, start: int) -> tuple[str, int]:
    """A text with its length before it, and where it ends."""
    (length,) = struct.unpack_from("<I", body, start)
    end = start + 4 + length
    return bytes(body[start + 4 : end]).decode(), end


def _store_of(schemas: Mapping[int, tuple[str, str, str]], file: Path) -> Typestore:
    """The types as the bag itself defines them: they may be older than the installed ones."""
    store = get_typestore(Stores.EMPTY)
    for name, form, text in schemas.values():
        try:
            types = get_types_from_idl(text) if "idl" in form else get_types_from_msg(text, name)
            store.register(types)
        except (TypesysError, KeyError, ValueError, SyntaxError) as error:
            raise BagError(f"{file}: the definition of {name} cannot be read: {error}") from error
    return store
