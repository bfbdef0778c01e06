"""Definitions of ROS messages. With them, a bag is readable even if the message packages are not
installed."""

from __future__ import annotations

from typing import cast

from tapping_cell.report.message_files import UnknownMessageType, definition_file
from tapping_cell.report.recorded import needing_rosbags

with needing_rosbags():
    from rosbags.interfaces import Nodetype
    from rosbags.interfaces.typing import Fielddefs
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from rosbags.typesys.base import TypesysError
    from rosbags.typesys.store import Typestore


class MessageTypes:
    """Message types of ROS 2 Jazzy and, loaded on demand, of any installed package."""

    def __init__(self, store: Typestore | None = None) -> None:
        """Start with the types of ``store``. If it is None, start with those of ROS 2 Jazzy."""
        self._store = store or get_typestore(Stores.ROS2_JAZZY)

    def definition(self, kind: str) -> tuple[str, str]:
        """Return definition and hash of a message type, such as ``geometry_msgs/msg/Pose``.

        The definition has MCAP's format: the definitions of all nested types are appended.

        Raises:
            UnknownMessageType: the type or a nested type is not found.
        """
        store = self._store_with(kind)
        text, _ = store.generate_msgdef(kind, ros_version=2)
        return text, store.hash_rihs01(kind)

    def _store_with(self, kind: str) -> Typestore:
        """Return a store of types that includes ``kind`` and its nested types.

        Raises:
            UnknownMessageType: the type or a nested type is not found.
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


def _names_in(fields: Fielddefs) -> list[str]:
    """Return the message types of a type's fields, including elements of arrays and sequences."""
    found = []
    for _, (node, content) in fields:
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            element = cast("tuple[tuple[int, object], int]", content)[0]
        else:
            element = (node, content)
        if element[0] == Nodetype.NAME:
            found.append(str(element[1]))
    return found
