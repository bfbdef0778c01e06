"""``update`` switches a deployed cell to another version only if that can run it, and back."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.cli import main, update
from tapping_cell.cli.deployment.archive import collected
from tapping_cell.cli.deployment.places import Places
from tapping_cell.hardware.tapper import PROTOCOL_VERSION


@pytest.fixture
def deployed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the root of a computer with a cell that runs the version in /opt/earlier."""
    root = tmp_path / "root"
    assert main(["deploy", "--root", str(root), "--yes"]) == 0
    folder = root / "etc/tapping_cell"
    present = folder / "version.env"
    (folder / "versions/opt:earlier.env").write_text(present.read_text())
    present.unlink()
    present.symlink_to("versions/opt:earlier.env")
    monkeypatch.setattr(update, "simulate", lambda cell: None)
    return root


def state_of(root: Path) -> tuple[str, str]:
    """Return the target of the version link and the text of the cell file."""
    folder = root / "etc/tapping_cell"
    return os.readlink(folder / "version.env"), (folder / "cell.yaml").read_text()


def call(root: Path, *options: str) -> int:
    return main(["update", "--root", str(root), "--yes", *options])


def renamed_cell(root: Path, folder: Path) -> str:
    """Copy the deployed configuration, with another name of the cell."""
    for path in ("cell.yaml", "table.yaml", "camera_info.yaml", "objects/aluminium_disk.yaml"):
        text = (root / "etc/tapping_cell" / path).read_text()
        (folder / path).parent.mkdir(exist_ok=True)
        (folder / path).write_text(text.replace("name: tapping cell", "name: migrated"))
    return str(folder / "cell.yaml")


def test_back_undoes_an_update_and_a_second_back_repeats_it(
    deployed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = deployed / "etc/tapping_cell/cell.yaml"
    cell.write_text(cell.read_text() + "# calibrated\n")
    before = state_of(deployed)
    new = renamed_cell(deployed, tmp_path / "new")
    assert call(deployed, "--cell", new, "--dry-run") == 0
    assert state_of(deployed) == before
    assert call(deployed, "--cell", new) == 0
    shown = capsys.readouterr().out
    assert "-name: tapping cell" in shown and "+name: migrated" in shown
    after = state_of(deployed)
    assert after[0] != before[0] and "name: migrated" in after[1]
    assert call(deployed) == 2, "the cell runs this version already"
    for expected in (before, after, before):
        assert call(deployed, "--back") == 0
        assert state_of(deployed) == expected
    assert main(["undeploy", "--root", str(deployed), "--all", "--yes"]) == 0
    assert [path for path in deployed.rglob("*") if not path.is_dir()] == []


def test_undeploy_after_back_keeps_what_was_calibrated_before_the_update(
    deployed: Path, tmp_path: Path
) -> None:
    cell = deployed / "etc/tapping_cell/cell.yaml"
    calibrated = cell.read_text() + "# calibrated\n"
    cell.write_text(calibrated)
    assert call(deployed, "--cell", renamed_cell(deployed, tmp_path / "new")) == 0
    assert call(deployed, "--back") == 0
    assert main(["undeploy", "--root", str(deployed), "--yes"]) == 0
    assert cell.read_text() == calibrated
    assert not (cell.parent / "table.yaml").exists(), "deploy wrote it, and nobody changed it"


def test_a_version_that_cannot_run_the_cell_is_refused(
    deployed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = state_of(deployed)

    def fails(cell: object) -> None:
        raise update.Unsuitable("the goal in simulation was not reached")

    monkeypatch.setattr(update, "simulate", fails)
    assert call(deployed) == 2
    monkeypatch.setattr(update, "simulate", lambda cell: None)
    cell = deployed / "etc/tapping_cell/cell.yaml"
    cell.write_text("old_key: 1\n" + before[1])
    assert call(deployed) == 2
    assert "unknown key 'old_key'" in capsys.readouterr().err
    cell.write_text(before[1])
    assert call(deployed, "--back") == 2, "no version ran before"
    assert state_of(deployed) == before


def test_a_version_whose_folder_is_gone_is_not_returned_to(deployed: Path) -> None:
    earlier = deployed / "etc/tapping_cell/versions/opt:earlier.env"
    earlier.write_text("PATH=/opt/earlier/.venv/bin:/usr/bin\n")
    assert call(deployed) == 0
    after = state_of(deployed)
    assert call(deployed, "--back") == 2
    assert state_of(deployed) == after


def test_the_archive_of_a_cell_names_no_version(deployed: Path) -> None:
    assert not [name for name in collected(Places(root=deployed)) if "version" in name]


def rows(firmware: str) -> dict[str, Any]:
    return {"nodes": [{"role": "scara_arm"}, {"role": "tapper_trigger", "firmware": firmware}]}


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 30)), min_size=1, max_size=4))
def test_firmware_of_another_protocol_is_refused(versions: list[tuple[int, int]]) -> None:
    state = rows(", ".join(f"{major}.{minor}.0" for major, minor in versions))
    if all(str(major) == PROTOCOL_VERSION for major, _ in versions):
        update.require_firmware(state)
    else:
        with pytest.raises(update.Unsuitable, match="flash it"):
            update.require_firmware(state)
