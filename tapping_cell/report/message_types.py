"""Definitions of ROS messages, so that a bag explains itself without the packages installed."""

from __future__ import annotations

from pathlib import Path
from typing import cast

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Fielddefs
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

_OWN_PACKAGE = "tapping_cell_msgs"
_OWN_SOURCES = Path(__file__).resolve().parents[2] / "msg_defs"


class UnknownMessageType(ValueError):
    """No definition of a message type is known; the sentence says where it was looked for."""


class MessageTypes:
    """ROS 2 Jazzy's own messages, and those of any installed package once they are asked for."""

    def __init__(self, store: Typestore | None = None) -> None:
        """Begin with the types of ``store``; with those of ROS 2 Jazzy where None."""
        self._store = store or get_typestore(Stores.ROS2_JAZZY)

    def definition(self, kind: str) -> tuple[str, str]:
        """Text (as MCAP wants it, with the definitions it needs below) and hash of a message type.

        ``kind`` is written like ``geometry_msgs/msg/Pose``.

        Raises:
            UnknownMessageType: the type, or one that it holds, is not to be found.
        """
        store = self._store_with(kind)
        text, _ = store.generate_msgdef(kind, ros_version=2)
        return text, store.hash_rihs01(kind)

    def _store_with(self, kind: str) -> Typestore:
        """The types by name; ``kind`` and all that it holds are among them.

        Raises:
            UnknownMessageType: as :meth:`definition`.
        """
        missing = [kind]
        while missing:
            name = missing.pop()
            if name in self._store.fielddefs:
                continue
            file = definition_file(name)
            try:
                types = get_types_from_msg(file.read_text(encoding="utf-8"), name)
                self._store.register(types)
            except (OSError, TypesysError) as error:
                raise UnknownMessageType(
                    f"the definition of {name} in {file} cannot be read ({error}); build the "
                    "messages again"
                ) from error
            missing += [held for _, fields in types.values() for held in _names_in(fields)]
        return self._store


def definition_file(kind: str) -> Path:
    """The file that defines a message type, written like ``geometry_msgs/msg/Pose``.

    Raises:
        UnknownMessageType: no installed package and not the source tree has it.
    """
    parts = kind.split("/")
    if len(parts) != 3 or not all(parts):
        raise UnknownMessageType(f"'{kind}' is no message type; they are written package/msg/Name")
    package, folder, name = parts
    try:
        share = Path(get_package_share_directory(package))
    except (PackageNotFoundError, OSError, ValueError) as error:
        # Without a build (no ament index at all, or not with us in it) there is the source tree.
        if package != _OWN_PACKAGE or not _OWN_SOURCES.is_dir():
            raise UnknownMessageType(
                f"the definition of {kind} is not known: the package {package} is not installed"
            ) from error
        share = _OWN_SOURCES
    file = share / folder / f"{name}.msg"
    if not file.is_file():
        raise UnknownMessageType(f"the definition of {kind} is not known: there is no {file}")
    return file


def _names_in(fields: Fielddefs) -> list[str]:
    """The message types that a type's fields hold, alone, in an array or in a sequence."""
    found = []
    for _, (node, content) in fields:
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            element = cast("tuple[tuple[int, object], int]", content)[0]
        else:
            element = (node, content)
        if element[0] == Nodetype.NAME:
            found.append(str(element[1]))
    return found
