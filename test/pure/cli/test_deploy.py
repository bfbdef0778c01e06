"""``deploy`` writes a service that systemd accepts, and ``undeploy`` removes exactly that."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tapping_cell.calibration.keep import earlier_files, keep_earlier
from tapping_cell.cli import main
from tapping_cell.cli.deployment.adapters import Adapter, adapter_of
from tapping_cell.cli.deployment.cell_copy import copied_cell
from tapping_cell.cli.deployment.service import escaped
from tapping_cell.configuration.cell import load_cell, load_further_objects
from tapping_cell.configuration.files import shared_folder


def files_of(root: Path) -> set[str]:
    return {str(p.relative_to(root)) for p in root.rglob("*") if p.is_symlink() or p.is_file()}


def deploy(root: Path, *options: str) -> int:
    return main(["deploy", "--root", str(root), "--yes", *options])


def test_undeploy_removes_exactly_what_deploy_wrote(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc/fstab").write_text("# of the computer\n")
    assert main(["deploy", "--root", str(tmp_path), "--dry-run"]) == 0
    assert files_of(tmp_path) == {"etc/fstab"}, "a dry run writes nothing"
    assert "ExecStart=" in capsys.readouterr().out
    assert deploy(tmp_path, "--page") == 0
    assert len(files_of(tmp_path)) == 13
    load_cell(tmp_path / "etc/tapping_cell/cell.yaml")
    assert main(["undeploy", "--root", str(tmp_path), "--dry-run"]) == 0
    assert len(files_of(tmp_path)) == 13
    assert main(["undeploy", "--root", str(tmp_path), "--yes"]) == 0
    assert files_of(tmp_path) == {"etc/fstab"}
    assert main(["undeploy", "--root", str(tmp_path), "--yes"]) == 2


def test_a_calibrated_file_survives_deploy_and_undeploy(tmp_path: Path) -> None:
    assert deploy(tmp_path) == 0
    table = tmp_path / "etc/tapping_cell/table.yaml"
    calibrated = table.read_text() + "# calibrated\n"
    table.write_text(calibrated)
    assert deploy(tmp_path) == 0
    assert main(["undeploy", "--root", str(tmp_path), "--yes"]) == 0
    assert table.read_text() == calibrated
    configuration = "etc/tapping_cell"
    left = {f"{configuration}/table.yaml", f"{configuration}/undeployed.json"}
    assert files_of(tmp_path) == left
    assert deploy(tmp_path) == 0 and table.read_text() == calibrated
    (tmp_path / "var/lib/tapping_cell/runs").mkdir(parents=True)
    assert main(["undeploy", "--root", str(tmp_path), "--all", "--yes"]) == 0
    assert files_of(tmp_path) == set() and not (tmp_path / "var/lib/tapping_cell").exists()


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("etc/passwd", "root:x:0:0::/root:/bin/sh\nother:x:1000:1000::/home/other:/bin/sh\n"),
        ("etc/group", "other:x:27:\n"),
        ("etc/other/settings", "x"),
        ("var/lib/other/data", "x"),
        ("usr/lib/systemd/system/other.service", "x"),
        ("etc/logrotate.d/other", "x"),
    ],
)
def test_what_is_not_of_deploy_is_not_taken_over(tmp_path: Path, path: str, text: str) -> None:
    place = tmp_path / path
    place.parent.mkdir(parents=True)
    place.write_text(text)
    assert deploy(tmp_path, "--name", "other") == 2
    assert files_of(tmp_path) == {path} and place.read_text() == text
    assert deploy(tmp_path) == 0, "under another name, it can be deployed"


def test_the_user_belongs_to_deploy_and_everything_can_be_removed_later(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert deploy(tmp_path) == 0
    manifest = tmp_path / "etc/tapping_cell/deployed.json"
    assert json.loads(manifest.read_text())["user"] is True
    elsewhere = tmp_path / "disk"
    elsewhere.mkdir()
    (elsewhere / "run").write_text("x")
    state = tmp_path / "var/lib/tapping_cell"
    state.parent.mkdir(parents=True)
    state.symlink_to(elsewhere)
    assert main(["undeploy", "--root", str(tmp_path), "--yes"]) == 0
    assert deploy(tmp_path) == 0 and json.loads(manifest.read_text())["user"] is True
    assert main(["undeploy", "--root", str(tmp_path), "--yes"]) == 0
    assert main(["undeploy", "--root", str(tmp_path), "--all", "--yes"]) == 0
    assert files_of(tmp_path) == {"disk/run"}


def own_cell(folder: Path) -> Path:
    """Copy the package's configuration as that of a cell of another name."""
    shutil.copytree(shared_folder(), folder)
    cell = folder / "cell.yaml"
    cell.write_text(cell.read_text().replace("name: tapping cell", "name: mine"))
    return cell


def test_another_cell_replaces_the_deployed_one_and_keeps_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, cell = tmp_path / "root", own_cell(tmp_path / "config")
    assert deploy(root) == 0
    deployed = root / "etc/tapping_cell/cell.yaml"
    first = deployed.read_text()
    assert deploy(root, "--cell", str(cell)) == 0
    assert "name: mine" in deployed.read_text()
    assert "cell.yaml differs from this cell" in capsys.readouterr().out
    (earlier,) = earlier_files(deployed)
    assert earlier.read_text() == first
    # The same cell again, with other options: what was calibrated since stays.
    deployed.write_text(deployed.read_text() + "# calibrated\n")
    assert deploy(root, "--cell", str(cell), "--page") == 0
    assert deployed.read_text().endswith("# calibrated\n")
    assert deploy(root) == 0 and deployed.read_text().endswith("# calibrated\n")


def test_a_file_that_was_changed_by_hand_is_kept_beside_the_new_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert deploy(tmp_path) == 0
    for path in ("etc/tapping_cell/cell.env", "etc/systemd/system/tapping_cell.service"):
        place = tmp_path / path
        text = place.read_text()
        place.write_text(text + "# by hand\n")
        assert deploy(tmp_path) == 0
        assert place.read_text() == text
        assert f"/{path} was changed" in capsys.readouterr().out
        (kept,) = (tmp_path / "etc/tapping_cell/.history").glob(f"{place.name}.*Z")
        assert kept.read_text().endswith("# by hand\n")
    assert deploy(tmp_path) == 0 and "replace" not in capsys.readouterr().out


def test_every_user_may_read_what_is_deployed(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        assert deploy(tmp_path / "root") == 0
    finally:
        os.umask(before)
    for path in (tmp_path / "root").rglob("*"):
        if not path.is_symlink():
            assert path.stat().st_mode & 0o777 == (0o755 if path.is_dir() else 0o644), path


def test_adapters_with_the_same_serial_number_are_known_by_their_sockets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without adapters, the next deployment removes their names."""
    cell = own_cell(tmp_path / "config")
    cell.write_text(cell.read_text().replace("~/.ros/tapping_cell/{cell}/", "/dev/none/"))
    root = tmp_path / "root"
    sockets = {"arm": "1-1", "tapper": "1-2", "video0": "1-3"}

    def found(port: Path) -> Adapter:
        kind = "video4linux" if port.name == "video0" else "tty"
        return Adapter(kind, "1a86", "7523", "0001" * (kind == "tty"), sockets[port.name], "00")

    monkeypatch.setattr("tapping_cell.cli.deploy.adapter_of", found)
    assert deploy(root, "--page") == 0, "the simulated cell of the how-to comes first"
    assert deploy(root, "--hardware", "--cell", str(cell)) == 0
    rules = root / "etc/udev/rules.d/70-tapping_cell.rules"
    assert "/dev/tapping_cell/arm" in (root / "etc/tapping_cell/cell.yaml").read_text()
    text = rules.read_text()
    assert "ATTRS{serial}" not in text
    assert all(f'KERNELS=="{socket}"' in text for socket in sockets.values())
    monkeypatch.setattr("tapping_cell.cli.deploy.adapter_of", lambda port: None)
    assert deploy(root, "--hardware", "--cell", str(cell)) == 0
    assert not rules.exists()
    assert main(["undeploy", "--root", str(root), "--all", "--yes"]) == 0
    assert files_of(root) == set()


def test_two_cells_share_nothing(tmp_path: Path) -> None:
    assert deploy(tmp_path, "--name", "left", "--domain", "1") == 0
    left = files_of(tmp_path)
    assert deploy(tmp_path, "--name", "right", "--domain", "2") == 0
    assert main(["undeploy", "--name", "right", "--root", str(tmp_path), "--yes"]) == 0
    assert files_of(tmp_path) == left
    assert "ROS_DOMAIN_ID=1\n" in (tmp_path / "etc/left/cell.env").read_text()


def test_nothing_is_written_without_a_yes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("builtins.input", lambda _: "")
    assert main(["deploy", "--root", str(tmp_path)]) == 1
    assert files_of(tmp_path) == set()


@pytest.mark.parametrize(
    "options",
    [["--hardware"], ["--camera", "/dev/video1"], ["--domain", "300"]],
    ids=["a simulated cell file", "camera without hardware", "no domain"],
)
def test_wrong_input_is_refused(tmp_path: Path, options: list[str]) -> None:
    assert deploy(tmp_path, *options) == 2
    assert files_of(tmp_path) == set()


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd")
@pytest.mark.parametrize("hardware", [False, True])
def test_systemd_accepts_the_unit_and_rates_it_below_3(tmp_path: Path, hardware: bool) -> None:
    options = []
    if hardware:
        config = tmp_path / "config"
        shutil.copytree(shared_folder(), config)
        cell = config / "cell.yaml"
        text = cell.read_text().replace("~/.ros/tapping_cell/{cell}/", "/dev/none/")
        cell.write_text(text)
        options = ["--hardware", "--cell", str(cell), "--range", "SUBNET"]
    assert deploy(tmp_path / "root", *options) == 0
    unit = tmp_path / "root/etc/systemd/system/tapping_cell.service"
    verified = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True)
    assert not [line for line in verified.stderr.splitlines() if str(unit) in line]
    rated = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager", unit],
        capture_output=True,
        text=True,
    )
    if "unrecognized option" in rated.stderr:
        pytest.skip("this systemd does not rate files")
    exposure = float(rated.stdout.rpartition("service: ")[2].split()[0])
    assert exposure < 3.0


def usb(sys: Path, name: str, serial: str | None, subsystem: str = "tty") -> Path:
    """Make the part of sysfs of a USB adapter with the device ``name``."""
    device = sys / "devices/pci0/usb1/1-1/1-1.2"
    interface = device / "1-1.2:1.0"
    node = interface / "ttyUSB0" / subsystem / name
    node.mkdir(parents=True)
    for file, text in {"idVendor": "1a86", "idProduct": "7523", "serial": serial}.items():
        if text is not None:
            (device / file).write_text(text + "\n")
    (interface / "bInterfaceNumber").write_text("00\n")
    (node / "index").write_text("0\n")
    (sys / "class" / subsystem).mkdir(parents=True)
    (sys / "class" / subsystem / name).symlink_to(node)
    return Path("/dev") / name


@pytest.mark.parametrize(
    ("serial", "match"),
    [
        ("A9007UX1", 'ATTRS{serial}=="A9007UX1"'),
        (None, 'KERNELS=="1-1.2"'),
        ('x", RUN+="/bin/sh', 'KERNELS=="1-1.2"'),
    ],
    ids=["serial", "no serial", "hostile serial"],
)
def test_an_adapter_is_known_by_its_serial_number(
    tmp_path: Path, serial: str | None, match: str
) -> None:
    port = usb(tmp_path, "ttyUSB7", serial)
    found = adapter_of(port, tmp_path)
    assert found is not None
    rule = found.rule("tapping_cell/arm", "tapping_cell", "tapping_cell.service")
    assert match in rule and 'SYMLINK+="tapping_cell/arm"' in rule and "RUN" not in rule
    assert 'ENV{ID_USB_INTERFACE_NUM}=="00"' in rule and 'MODE="0660"' in rule
    assert adapter_of(Path("/dev/ttyS99"), tmp_path) is None


def test_a_camera_is_known_by_its_serial_number(tmp_path: Path) -> None:
    found = adapter_of(usb(tmp_path, "video2", "C9", "video4linux"), tmp_path)
    assert found is not None and 'ATTR{index}=="0"' in found.rule("cell/camera", "cell", "cell")


@pytest.mark.parametrize("name", ["cell.yaml", "positioning_cell/cell.yaml"])
def test_the_copy_of_a_cell_is_the_same_cell_with_other_ports(tmp_path: Path, name: str) -> None:
    cell = load_cell(shared_folder() / name)
    ports = {board.port: f"/dev/cell/tapper_{n}" for n, board in enumerate(cell.boards)}
    for path, text in copied_cell(cell, ports).items():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text(text)
    copy = load_cell(tmp_path / "cell.yaml")
    assert [board.port for board in copy.boards] == list(ports.values())
    assert copy.object == cell.object and copy.references == cell.references
    assert load_further_objects(copy) == load_further_objects(cell)


def test_a_link_is_escaped_as_systemd_does() -> None:
    assert escaped("tapping_cell/arm") == "tapping_cell-arm"
    assert escaped("left-cell/arm") == r"left\x2dcell-arm"


def test_undo_lists_and_takes_back_a_calibration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert deploy(tmp_path) == 0
    path = tmp_path / "etc/tapping_cell/cell.yaml"
    before = path.read_text()
    keep_earlier(path)
    path.write_text(before.replace("name: tapping cell", "name: calibrated"))
    assert main(["calibrate", "undo", str(path), "--list"]) == 0
    assert "no calibration record" in capsys.readouterr().out
    assert main(["calibrate", "undo", str(path)]) == 0
    assert path.read_text() == before
    assert main(["calibrate", "undo", str(path)]) == 2
