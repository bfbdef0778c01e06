"""Calibrated files are never replaced silently, and a more accurate one is not replaced by --force
alone."""

from __future__ import annotations

import errno
import os
import resource
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tapping_cell.calibration.keep import (
    KEPT,
    KeptFile,
    Output,
    earlier_files,
    now,
    refuse_existing,
    undo,
    undone_files,
    write_kept,
)
from tapping_cell.configuration.provenance import Provenance, provenance_yaml, read_provenance
from tapping_cell.configuration.schema import ConfigurationError

OLD = Provenance(
    by="calibrate arm",
    made=now(),
    inputs=("poses.csv sha256 0123456789ab",),
    observations=20,
    left_out=1,
    residual=1e-4,
    residual_of="points, m",
    uncertainty=2e-4,
    uncertainty_of="wrist, m",
    deviations={"base_x": 1e-5},
    notes=("a note: with a colon", "# and a hash"),
)


def write(output: Output, record: Provenance) -> None:
    write_kept(output, provenance_yaml(record), record, read_provenance)


def test_a_record_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    write(Output(tmp_path / "a.yaml"), OLD)
    assert read_provenance(tmp_path / "a.yaml") == OLD
    assert [path.name for path in tmp_path.iterdir()] == ["a.yaml"]


def test_an_existing_file_is_kept_without_force(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("anything")
    for act in (lambda: write(Output(path), OLD), lambda: refuse_existing(Output(path))):
        with pytest.raises(KeptFile, match="--force"):
            act()
    assert path.read_text() == "anything"


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(KeptFile, match="does not exist"):
        refuse_existing(Output(tmp_path / "none" / "a.yaml"))


@settings(max_examples=settings.default.max_examples // 5)
@given(residual=st.floats(0.0, 1.0), uncertainty=st.floats(0.0, 1.0))
def test_force_replaces_only_a_file_that_is_not_better(
    tmp_path_factory: pytest.TempPathFactory, residual: float, uncertainty: float
) -> None:
    path = tmp_path_factory.mktemp("keep") / "a.yaml"
    write(Output(path), OLD)
    new = replace(OLD, residual=float(f"{residual:.6g}"), uncertainty=float(f"{uncertainty:.6g}"))
    worse = new.residual > 1.01 * OLD.residual or new.uncertainty > 1.01 * OLD.uncertainty
    if worse:
        with pytest.raises(KeptFile, match="more accurate than the new one and was kept"):
            write(Output(path, force=True), new)
        assert read_provenance(path) == OLD
    else:
        write(Output(path, force=True), new)
        assert read_provenance(path) == new
    write(Output(path, force=True, accept_worse=True), new)
    assert read_provenance(path) == new


@pytest.mark.parametrize("content", ["by hand: yes", "calibration: {by: someone}", "[", "\0"])
def test_force_replaces_a_file_without_a_record(tmp_path: Path, content: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(content)
    write(Output(path, force=True), OLD)
    assert read_provenance(path) == OLD


def test_a_file_that_the_reader_refuses_is_never_written(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    write(Output(path), OLD)
    with pytest.raises(ConfigurationError):
        write_kept(Output(path, force=True), "calibration: 5", OLD, read_provenance)
    assert read_provenance(path) == OLD
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.yaml"]


@pytest.mark.parametrize("links", [True, False], ids=["hard links", "no hard links"])
def test_a_disk_that_fills_up_leaves_no_incomplete_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    """The disk is full after the draft was written: from then on, a limit of the file size prevents
    writing."""
    if not links:
        monkeypatch.setattr(os, "link", refused_link)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def read_and_fill(draft: Path) -> None:
        read_provenance(draft)
        resource.setrlimit(resource.RLIMIT_FSIZE, (50, hard))

    path = tmp_path / "a.yaml"
    try:
        write_kept(Output(path), provenance_yaml(OLD), OLD, read_and_fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert read_provenance(path) == OLD
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.yaml"]


@pytest.mark.parametrize("links", [True, False], ids=["hard links", "no hard links"])
def test_a_file_created_in_the_meantime_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    if not links:
        monkeypatch.setattr(os, "link", refused_link)
    path = tmp_path / "a.yaml"
    with pytest.raises(KeptFile, match="--force to replace it"):
        write_kept(Output(path), provenance_yaml(OLD), OLD, lambda draft: path.write_text("other"))
    assert path.read_text() == "other"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.yaml"]


def refused_link(source: Path, target: Path) -> None:
    raise PermissionError(errno.EPERM, "Operation not permitted")


def test_the_last_ten_contents_are_kept_and_come_back_in_reverse_order(tmp_path: Path) -> None:
    path = tmp_path / "a[1].yaml"
    for number in range(KEPT + 5):
        write(Output(path, force=True, accept_worse=True), replace(OLD, observations=number))
    assert len(earlier_files(path)) == KEPT
    for number in range(KEPT + 3, 3, -1):
        undo(path, read_provenance)
        found = read_provenance(path)
        assert found is not None and found.observations == number
    with pytest.raises(KeptFile, match="no earlier content"):
        undo(path, read_provenance)
    assert found == read_provenance(path)


def test_an_earlier_content_that_is_damaged_is_not_restored(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    for _ in range(2):
        write(Output(path, force=True), OLD)
    earlier_files(path)[0].write_text("calibration: {by: someone}")
    with pytest.raises(ConfigurationError):
        undo(path, read_provenance)
    assert read_provenance(path) == OLD and len(earlier_files(path)) == 1


def test_undo_twice_loses_nothing_and_keeps_the_rights(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    for number in range(3):
        write(Output(path, force=True), replace(OLD, observations=number))
        path.chmod(0o640)
    for _ in range(2):
        undo(path, read_provenance)
        assert path.stat().st_mode & 0o777 == 0o640
    found = [read_provenance(one) for one in undone_files(path)]
    assert [one and one.observations for one in found] == [1, 2]
    write(Output(path, force=True), OLD)
    assert path.stat().st_mode & 0o777 == 0o640
