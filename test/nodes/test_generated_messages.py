"""The generated dataclasses have the same fields as the installed messages."""

import importlib.util
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_committed_messages_match_the_generator_output() -> None:
    """If this fails after a change in msg_defs, run ``python environment/generate_messages.py``."""
    program = ROOT / "environment" / "generate_messages.py"
    specification = importlib.util.spec_from_file_location("generate_messages", program)
    assert specification is not None and specification.loader is not None
    generator = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(generator)
    committed = ROOT / "tapping_cell" / "messages" / "__init__.py"
    written = subprocess.run(
        [sys.executable, "-m", "ruff", "format", "--stdin-filename", str(committed), "-"],
        input=generator.generate(),
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert written == committed.read_text(encoding="utf-8")
