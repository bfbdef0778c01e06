"""A stored file that a crash has left unusable never prevents a node from starting."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from random import Random

import pytest

from tapping_cell.nodes import kept_content
from tapping_cell.nodes.kept_content import KeptContent


def test_stored_content_is_loaded_and_removed(tmp_path: Path) -> None:
    kept = KeptContent(tmp_path / "cell" / "goal.json")
    assert kept.recall() is None
    kept.keep({"goal": [0.01, 0.02, 0.3]})
    assert kept.recall() == {"goal": [0.01, 0.02, 0.3]} and kept.age() < 60.0
    kept.keep(None)
    assert kept.recall() is None


def test_a_goal_of_any_name_is_stored(tmp_path: Path) -> None:
    kept = KeptContent(tmp_path / "named_goals.json")
    kept.keep({"boot": [0.01, 0.02, 0.3]})
    assert kept.recall() == {"boot": [0.01, 0.02, 0.3]} and not kept.is_of_earlier_boot()
    assert not kept_content.BOOT.isprintable()


@pytest.mark.parametrize("text", ["", "[" * 200_000, "[]", "7", "\x00", '{"goal": ' * 100_000])
def test_an_unreadable_file_gives_empty_content(tmp_path: Path, text: str) -> None:
    file = tmp_path / "goal.json"
    file.write_text(text, encoding="utf-8")
    assert KeptContent(file).recall() == {}


def test_old_content_is_kept_until_the_new_content_is_complete(tmp_path: Path) -> None:
    file = tmp_path / "goal.json"
    kept = KeptContent(file)
    kept.keep({"goal": 1})
    with pytest.raises(TypeError):
        kept.keep({"goal": object()})
    assert kept.recall() == {"goal": 1} and json.loads(file.read_text())["goal"] == 1


def test_content_of_an_earlier_start_of_the_computer_is_known(tmp_path: Path, monkeypatch) -> None:
    kept = KeptContent(tmp_path / "goal.json")
    assert not kept.is_of_earlier_boot()
    kept.keep({"goal": 1})
    assert not kept.is_of_earlier_boot()
    monkeypatch.setattr(kept_content, "boot_id", lambda: "the next one")
    assert kept.is_of_earlier_boot() and kept.recall() == {"goal": 1}
    # An earlier version did not store the start: its age alone decides.
    (tmp_path / "goal.json").write_text('{"goal": 1}')
    assert not kept.is_of_earlier_boot()


def test_a_kill_at_any_moment_leaves_old_or_new_content(tmp_path: Path) -> None:
    """A process writes numbers without a pause, and is killed."""
    file = tmp_path / "goal.json"
    program = (
        "import sys, itertools; from pathlib import Path;"
        "from tapping_cell.nodes.kept_content import KeptContent;"
        "kept = KeptContent(Path(sys.argv[1])); [kept.keep({'number': n, 'text': 'x' * 9000})"
        " for n in itertools.count(int(sys.argv[2]))]"
    )
    random, last = Random(1), 0
    for _ in range(8):
        writer = subprocess.Popen([sys.executable, "-c", program, str(file), str(last)])
        while not file.exists() or KeptContent(file).recall()["number"] == last:  # type: ignore[index]
            assert writer.poll() is None
        time.sleep(random.uniform(0, 0.02))
        writer.kill()
        writer.wait()
        content = KeptContent(file).recall()
        assert content is not None and len(content["text"]) == 9000
        assert content["number"] > last
        last = content["number"]
