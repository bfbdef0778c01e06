"""An archive restores exactly what was there; a damaged or foreign one changes nothing."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tapping_cell.cli import main
from tapping_cell.cli.deployment.archive import ArchiveError, read_archive
from tapping_cell.cli.deployment.places import Places


def verb(name: str, root: Path, *words: str) -> int:
    return main([name, *words, "--root", str(root)])


@pytest.fixture
def places(tmp_path: Path) -> Places:
    """A deployed cell that has learnt something, with a stop and a goal."""
    made = Places(root=tmp_path / "root")
    assert verb("deploy", made.root, "--yes") == 0
    for path, text in {
        made.gains / "domain0/disk.json": '{"object": "disk"}',
        made.records / "domain0/named_goals.json": '{"home": [0, 0, 0]}',
        made.records / "domain0/stop-scara_arm.json": '{"causes": []}',
        made.records / "domain0/goal.json": '{"goal": [0, 0, 0]}',
        made.configuration / ".history/table.yaml.2026-11-29T08-00-00.000000Z": "old",
    }.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return made


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_backup_is_restored_on_another_computer(places: Places, tmp_path: Path) -> None:
    archive = tmp_path / "a.zip"
    table = places.configuration / "table.yaml"
    table.write_text(table.read_text() + "# calibrated\n")
    (places.configuration / "photo.png").write_bytes(b"\x89PNG\xff")
    assert verb("backup", places.root, str(archive)) == 0
    other = Places(root=tmp_path / "other")
    assert verb("restore", other.root, str(archive), "--yes") == 2, "nothing is deployed there"
    assert verb("deploy", other.root, "--yes", "--domain", "7") == 0
    environment = (other.configuration / "cell.env").read_text()
    assert verb("restore", other.root, str(archive), "--yes") == 0
    assert (other.configuration / "table.yaml").read_text().endswith("# calibrated\n")
    assert (other.configuration / "cell.env").read_text() == environment
    assert sorted(contents(other.state)) == [
        ".local/state/tapping_cell/gains/domain0/disk.json",
        ".ros/tapping_cell/domain0/named_goals.json",
    ], "no stop and no goal is restored"
    # The present state was archived, and can be restored in its turn.
    assert (
        verb("restore", other.root, str(other.configuration / "before_restore.zip"), "--yes") == 0
    )
    assert not (other.configuration / "table.yaml").read_text().endswith("# calibrated\n")


def test_a_stop_is_never_removed_by_a_restore(places: Places, tmp_path: Path) -> None:
    archive = tmp_path / "a.zip"
    stop = places.records / "domain0/stop-scara_arm.json"
    stop.unlink()
    assert verb("backup", places.root, str(archive)) == 0
    stop.write_text('{"causes": ["later"]}')
    (places.configuration / "table.yaml").unlink()
    assert verb("restore", places.root, str(archive), "--yes") == 0
    assert stop.read_text() == '{"causes": ["later"]}'
    assert (places.configuration / "table.yaml").exists()


def test_a_wrong_configuration_is_not_restored(places: Places, tmp_path: Path, capsys) -> None:
    archive = tmp_path / "a.zip"
    cell = places.cell_file.read_text()
    places.cell_file.write_text(cell.replace("strike_height: 0.006", "strike_height: 6"))
    assert verb("backup", places.root, str(archive)) == 0
    places.cell_file.write_text(cell)
    before = contents(places.root)
    assert verb("restore", places.root, str(archive), "--yes") == 2
    assert "strike_height" in capsys.readouterr().err
    assert contents(places.root) == before


@pytest.mark.parametrize(
    "name",
    ["../passwd", "/etc/passwd", "configuration/../../x", "records/d/stop-scara_arm.json",
     "configuration/cell.env", "configuration/deployed.json", "gains//etc/cron.d/x",
     "configuration/./cell.env", "configuration//cell.env",
     "gains/", "other/x", "records/d/goal.json"],
)  # fmt: skip
def test_a_foreign_path_is_refused(places: Places, tmp_path: Path, name: str) -> None:
    archive = tmp_path / "a.zip"
    assert verb("backup", places.root, str(archive)) == 0
    with zipfile.ZipFile(archive) as old:
        texts = {entry: old.read(entry) for entry in old.namelist()}
    content = json.loads(texts.pop("content.json"))
    data = next(iter(texts.values()))
    content["files"][name] = next(iter(content["files"].values()))
    with zipfile.ZipFile(archive, "w") as new:
        for entry, text in {"content.json": json.dumps(content), **texts, name: data}.items():
            new.writestr(entry, text)
    before = contents(places.root)
    assert verb("restore", places.root, str(archive), "--yes") == 2
    assert contents(places.root) == before


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_a_damaged_archive_is_refused_or_unchanged(places: Places, tmp_path: Path, data) -> None:
    archive, damaged = tmp_path / "a.zip", tmp_path / "b.zip"
    if not archive.exists():
        assert verb("backup", places.root, str(archive)) == 0
    whole = archive.read_bytes()
    at = data.draw(st.integers(0, len(whole) - 1))
    change = data.draw(st.sampled_from(["flip", "cut", "remove"]))
    if change == "flip":
        damaged.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
    else:
        damaged.write_bytes(whole[:at] + (whole[at + 1 :] if change == "remove" else b""))
    try:
        _, texts = read_archive(damaged)
    except ArchiveError:
        return
    assert texts == read_archive(archive)[1]


def test_a_backup_without_a_cell_is_refused(tmp_path: Path) -> None:
    assert verb("backup", tmp_path, str(tmp_path / "a.zip")) == 2
    assert not (tmp_path / "a.zip").exists()


def test_a_link_is_neither_archived_nor_followed(places: Places, tmp_path: Path) -> None:
    archive, secret = tmp_path / "a.zip", tmp_path / "shadow.json"
    secret.write_text("{}")
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "domain0").mkdir(parents=True)
    (elsewhere / "domain0/secret.json").write_text("{}")
    assert verb("backup", places.root, str(archive)) == 0
    gain = places.gains / "domain0/disk.json"
    for link in (gain.with_name("more.json"), places.configuration / "more.yaml"):
        link.symlink_to(secret)
    assert verb("backup", places.root, str(tmp_path / "b.zip")) == 0
    assert not [name for name in read_archive(tmp_path / "b.zip")[1] if "more" in name]
    # The names that restore writes are predictable.
    gain.unlink()
    gain.symlink_to(secret)
    gain.with_name(".disk.json.part").symlink_to(secret)
    assert verb("restore", places.root, str(archive), "--yes") == 0
    assert secret.read_text() == "{}" and not gain.is_symlink()
    assert gain.read_text() == '{"object": "disk"}'
    shutil.rmtree(places.gains)
    places.gains.symlink_to(elsewhere)
    before = contents(elsewhere)
    assert verb("restore", places.root, str(archive), "--yes") == 1
    assert contents(elsewhere) == before
    assert verb("backup", places.root, str(tmp_path / "c.zip")) == 0
    assert not [name for name in read_archive(tmp_path / "c.zip")[1] if "gains" in name]


@pytest.mark.parametrize("key", ["name", "made", "options", "format", "versions"])
def test_an_archive_without_a_statement_is_refused(
    places: Places, tmp_path: Path, key: str
) -> None:
    archive = tmp_path / "a.zip"
    assert verb("backup", places.root, str(archive)) == 0
    with zipfile.ZipFile(archive) as old:
        texts = {entry: old.read(entry) for entry in old.namelist()}
    content = json.loads(texts["content.json"])
    del content[key]
    content["format"] = content.get("format", 1) + (key == "versions")
    if key == "format":
        del content["format"]
    with zipfile.ZipFile(archive, "w") as new:
        for entry, text in {**texts, "content.json": json.dumps(content)}.items():
            new.writestr(entry, text)
    assert verb("restore", places.root, str(archive), "--yes") == 2


def test_a_backup_into_a_folder_is_refused(places: Places, tmp_path: Path, capsys) -> None:
    assert verb("backup", places.root, str(tmp_path)) == 2
    assert "give the name of a zip file in it" in " ".join(capsys.readouterr().err.split())


def test_an_archive_that_was_packed_again_is_named(places: Places, tmp_path: Path, capsys) -> None:
    first, second = tmp_path / "a.zip", tmp_path / "b.zip"
    assert verb("backup", places.root, str(first)) == 0
    with zipfile.ZipFile(first) as one, zipfile.ZipFile(second, "w") as other:
        for name in one.namelist():
            other.writestr(f"a/{name}", one.read(name))
    assert verb("restore", places.root, str(second), "--yes") == 2
    assert "packed again with its folder" in " ".join(capsys.readouterr().err.split())
