"""Ctrl-C ends a node in order, wherever in a callback the signal arrives."""

import subprocess
import sys
from pathlib import Path

import pytest

NODE = '''
import signal
import sys
from dataclasses import dataclass

from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String

from tapping_cell.configuration.schema import text
from tapping_cell.nodes.cell_node import CellNode, run


@dataclass(frozen=True)
class Parameters:
    """Parameters of the node."""

    autostart: bool = text("configure and activate automatically", default=True)
    frame_prefix: str = text("prefix of frames", default="")


def interrupted(message: String, **values: object) -> None:
    """Receive the signal while a message is constructed, which C code does when it reads one."""
    signal.raise_signal(signal.SIGINT)


class Node(CellNode):
    """Node that receives the signal while it reads a message."""

    def __init__(self) -> None:
        super().__init__("interrupted", Parameters)
        self.create_timer(0.05, self._read)

    def _read(self) -> None:
        data = serialize_message(String(data="x"))
        String.__init__ = interrupted
        {action}

    def cleanup(self) -> None:
        print("cleaned up", flush=True)


sys.exit(run(Node))
'''


@pytest.mark.parametrize(
    ("action", "code"),
    [
        ("deserialize_message(data, String)", 0),
        ("String()", 0),
        ('raise TypeError("a mistake")', 1),
    ],
)
def test_a_node_ends_in_order_wherever_ctrl_c_reaches_it(
    action: str, code: int, tmp_path: Path
) -> None:
    script = tmp_path / "interrupted.py"
    script.write_text(NODE.replace("{action}", action), encoding="utf-8")
    ended = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == code, ended.stderr
    assert "cleaned up" in ended.stdout
    assert ("Traceback" in ended.stderr) == (code != 0)
