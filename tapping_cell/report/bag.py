"""Bags: recordings of a cell's topics as a rosbag2 folder with one MCAP file.

``ros2 bag info``, ``ros2 bag play`` and Foxglove can open a bag. A bag contains messages as CDR
bytes, all message definitions, and the quality of service of each topic. A transient local topic is
therefore played back as transient local.

A bag is written in MCAP chunks. Each chunk is complete in the file once :meth:`flush` returns. If
the writer is killed, the file contains all flushed chunks but no index. :func:`read_bag` can read
such a file, and :func:`recover` (or ``mcap recover``) repairs it.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, BinaryIO

from tapping_cell.configuration.schema import ConfigurationError, read_yaml
from tapping_cell.durable_file import sync_folder
from tapping_cell.report.message_types import MessageTypes
from tapping_cell.report.recorded import (
    DEFAULT,
    Bag,
    BagError,
    Quality,
    Recorded,
    Topic,
    needing_rosbags,
)

with needing_rosbags():
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
    from rosbags.rosbag2.storage_mcap import (  # type: ignore[attr-defined]
        McapWriter,
        decompress,
        zstd,
    )
    from rosbags.serde.errors import SerdeError
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    from rosbags.typesys.base import TypesysError
    from rosbags.typesys.store import Typestore

_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 1, 2, 3, 4, 5, 6
_STATISTICS, _DATA_END = 11, 15
"""Record types of an MCAP file: https://mcap.dev/spec."""
_DAMAGED = (KeyError, struct.error, UnicodeDecodeError, ReaderError)
"""Exceptions that can occur while a damaged file is read."""
_FOREVER = QosTime(9223372036, 854775807)
"""Value that rosbag2 writes for an infinite deadline, lifespan or lease."""


class BagWriter:
    """Writer of a bag; use it as a context manager, or call :meth:`close` at the end."""

    def __init__(
        self,
        folder: Path,
        types: MessageTypes | None = None,
        notes: Mapping[str, str] | None = None,
    ) -> None:
        """Create the bag in ``folder``, which must not exist; ``notes`` are stored as metadata.

        Raises:
            BagError: the folder exists or cannot be created.
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
        # rosbags writes no checksums of chunks, and a changed byte can decompress without an error.
        options = {int(zstd.CompressionParameter.checksum_flag): 1}
        self._storage.compressor = lambda data: zstd.compress(data, options=options)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Current size of the file in bytes."""
        return self._storage.bio.tell() + self._storage.chunk.bio.tell()

    @property
    def _storage(self) -> McapWriter:
        storage = self._writer.storage
        if not isinstance(storage, McapWriter):
            raise BagError(f"{self.folder} is closed; begin another bag")
        return storage

    def add_topic(self, name: str, kind: str, quality: Quality = DEFAULT) -> None:
        """Add a topic before its first message.

        Raises:
            tapping_cell.report.message_files.UnknownMessageType: ``kind`` has no definition.
            BagError: the topic was already added.
        """
        if name in self._topics:
            raise BagError(f"the topic {name} was already added to {self.folder}")
        text, fingerprint = self._types.definition(kind)
        self._topics[name] = self._writer.add_connection(
            name, kind, msgdef=text, rihs01=fingerprint, offered_qos_profiles=(_profile(quality),)
        )

    def write(self, name: str, stamp: int, data: bytes) -> None:
        """Write one message as CDR bytes; ``stamp`` is its time of reception, in ns since 1970.

        Raises:
            BagError: the topic was not added.
            OSError: the disk is full or not available.
        """
        topic = self._topics.get(name)
        if topic is None:
            raise BagError(f"the topic {name} was not added to {self.folder}; call add_topic first")
        self._storage  # noqa: B018 - raises BagError if the bag is closed
        self._writer.write(topic, stamp, data)
        self._fresh += 1

    def flush(self) -> None:
        """Pass all written messages to the operating system as a complete chunk of the file.

        The chunk survives a crash of this process. The chunk is not synchronised with the disk,
        because synchronisation would take too long while the arm moves. A power cut may therefore
        lose the last seconds.

        Raises:
            OSError: the disk is full or not available.
        """
        if self._fresh:
            self._storage.close_chunk()
            self._storage.bio.flush()
            self._fresh = 0

    def close(self) -> None:
        """Write index and metadata; closing a bag again has no effect.

        Raises:
            OSError: the disk is full or not available; chunks flushed earlier remain readable.
        """
        if self._writer.storage is None:
            return
        try:
            self._writer.close()
        except OSError:
            self._writer.abort()
            raise
        # A power cut would otherwise leave a bag without its end, or with empty metadata.
        for name in (f"{self.folder.name}.mcap", "metadata.yaml"):
            _synchronise(self.folder / name)
        sync_folder(self.folder)


def other_format(path: Path) -> str:
    """Return what to do with a bag that is compressed as a file or has another format than MCAP;
    empty for other files."""
    compressed = f"{path} is compressed as a file; decompress it with `zstd -d {path}`"
    return {
        ".zst": compressed,
        ".zstd": compressed,
        ".db3": f"{path} is a bag in SQLite; convert it to mcap with `ros2 bag convert`",
        ".bag": f"{path} is a bag of ROS 1; convert it to ROS 2 with `rosbags-convert`, and to "
        "mcap with `ros2 bag convert`",
    }.get(path.suffix, "")


def bag_file(path: Path) -> Path:
    """Return the MCAP file in a bag's folder, or ``path`` itself if it is a file.

    Raises:
        BagError: there is no such path, no MCAP file, or more than one.
    """
    if path.is_file():
        return path
    if not path.exists():
        raise BagError(f"{path} does not exist; check the name")
    files = sorted(path.glob("*.mcap"))
    if not files and (remedy := next(filter(None, map(other_format, sorted(path.iterdir()))), "")):
        raise BagError(remedy)
    if len(files) != 1:
        remedy = "give one of them, or join the parts of one run with `ros2 bag convert`"
        found = f"{len(files)}; {remedy}" if files else "none"
        raise BagError(f"{path} must be an .mcap file, or a folder with exactly one; found {found}")
    return files[0]


def read_bag(path: Path) -> Bag:
    """Read a bag from its folder or file in order of time, even if its writer was killed.

    Raises:
        BagError: ``path`` is not a ROS 2 bag, or the bag is damaged before its first message.
    """
    bag, _ = _read(path)
    return bag


def _read(path: Path) -> tuple[Bag, Typestore]:
    """Return a bag and its message types; raise the exceptions of `read_bag`."""
    file = bag_file(path)
    schemas: dict[int, tuple[str, str, str]] = {}
    channels: dict[int, Topic] = {}
    messages: list[Recorded] = []
    missing = f"the end of {file} is missing; it is cut off or still being written"
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
                elif kind == _STATISTICS:
                    (written,) = struct.unpack_from("<Q", body)
                    count, missing = len(messages), ""
                    if count < written:
                        missing = f"{file} lacks {written - count} of its {written} messages"
                    elif count > written > 0:
                        missing = f"{file} has {count} messages, but states {written}; some may "
                        missing += "be there twice"
    except OSError as error:
        raise BagError(f"{file} cannot be read ({error.strerror})") from error
    except _DAMAGED as error:
        if not messages:
            raise BagError(f"{file} is damaged: {error}") from error
        missing = f"{file} is damaged after {len(messages)} messages: {error}"
    messages.sort(key=lambda message: message.stamp)
    missing = missing or _missing_parts(path)
    try:
        store = _store_of(frozenset(schemas.values()))
    except BagError as error:
        raise BagError(f"{file}: {error}") from error
    return Bag(file, tuple(messages), missing, partial(_decode, store)), store


def _decode(store: Typestore, data: bytes, kind: str) -> Any:
    try:
        return store.deserialize_cdr(data, kind)
    except (SerdeError, KeyError, struct.error, IndexError) as error:
        raise ValueError(str(error)) from error


def _missing_parts(path: Path) -> str:
    """Return a sentence if a bag's folder has fewer files than its metadata lists; empty otherwise.
    A single file may have another name than the metadata state."""
    try:
        bag = read_yaml(path / "metadata.yaml")["rosbag2_bagfile_information"]
        listed = list(bag["relative_file_paths"])
    except (ConfigurationError, KeyError, TypeError):
        return ""
    found = {file.name for file in path.iterdir()}
    lacking = [str(name) for name in listed if Path(str(name)).name not in found]
    if len(listed) == 1 or not lacking:
        return ""
    return f"{path} lacks {', '.join(lacking)} of the {len(listed)} files in its metadata.yaml"


def first_topics(file: Path) -> set[str]:
    """Return the names of the topics that an MCAP file states before its first message. The set is
    empty if there is no such file, or if its start is damaged."""
    names: set[str] = set()
    with contextlib.suppress(OSError, BagError, *_DAMAGED), file.open("rb") as stream:
        for kind, body in _records(stream, file):
            if kind == _MESSAGE:
                break
            if kind == _CHANNEL:
                names.add(_text(body, 4)[0])
    return names


def recover(path: Path, target: Path) -> Bag:
    """Copy the readable part of a bag to the new folder ``target``, with index and metadata.

    Raises:
        BagError: nothing can be read, or the target exists.
    """
    bag, store = _read(path)
    with BagWriter(target, MessageTypes(store), {"recovered from": str(bag.path)}) as writer:
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
    """Yield the records of an MCAP file, including those in chunks, up to the end of its data.

    The statistics are yielded last, if the file has its end. A truncated record ends the iteration;
    all records before it are complete.
    """
    start = stream.read(8)
    if not start:
        raise BagError(f"{file} is empty: its recorder ended before it had written a message")
    if start != _MAGIC:
        pointer = "; get the content of this pointer of git LFS with `git lfs pull`"
        raise BagError(f"{file} is not an MCAP file{pointer if start == b'version ' else ''}")
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
            # Of the summary section, which repeats earlier records for random access, only the
            # statistics are needed.
            rest = stream.read()
            if rest[-37:-36] == bytes([_FOOTER]) and rest.endswith(_MAGIC):
                yield _STATISTICS, _statistics(rest)
            return


def _statistics(summary: bytes) -> memoryview:
    """Return the body of the statistics record in the summary section; without one, a body that
    states no messages."""
    place = 0
    while place + 9 <= len(summary):
        kind, length = struct.unpack_from("<BQ", summary, place)
        if kind == _STATISTICS:
            return memoryview(summary)[place + 9 :]
        place += 9 + length
    return memoryview(bytes(8))


def _in_chunk(body: memoryview) -> Iterator[tuple[int, memoryview]]:
    size, checksum = struct.unpack_from("<QI", body, 16)
    compression, start = _text(body, 28)
    (length,) = struct.unpack_from("<Q", body, start)
    packed = bytes(body[start + 8 : start + 8 + length])
    try:
        records = memoryview(decompress(packed, compression, size, checksum))
    except Exception as error:  # each codec has its own exception classes
        raise ReaderError(f"a chunk cannot be decompressed: {error}") from error
    place = 0
    while place < len(records):
        kind, length = struct.unpack_from("<BQ", records, place)
        yield kind, records[place + 9 : place + 9 + length]
        place += 9 + length


def _text(body: memoryview, start: int) -> tuple[str, int]:
    """Return the text whose length (uint32) is stored at ``start``, directly before the text, and
    the index at which the text ends."""
    (length,) = struct.unpack_from("<I", body, start)
    end = start + 4 + length
    return bytes(body[start + 4 : end]).decode(), end


@lru_cache(maxsize=8)
def _store_of(schemas: frozenset[tuple[str, str, str]]) -> Typestore:
    """Return the message types as a bag defines them. The installed types may be newer. Bags of one
    version share their types, because most of the time to read a bag is spent on them.

    Raises:
        BagError: a definition cannot be read; the message does not name the bag.
    """
    store = get_typestore(Stores.EMPTY)
    for name, form, text in schemas:
        try:
            types = get_types_from_idl(text) if "idl" in form else get_types_from_msg(text, name)
            store.register(types)
        except (TypesysError, KeyError, ValueError, SyntaxError) as error:
            raise BagError(f"the definition of {name} cannot be read: {error}") from error
    return store
