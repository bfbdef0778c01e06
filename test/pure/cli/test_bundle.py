"""The support bundle has what explains a failure, and no secret."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

from tapping_cell.cli import main
from tapping_cell.cli.bundle import redacted
from tapping_cell.cli.deployment.places import Places
from tapping_cell.nodes import computer


def test_a_bundle_of_a_deployed_cell(tmp_path: Path) -> None:
    places = Places(root=tmp_path / "root")
    assert main(["deploy", "--root", str(places.root), "--yes"]) == 0
    run = places.runs / "2026-11-29_to_0_0_0"
    (run / "bag").mkdir(parents=True)
    (run / "summary.json").write_text('{"outcome": "failed"}')
    (run / "bag/bag.mcap").write_bytes(b"images")
    log = places.root / "var/log/tapping_cell/operator_page.log"
    log.parent.mkdir(parents=True)
    log.write_text("x" * 600_000 + "\noperator page: http://cell:8010/#token=aB3-x_Y9\n")
    file = tmp_path / "support.zip"
    assert main(["bundle", str(file), "--root", str(places.root)]) == 0
    with zipfile.ZipFile(file) as bundle:
        texts = {name: bundle.read(name).decode() for name in bundle.namelist()}
    for name in ("state.json", "check_config.json", "service/cell.env", "configuration/cell.yaml"):
        assert name in texts
    assert "runs/2026-11-29_to_0_0_0/summary.json" in texts
    assert not any("bag.mcap" in name for name in texts)
    assert "aB3-x_Y9" not in "".join(texts.values()) and "token=REDACTED" in "".join(texts.values())
    assert len(texts["logs/operator_page.log"]) < 600_000
    assert json.loads(texts["state.json"])["computer"]["disk_free_mb"] > 0


def test_a_bundle_follows_no_link(tmp_path: Path) -> None:
    places = Places(root=tmp_path / "root")
    assert main(["deploy", "--root", str(places.root), "--yes"]) == 0
    (tmp_path / "shadow").write_text("root:hash")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/summary.json").write_text("root:hash")
    logs = places.root / "var/log/tapping_cell"
    for folder in (logs, places.runs / "a"):
        folder.mkdir(parents=True)
    (logs / "a.log").symlink_to(tmp_path / "shadow")
    (places.runs / "a/summary.json").symlink_to(tmp_path / "shadow")
    (places.runs / "b").symlink_to(tmp_path / "folder")
    (places.configuration / "c.yaml").symlink_to(tmp_path / "shadow")
    file = tmp_path / "support.zip"
    assert main(["bundle", str(file), "--root", str(places.root)]) == 0
    with zipfile.ZipFile(file) as bundle:
        assert not any(b"hash" in bundle.read(name) for name in bundle.namelist())


def test_a_bundle_without_a_deployed_cell(tmp_path: Path) -> None:
    file = tmp_path / "support.zip"
    assert main(["bundle", str(file), "--root", str(tmp_path), "--runs", str(tmp_path)]) == 0
    with zipfile.ZipFile(file) as bundle:
        assert bundle.namelist() == ["state.json"]


@pytest.mark.parametrize(
    ("text", "safe"),
    [
        ("http://x:8010/#token=abc", "http://x:8010/#token=REDACTED"),
        ('{"password": "p w"}', '{"password": "REDACTED w"}'),
        ("token: 'abc'", "token: 'REDACTED'"),
        ("rtsp://me:secret@camera/1", "rtsp://REDACTED@camera/1"),
        ("rtsp://camera/1 a@b", "rtsp://camera/1 a@b"),
    ],
)
def test_secrets_are_removed(text: str, safe: str) -> None:
    assert redacted(text) == safe


def test_the_hottest_sensor_counts(tmp_path: Path) -> None:
    assert computer.temperature(tmp_path) is None
    for number, text in enumerate(["41000\n", "n/a", "55500\n"]):
        (tmp_path / f"thermal_zone{number}").mkdir()
        (tmp_path / f"thermal_zone{number}" / "temp").write_text(text)
    assert computer.temperature(tmp_path) == 55.5
    assert computer.disk_space(tmp_path / "no" / "folder")[0] > 0
