"""Generate ``tapping_cell/messages/__init__.py``: the messages as plain dataclasses, without ROS.

After a change in ``msg_defs``, run ``python environment/generate_messages.py`` in a shell with
``env.sh``. A test fails while the committed file differs from the output.
"""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

PROJECT = Path(__file__).resolve().parents[1]
TARGET = PROJECT / "tapping_cell" / "messages" / "__init__.py"
ROOTS = (
    "builtin_interfaces/msg/Duration",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "sensor_msgs/msg/JointState",
    "std_msgs/msg/Bool",
    "std_srvs/srv/SetBool",
    "std_srvs/srv/Trigger",
    "trajectory_msgs/msg/JointTrajectory",
    *(
        f"tapping_cell_msgs/{kind}/{file.stem}"
        for kind in ("msg", "srv", "action")
        for file in sorted((PROJECT / "msg_defs" / kind).iterdir())
        if file.stem != "ResetWorld"  # only sim_world uses it
    ),
)
PARTS = {"srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}
HEADER = '''"""The cell's messages as dataclasses that need no ROS; generated, not edited.

``python environment/generate_messages.py`` writes this file from the installed message packages.
``ROS_TYPE`` names the message that a class mirrors; ``nodes/message_conversion.py`` converts.
Units and meanings are documented in ``msg_defs``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar
'''


def load(name: str) -> Any:
    """Return the ROS class of ``package/kind/Name``."""
    package, kind, title = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), title)


def constants(kind: Any) -> dict[str, Any]:
    """Return the constants of a message class, in alphabetical order."""
    found: dict[str, Any] = vars(type(kind)).get(f"_{type(kind).__name__}__constants", {})
    return dict(sorted(found.items()))


def element(ros_type: str) -> str | None:
    """Return the type of the elements of a sequence or array; None for another type."""
    found = re.match(r"^sequence<(.*?)(?:, \d+)?>$|^(.*)\[\d+\]$", ros_type)
    return (found[1] or found[2]) if found else None


def nested(ros_type: str) -> str | None:
    """Return the message name in a field type, ``package/msg/Name``; None for a basic type."""
    package, _, title = (element(ros_type) or ros_type).partition("/")
    return f"{package}/msg/{title}" if title else None


def python_type(ros_type: str) -> str:
    """Return the annotation of a field."""
    if inner := element(ros_type):
        return f"list[{python_type(inner)}]"
    name = nested(ros_type)
    if name is not None:
        return name.rsplit("/", 1)[1]
    if ros_type in ("float", "double"):
        return "float"
    if ros_type == "boolean":
        return "bool"
    return "str" if ros_type.startswith("string") else "int"


def default(annotation: str, ros_type: str, value: Any) -> str:
    """Return the default of a field as source text; ``value`` is its value in a new ROS message."""
    if annotation.startswith("list["):
        fixed = re.search(r"\[(\d+)\]$", ros_type)
        if fixed is None:
            return "field(default_factory=list)"
        return f"field(default_factory=lambda: [{float(value[0])!r}] * {fixed[1]})"
    if nested(ros_type) is not None:
        return f"field(default_factory={annotation})"
    return repr(value)


def dataclass_text(name: str, title: str, kind: Any, indent: str = "") -> str:
    """Return the source of the dataclass of one message class."""
    lines = [
        "@dataclass(slots=True, kw_only=True)",
        f"class {title}:",
        f'    """Mirror of ``{name}``."""',
        "",
        f'    ROS_TYPE: ClassVar[str] = "{name}"',
    ]
    lines += [
        f"    {key}: ClassVar[{type(value).__name__}] = {value!r}"
        for key, value in constants(kind).items()
    ]
    empty = kind()
    fields = kind.get_fields_and_field_types()
    if fields:
        lines.append("")
    for key, ros_type in fields.items():
        annotation = python_type(ros_type)
        value = default(annotation, ros_type, getattr(empty, key))
        lines.append(f"    {key}: {annotation} = {value}")
    return "\n".join(indent + line if line else "" for line in lines) + "\n"


def generate() -> str:
    """Return the source of the module."""
    blocks: list[str] = []
    done: set[str] = set()

    def add(name: str) -> None:
        if name in done:
            return
        done.add(name)
        kind = load(name)
        title = name.rsplit("/", 1)[1]
        parts = PARTS.get(name.split("/")[1])
        classes = [kind] if parts is None else [getattr(kind, part) for part in parts]
        for each in classes:
            for ros_type in each.get_fields_and_field_types().values():
                inner = nested(ros_type)
                if inner is not None:
                    add(inner)
        if parts is None:
            blocks.append(dataclass_text(name, title, kind))
            return
        text = f'class {title}:\n    """Mirror of ``{name}``."""\n\n'
        text += f'    ROS_TYPE: ClassVar[str] = "{name}"\n\n'
        text += "\n".join(
            dataclass_text(f"{name}.{part}", part, each, "    ")
            for part, each in zip(parts, classes, strict=True)
        )
        blocks.append(text)

    for name in ROOTS:
        add(name)
    return "\n\n".join([HEADER, *blocks])


if __name__ == "__main__":
    TARGET.write_text(generate(), encoding="utf-8")
    print(f"wrote {TARGET}")
