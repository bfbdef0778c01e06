"""Release: versions that agree, the changelog for bloom, and packages that bloom finds."""

import importlib.util
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
specification = importlib.util.spec_from_file_location("release", ROOT / "environment/release.py")
release = importlib.util.module_from_spec(specification)
specification.loader.exec_module(release)

MARKDOWN = """# Changelog

A sentence of the page.

## 0.2.0 (unreleased)

### Added

#### Nodes
- `frame_prefix` of every node
  ([how-to](docs/x.md)), and *more*_.
- Second.

### Fixed
- `a`s.

## 0.1.0 (2026-11-21)

The first version.
"""


def test_every_file_states_the_version_of_the_last_release():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    last = re.search(r"^## (\d+\.\d+\.\d+) \(\d{4}-\d\d-\d\d\)$", text, flags=re.MULTILINE)[1]
    assert set(release.stated_versions(ROOT).values()) == {last}


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A repository with the files that a release changes, and the messages."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    for name in (*release.PLACES, "msg_defs/msg/PlanState.msg"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "CHANGELOG.md").write_text(MARKDOWN)
    monkeypatch.setattr(release, "ROOT", tmp_path)
    for words in (
        ("init", "-q"),
        ("config", "user.name", "x"),
        ("config", "user.email", "x@x"),
        ("add", "-A"),
        ("commit", "-qm", "x"),
    ):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    return tmp_path


def test_a_release_has_one_version_and_both_packages_side_by_side(repository, tmp_path_factory):
    tag = release.release("0.2.0")
    assert set(release.stated_versions(repository).values()) == {"0.2.0"}
    tags = subprocess.check_output(["git", "tag"], cwd=repository, text=True).split()
    assert tags == ["0.2.0", tag] == ["0.2.0", "packages-0.2.0"]
    out = tmp_path_factory.mktemp("released")
    subprocess.run(
        ["git", "worktree", "add", "-q", str(out / "x"), tag], cwd=repository, check=True
    )
    packages = pytest.importorskip("catkin_pkg.packages")  # bloom's way to find packages
    assert {p: e.version for p, e in packages.find_packages(out / "x").items()} == {
        "tapping_cell": "0.2.0",
        "tapping_cell_msgs": "0.2.0",
    }
    assert (out / "x/tapping_cell_msgs/msg/PlanState.msg").is_file()
    assert not (out / "x/tapping_cell/msg_defs").exists()


def test_nothing_is_released_with_changes_or_under_another_version(repository):
    with pytest.raises(release.ReleaseError, match="no section '## 0.3.0"):
        release.release("0.3.0")
    (repository / "setup.py").write_text("")
    with pytest.raises(release.ReleaseError, match="has changes"):
        release.release("0.2.0")


def test_the_changelog_has_one_entry_for_each_of_a_released_version():
    text = release.changelog(MARKDOWN.replace("unreleased", "2026-12-01"), "tapping_cell")
    assert text.splitlines()[3:] == [
        "",
        "0.2.0 (2026-12-01)",
        "------------------",
        "* Nodes: ``frame_prefix`` of every node (how-to), and \\*more\\*\\_.",
        "* Nodes: Second.",
        "* Fixed: ``a``\\ s.",
        "",
        "0.1.0 (2026-11-21)",
        "------------------",
        "* The first version.",
    ]
    assert release.changelog(MARKDOWN, "tapping_cell_msgs").count("* ") == 1


def test_the_package_manifests_are_valid():
    lint = pytest.importorskip("ament_xmllint.main", reason="ament_xmllint is not installed")
    files = [ROOT / "package.xml", ROOT / "msg_defs/package.xml", ROOT / "config"]
    assert lint.main([str(file) for file in files]) == 0
