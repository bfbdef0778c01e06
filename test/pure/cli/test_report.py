"""The verb report rewrites run folders, reads single bags, and compares runs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from made_bags import STOPS, MadeRun

from tapping_cell.cli import main
from tapping_cell.report.run_folder import write_folder


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write three runs as a recorder does, and the folder of the nodes' logs."""
    root = tmp_path_factory.mktemp("written")
    for name, made in (
        ("good", MadeRun(STOPS)),
        ("bad", MadeRun(STOPS, state=8, code=503, sentence="alarm")),
        ("refused", MadeRun(STOPS[:1], refused=True, state=8, code=103, sentence="off")),
    ):
        folder = root / name
        folder.mkdir()
        made.write(folder)
        write_folder(folder, pictures=False)
    (root / "up").mkdir()
    return root


@pytest.fixture
def runs(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "runs"))


def test_a_run_is_reported_again_with_and_without_its_bag(runs, capsys):
    folder = runs / "good"
    (folder / "summary.json").unlink()
    assert main(["report", str(folder)]) == 0
    assert "report.html" in capsys.readouterr().out
    first = json.loads((folder / "summary.json").read_text())
    shutil.rmtree(folder / "bag")
    (folder / "report.html").unlink()
    (folder / "cell.png").unlink()
    assert main(["report", str(folder)]) == 0
    again = json.loads((folder / "summary.json").read_text())
    assert set(again) == set(first) and again["outcome"] == first["outcome"] == "reached"
    assert again["measured_residual"] == pytest.approx(first["measured_residual"], abs=1e-3)
    assert (folder / "report.html").exists() and (folder / "cell.png").exists()


def test_a_bag_alone_is_reported_into_another_folder(runs: Path, tmp_path: Path) -> None:
    bag = tmp_path / "rescued.mcap"
    shutil.copy(runs / "bad" / "bag" / "bag.mcap", bag)
    assert main(["report", str(bag), "--output", str(tmp_path / "told")]) == 0
    content = json.loads((tmp_path / "told" / "summary.json").read_text())
    assert (content["outcome"], content["error_code"]) == ("failed", 503)


def test_runs_are_compared(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [str(path) for path in sorted(runs.iterdir())]
    assert main(["report", *words, "--output", str(runs / "all"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in result["runs"]] == ["bad", "good", "refused"]
    (group,) = result["groups"]
    assert (group["planner"], group["runs"], group["reached"]) == ("optimal", 3, 1)
    assert group["taps"] == 2.0
    page = (runs / "all" / "comparison.html").read_text()
    assert "3 runs, 1 reached their goal" in page and 'href="../good/report.html"' in page


def test_a_copy_of_a_run_is_counted_once(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(runs / "good", runs / "copy")
    words = [str(runs / name) for name in ("good", "good", "bad", "copy")]
    assert main(["report", *words, "--output", str(runs / "all"), "--json"]) == 0
    output = capsys.readouterr()
    assert [row["name"] for row in json.loads(output.out)["runs"]] == ["good", "bad"]
    assert f"{runs / 'copy'} is the same run as {runs / 'good'}: counted once" in output.err


def test_files_that_are_no_bags_are_skipped_among_several_paths(runs, capsys):
    (runs / "comparison.html").touch()  # of an earlier comparison
    assert main(["report", *(str(path) for path in sorted(runs.iterdir()))]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert f"{runs / 'comparison.html'} is not a run: skipped" in output
    assert main(["report", str(runs / "comparison.html")]) == 2
    assert "give the folder of the run" in " ".join(capsys.readouterr().err.split())
    assert main(["report", str(runs / "nowhere.html"), str(runs / "good")]) == 1


def test_bags_of_other_formats_are_named_with_the_conversion(runs, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(runs / "good", folder)
    (folder / "bag" / "bag.mcap").rename(folder / "bag" / "bag.mcap.zstd")
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    (tmp_path / "a.mcap").write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    for path, words in (
        (folder, f"`zstd -d {folder / 'bag' / 'bag.mcap.zstd'}`"),
        (tmp_path / "old.bag", "is a bag of ROS 1; convert it"),
        (tmp_path / "a.mcap", "of git LFS with `git lfs pull`"),
    ):
        assert main(["report", str(path)]) == 2
        assert words in " ".join(capsys.readouterr().err.split())


def test_an_invalid_run_folder_is_refused_with_a_message(runs, tmp_path, capsys):
    assert main(["report", str(runs / "up")]) == 2
    assert main(["report", str(tmp_path / "nowhere")]) == 2
    (tmp_path / "text.mcap").write_text("hello")
    assert main(["report", str(tmp_path / "text.mcap"), str(runs / "good")]) == 1
    assert main(["report", str(runs)]) == 2
    result = " ".join(capsys.readouterr().err.split())
    assert "is this a run folder?" in result and "not an MCAP file" in result
    assert f"{runs} is no run folder, but contains 3; give {runs}/*" in result
