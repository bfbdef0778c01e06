import argparse
import re
import shlex
from pathlib import Path

import pytest

from tapping_cell.cli import evaluate
from tapping_cell.planning import RefusalReason, planner_names

PAGE = Path(__file__).resolve().parents[3] / "docs" / "planning.md"


@pytest.fixture(scope="module")
def page():
    return PAGE.read_text(encoding="utf-8")


def test_every_reason_and_every_method_is_documented(page):
    for name in [reason.name for reason in RefusalReason] + planner_names():
        assert f"`{name}`" in page, name


def test_every_image_exists(page):
    pictures = re.findall(r"!\[[^]]+\]\(([^)]+)\)", page)
    assert len(pictures) == 4
    for picture in pictures:
        assert (PAGE.parent / picture).is_file(), picture


def test_every_documented_command_and_option_is_valid(page):
    commands = re.findall(r"^python -m tapping_cell evaluate (.+)$", page, re.MULTILINE)
    rows = re.findall(r"^\| `(--[^`]+)`", page, re.MULTILINE)
    assert len(commands) == 2 and len(rows) == 9
    for words in commands + rows:
        parser = argparse.ArgumentParser()
        evaluate.add_arguments(parser)
        parser.parse_args(shlex.split(words))
