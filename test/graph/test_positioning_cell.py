"""The positioning cell, which has no arm, with each node in its own process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tapping_cell.configuration.files import shared_folder

CELL = shared_folder() / "positioning_cell" / "cell.yaml"


def test_the_demo_reaches_a_goal_without_an_arm(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    options = ["--cell", str(CELL), "--goal", "15", "-20", "60", "--seed", "2"]
    command = [sys.executable, "-m", "tapping_cell", "demo", "--out", str(folder), *options]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=280)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["reached"]
    assert summary["true_residual"]["distance_mm"] <= 1.0
    assert abs(summary["true_residual"]["rotation_deg"]) <= 1.0
    assert not (folder / "logs" / "scara_arm.log").exists()
    # On a busy machine the emulated board may answer late. A log may contain a warning about this,
    # but no traceback.
    for log in (folder / "logs").glob("*.log"):
        assert "Traceback" not in log.read_text(encoding="utf-8"), log
