"""The set-up: its refusals, pinned versions, and what is installed and declared."""

import ast
import importlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NODES = (
    "overhead_camera",
    "camera_pose",
    "tap_planner",
    "scara_arm",
    "tapper_trigger",
    "sim_world",
    "operator_page",
    "run_recorder",
)
INTERFACES = sorted((ROOT / "msg_defs").glob("*/*.*"))


def load(path: Path):
    """Import a script of environment/ as a module."""
    specification = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


set_up = load(ROOT / "environment" / "set_up.py")
run_tests = load(ROOT / "environment" / "run_tests.py")


# ---- the stages of the set-up


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """Make the functions of the set-up work in an empty folder."""
    monkeypatch.setattr(set_up, "ROOT", tmp_path)
    monkeypatch.setattr(set_up, "LOG", tmp_path / "log")
    return tmp_path


def test_a_fingerprint_depends_on_content_name_and_arguments(elsewhere):
    first, second = elsewhere / "a.msg", elsewhere / "b.msg"
    first.write_text("bool x")
    second.write_text("bool y")
    before = set_up.fingerprint([first, second], "3.12")
    assert set_up.fingerprint([second, first], "3.12") == before
    assert set_up.fingerprint([first, second], "3.13") != before
    assert set_up.fingerprint([first], "3.12") != before
    second.write_text("bool z")
    assert set_up.fingerprint([first, second], "3.12") != before
    second.write_text("bool y")
    assert set_up.fingerprint([first, second], "3.12") == before
    moved = second.rename(elsewhere / "c.msg")
    assert set_up.fingerprint([first, moved], "3.12") != before


def test_a_stage_without_its_stamp_is_not_complete(elsewhere):
    stamp = elsewhere / ".fingerprint"
    assert not set_up.is_made(stamp, "abc")
    set_up.write_stamp(stamp, "abc")
    assert set_up.is_made(stamp, "abc")
    assert not set_up.is_made(stamp, "abd")
    assert [file.name for file in elsewhere.iterdir()] == [".fingerprint"]


def test_too_little_disk_is_refused_with_value_and_limit(monkeypatch):
    usage = shutil.disk_usage("/")._replace(free=1.25e9)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    set_up.require_disk(1.2e9)
    with pytest.raises(set_up.SetUpError, match=r"1\.25 GB free .* needs 2\.0 GB: free some"):
        set_up.require_disk(2.0e9)


@pytest.mark.parametrize("name", ["a cell", "cell:2", "Zelle-ü", "$cell", "a'b"])
def test_a_folder_that_breaks_colcon_scripts_is_refused(name, monkeypatch):
    monkeypatch.setattr(set_up, "ROOT", Path("/home/me") / name)
    with pytest.raises(set_up.SetUpError, match="move the cell"):
        set_up.require_plain_path()


def test_an_ordinary_folder_is_accepted(monkeypatch):
    monkeypatch.setattr(set_up, "ROOT", Path("/home/me/ros2_ws/src/tapping-cell.v2+main@x"))
    set_up.require_plain_path()


@pytest.mark.parametrize("version", [(3, 9), (3, 14), (2, 7), (4, 10)])
def test_an_unsupported_python_is_refused(version):
    with pytest.raises(set_up.SetUpError, match=rf"{version[0]}\.{version[1]} .* 3\.10 to 3\.13"):
        set_up.require_python(version)


@pytest.mark.parametrize("version", [(3, 10), (3, 11), (3, 12), (3, 13)])
def test_a_supported_python_is_accepted(version):
    set_up.require_python(version)


@pytest.mark.parametrize("missing", [("g++",), ("cmake",), ("make",), ("cmake", "g++")])
def test_missing_build_tools_are_named(missing, monkeypatch):
    for variable in ("CC", "CXX"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(shutil, "which", lambda tool: None if tool in missing else f"/bin/{tool}")
    with pytest.raises(set_up.SetUpError, match=re.escape(f"apt install {' '.join(missing)})")):
        set_up.require_build_tools()


def test_a_machine_without_wheels_is_refused(monkeypatch):
    monkeypatch.setattr(set_up.platform, "machine", lambda: "riscv64")
    with pytest.raises(set_up.SetUpError, match="riscv64.*x86_64.*/opt/ros/jazzy"):
        set_up.require_wheel_platform()


def test_an_old_c_library_is_refused(monkeypatch):
    monkeypatch.setattr(set_up.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(set_up.platform, "libc_ver", lambda: ("glibc", "2.17"))
    with pytest.raises(set_up.SetUpError, match=r"glibc 2\.17 .* 2\.28"):
        set_up.require_wheel_platform()


@pytest.mark.parametrize(
    ("output", "cause"),
    [
        ("OSError: [Errno 28] No space left on device", "the disk is full"),
        ("Retrying after NewConnectionError('...Connection refused')", "does not answer"),
        ("CERTIFICATE_VERIFY_FAILED", "set PIP_CERT"),
        (
            'Could not find a package configuration file provided by "geometry_msgs" with',
            "the ROS 2 package geometry_msgs is not installed: call  rosdep",
        ),
        ("ModuleNotFoundError: No module named 'colcon_core'", "python3-colcon"),
        (
            "ERROR: THESE PACKAGES DO NOT MATCH THE HASHES FROM THE REQUIREMENTS FILE.",
            "another file",
        ),
        ("fine\nfatal error: no such type\nmore", "fatal error: no such type"),
        ("one\ntwo", "one"),
        ("", "printed nothing"),
    ],
)
def test_the_cause_of_a_failure_is_found_in_its_output(output, cause):
    assert cause in set_up.cause_of(output)


def test_a_failing_program_keeps_its_output(elsewhere, monkeypatch):
    log = elsewhere / "log" / "x.log"
    words = [sys.executable, "-c", "print('error: planted'); raise SystemExit(3)"]
    with pytest.raises(set_up.SetUpError, match=r"building x failed: error: planted .*log/x\.log"):
        set_up.run(words, log, "building x failed")
    assert log.read_text() == "error: planted\n"


def test_the_build_does_not_see_other_environments():
    outside = {
        "PATH": "/usr/bin",
        "HOME": "/home/me",
        "HTTPS_PROXY": "http://proxy",
        "PIP_INDEX_URL": "https://mirror",
        "PYTHONPATH": "/other/python",
        "PYTHONHOME": "/other",
        "AMENT_PREFIX_PATH": "/other/ros",
        "LD_LIBRARY_PATH": "/other/lib",
        "MAKEFLAGS": "-j8 --jobserver-auth=3,4",
        "PIP_USER": "1",
        "PIP_TARGET": "/elsewhere",
        "COLCON_DEFAULTS_FILE": "/home/me/defaults.yaml",
    }
    seen = set_up.build_environment(outside, sourced=False)
    assert "other" not in " ".join(seen.values())
    assert seen["MAKEFLAGS"] == f"-j{len(os.sched_getaffinity(0))}"
    assert {"PIP_TARGET", "PYTHONPATH", "PYTHONHOME"}.isdisjoint(seen)
    assert seen["PIP_USER"] == "0"
    assert seen["COLCON_DEFAULTS_FILE"] == os.devnull
    for kept in ("HOME", "HTTPS_PROXY", "PIP_INDEX_URL"):
        assert seen[kept] == outside[kept]


def test_a_sourced_ros_is_kept_without_the_additions_of_env_sh():
    own = ROOT / "install" / "tapping_cell"
    seen = set_up.build_environment(
        {
            "AMENT_PREFIX_PATH": f"{own}:/opt/ros/jazzy",
            "PYTHONPATH": f"{ROOT}/build/tapping_cell:/opt/ros/jazzy/lib/python3.12/site-packages",
            "ROS_DISTRO": "jazzy",
        },
        sourced=True,
    )
    assert seen["AMENT_PREFIX_PATH"] == "/opt/ros/jazzy"
    assert seen["PYTHONPATH"] == "/opt/ros/jazzy/lib/python3.12/site-packages"
    assert seen["ROS_DISTRO"] == "jazzy"


def test_exported_header_folders_are_replaced():
    image = "/opt/python/cp311-cp311"
    text = f"{image}/lib/python3.11/site-packages/numpy/_core/include;{image}/include/python3.11;/x"
    assert set_up.replace_image_paths(text, "/py/include", "/np") == "/np;/py/include;/x"


# ---- the lock file


def pins(lines):
    return {
        re.sub(r"[-_.]+", "-", name).lower(): version
        for name, version in re.findall(r"^([\w.-]+)(?:\[\w+\])?==([^\s;]+)", lines, re.MULTILINE)
    }


def test_the_lock_contains_every_requirement():
    locked = pins((ROOT / "requirements.lock").read_text())
    required = pins((ROOT / "environment" / "requirements.in").read_text())
    assert len(required) > 30
    assert {name: locked.get(name) for name in required} == required


def test_every_line_of_the_lock_is_exact_and_has_hashes():
    lines = set_up.pinned((ROOT / "requirements.lock").read_text(), sourced=False)
    requirement = r"[\w.-]+==[\w.]+( ; [\w' <>=!.]+)?"
    hashed = rf"{requirement}( +--hash=sha256:[0-9a-f]{{64}})+ *"
    assert [line for line in lines if not re.fullmatch(hashed, line)] == []


def test_ros_from_apt_keeps_its_own_ros_and_numpy():
    text = (ROOT / "requirements.lock").read_text()
    names = {line.split("==")[0] for line in set_up.pinned(text, sourced=True)}
    assert {"opencv-python-headless", "scipy", "pytest", "hypothesis", "ruff"} <= names
    assert not [name for name in names if name.startswith(("ros-", "colcon-", "numpy"))]


def test_a_requirement_and_its_hashes_are_one_line():
    text = "# words\na==1 \\\n  --hash=sha256:0 \\\n  --hash=sha256:1\nros-b==2 --hash=sha256:2\n"
    lines = [line.split() for line in set_up.pinned(text, sourced=False)]
    assert lines == [
        ["a==1", "--hash=sha256:0", "--hash=sha256:1"],
        ["ros-b==2", "--hash=sha256:2"],
    ]
    assert len(set_up.pinned(text, sourced=True)) == 1


# ---- env.sh in a shell


@pytest.fixture
def bare(tmp_path):
    """Copy only the set-up, so that the tests build nothing in the real folder."""
    for name in ("env.sh", "requirements.lock", "setup.py", "setup.cfg", "package.xml"):
        shutil.copy(ROOT / name, tmp_path)
    for name in ("environment", "msg_defs", "resource"):
        shutil.copytree(ROOT / name, tmp_path / name)
    return tmp_path


def shell(script: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {"PATH": os.environ["PATH"], "HOME": "/nonexistent", **variables}
    return subprocess.run(
        ["bash", "--norc", "-c", script],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.parametrize("options", ["", "set -e;", "set -u;", "set -eu;", "set -euo pipefail;"])
def test_a_failed_set_up_does_not_end_the_shell(bare, options):
    script = (
        f"{options} cd /; before=$(set | grep -v ^_ | cut -d= -f1; declare -F); f=$-;"
        f" . {bare}/env.sh && exit 9 || echo status $?;"
        " [ $- = $f ] && echo same options;"
        ' diff <(echo "$before") <(set | grep -v ^_ | cut -d= -f1; declare -F)'
        " | grep tapping || true"
    )
    done = shell(script, PYTHON="/nonexistent/python")
    assert done.stdout == "status 1\nsame options\n"
    assert re.fullmatch(r"tapping cell: .*/nonexistent/python does not run.*\n", done.stderr)
    assert done.returncode == 0


def test_another_ros_is_refused(bare):
    done = shell(f". {bare}/env.sh; echo $?", ROS_DISTRO="humble")
    assert done.stdout == "1\n"
    assert "ROS 2 humble sourced" in done.stderr


def test_env_sh_must_be_sourced(bare):
    done = shell(f"bash {bare}/env.sh")
    assert done.returncode == 1
    assert ". ./env.sh" in done.stderr


def test_without_the_environment_a_verb_names_the_command_to_run():
    done = subprocess.run(
        [
            sys.executable,
            "-I",
            "-S",
            "-c",
            "import sys; sys.path.insert(0, sys.argv.pop(1));"
            "from tapping_cell.cli import main; sys.exit(main(['up']))",
            str(ROOT),
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "cannot import 'rich'" in done.stderr and ". ./env.sh" in done.stderr
    assert "Traceback" not in done.stderr


def test_another_shell_gets_a_message(bare):
    done = shell(f"sh -c '. {bare}/env.sh; echo $?'")
    assert "bash" in done.stderr
    assert done.stderr.count("\n") == 1


built = pytest.mark.skipif(
    not (ROOT / "install" / "tapping_cell" / ".fingerprint").is_file(),
    reason="env.sh has not built this folder: these tests ran without `make test`",
)


@built
def test_a_second_set_up_skips_all_work():
    done = shell(f"cd /; set -eu; . '{ROOT}/env.sh'; echo $ROS_AUTOMATIC_DISCOVERY_RANGE; cd ~-")
    assert (done.stderr, done.returncode) == ("", 0)
    assert done.stdout.splitlines()[0] in {"LOCALHOST", "SUBNET"}


@built
def test_the_users_own_settings_are_kept():
    done = shell(
        f". '{ROOT}/env.sh'; . '{ROOT}/env.sh';"
        " echo $ROS_AUTOMATIC_DISCOVERY_RANGE $FASTRTPS_DEFAULT_PROFILES_FILE;"
        f" echo $PATH | tr : '\\n' | grep -cx '{ROOT}/.venv/bin'",
        ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET",
        FASTRTPS_DEFAULT_PROFILES_FILE="/my/profile.xml",
        PATH="/usr/bin:/bin",
    )
    assert done.stdout == "SUBNET /my/profile.xml\n1\n"


@built
def test_sourcing_again_puts_the_cells_python_first_again(tmp_path):
    other = tmp_path / "python"
    other.write_text("#!/bin/sh\necho another python\n")
    other.chmod(0o755)
    done = shell(
        f". '{ROOT}/env.sh'; once=$PATH; . '{ROOT}/env.sh';"
        ' [ "$PATH" = "$once" ] || echo moved;'
        f" PATH={tmp_path}:$PATH; bash --norc -c \". '{ROOT}/env.sh'; command -v python\""
    )
    assert (done.stdout, done.stderr) == (f"{ROOT}/.venv/bin/python\n", "")


@built
def test_every_executable_and_data_file_is_installed():
    prefix = ROOT / "install" / "tapping_cell"
    executables = {file.name for file in (prefix / "lib" / "tapping_cell").iterdir()}
    assert executables == {*NODES, "cell"}
    for folder in ("config", "launch"):
        for file in (ROOT / folder).rglob("*"):
            if file.is_file() and "__pycache__" not in file.parts:
                installed = prefix / "share" / "tapping_cell" / file.relative_to(ROOT)
                assert installed.read_bytes() == file.read_bytes(), file


# ---- declarations of the packages


def dependencies(package_xml: Path) -> set[str]:
    return {
        element.text
        for element in ElementTree.parse(package_xml).getroot()
        if element.tag.endswith("depend")
    }


def test_every_imported_package_is_declared():
    keys = {"cv2": "python3-opencv", "yaml": "python3-yaml", "serial": "python3-serial"}
    keys |= {"PIL": "python3-pil"}
    declared = dependencies(ROOT / "package.xml")
    imported = set()
    for file in [*(ROOT / "tapping_cell").rglob("*.py"), *(ROOT / "launch").rglob("*.py")]:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                imported.add(node.module.split(".")[0])
            elif isinstance(node, ast.Import):
                imported.update(alias.name.split(".")[0] for alias in node.names)
    # README.md says what they are for
    optional = {
        "distributed",
        "gymnasium",
        "prometheus_client",
        "pyarrow",
        "rosbags",
        "vision_msgs",
    }
    outside = imported - set(sys.stdlib_module_names) - {"tapping_cell"} - optional
    assert {"numpy", "rclpy"} <= outside
    undeclared = {
        name for name in outside if not {name, keys.get(name, f"python3-{name}")} & declared
    }
    assert undeclared == set()


def test_a_build_without_the_messages_names_the_line_that_works(tmp_path):
    for name in ("setup.py", "setup.cfg"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / "tapping_cell" / "nodes").mkdir(parents=True)
    shutil.copy(ROOT / "tapping_cell" / "nodes" / "__init__.py", tmp_path / "tapping_cell/nodes")
    for prefixes, expected in (("", 1), (str(tmp_path / "prefix"), 0)):
        (tmp_path / "prefix" / "share" / "tapping_cell_msgs").mkdir(parents=True, exist_ok=True)
        done = subprocess.run(
            [sys.executable, "setup.py", "egg_info"],
            cwd=tmp_path,
            env={**os.environ, "AMENT_PREFIX_PATH": prefixes},
            capture_output=True,
            text=True,
        )
        assert done.returncode == expected, done.stderr
        line = f"colcon build --base-paths {tmp_path} {tmp_path}/msg_defs"
        assert (line in done.stderr) == bool(expected)


def test_every_file_of_the_package_is_installed(tmp_path):
    """Data files, such as the operator's page and the templates of the reports, are included."""
    (tmp_path / "prefix" / "share" / "tapping_cell_msgs").mkdir(parents=True)
    command = ["egg_info", "--egg-base", str(tmp_path), "build_py", "--build-lib", str(tmp_path)]
    subprocess.run(
        [sys.executable, "setup.py", *command],
        cwd=ROOT,
        env={**os.environ, "AMENT_PREFIX_PATH": str(tmp_path / "prefix")},
        capture_output=True,
        check=True,
    )
    files = [file.relative_to(ROOT) for file in set_up.files_below(ROOT / "tapping_cell")]
    assert Path("tapping_cell/report/templates/base.html") in files
    assert [file for file in files if not (tmp_path / file).is_file()] == []


def test_versions_and_licences_agree():
    manifests = [ROOT / "package.xml", ROOT / "msg_defs" / "package.xml"]
    roots = [ElementTree.parse(file).getroot() for file in manifests]
    assert {root.findtext("license") for root in roots} == {"Apache-2.0"}
    versions = {root.findtext("version") for root in roots}
    setup_text = (ROOT / "setup.py").read_text()
    versions |= set(re.findall(r'version="([\d.]+)"', setup_text))
    versions |= set(
        re.findall(r'__version__ = "(.+)"', (ROOT / "tapping_cell" / "__init__.py").read_text())
    )
    assert len(versions) == 1
    for folder in (ROOT, ROOT / "msg_defs"):
        assert "Apache License" in (folder / "LICENSE").read_text()


def test_every_interface_is_generated():
    listed = (ROOT / "msg_defs" / "CMakeLists.txt").read_text()
    assert len(INTERFACES) >= 9
    for file in INTERFACES:
        assert f"  {file.relative_to(ROOT / 'msg_defs')}\n" in listed


@pytest.mark.parametrize("file", INTERFACES, ids=lambda file: file.name)
def test_every_field_has_a_description(file):
    for line in file.read_text().splitlines():
        if line.strip() and line.strip() != "---":
            assert re.search(r"#.*\w{2}", line), f"{file.name}: no comment on: {line}"


def test_error_codes_are_one_numbered_list():
    text = (ROOT / "msg_defs" / "msg" / "ErrorCode.msg").read_text()
    codes = re.findall(r"^uint16 ([A-Z_]+) = (\d+) +#", text, re.MULTILINE)
    assert len(codes) > 50
    assert len({name for name, _ in codes}) == len({number for _, number in codes}) == len(codes)
    hundreds = {"CONFIGURATION": 2, "CAMERA": 3, "OBJECT": 3, "ARM": 5, "TAPPER": 6, "GOAL": 1}
    for name, number in codes:
        family = name.split("_")[0]
        assert int(number) // 100 == hundreds.get(family, int(number) // 100), name
        assert int(number) // 100 in {0, 1, 2, 3, 4, 5, 6, 9}


# ---- groups of tests ("rings")


def test_pytest_summary_lines_are_summed():
    counts = run_tests.counts_of("=== 2 failed, 10 passed, 1 warning, 1 error in 3.21s ===")
    counts += run_tests.counts_of("=== 5 passed, 3 skipped, 2 warnings in 61.00s (0:01:01) ===")
    line = run_tests.closing_line(counts, 64.5)
    assert line.strip("= ") == ("2 failed, 15 passed, 3 skipped, 3 warnings, 1 errors in 64.50s")


PASSED, FAILED, NONE = ("1 passed", 0), ("1 failed", 1), ("no tests ran", 5)
ONE_OF_TWO = "1 failed, 1 passed, 1 repeated"


@pytest.mark.parametrize(
    ("rings", "options", "status", "closing"),
    [
        ({"pure": PASSED, "pty": PASSED}, (), 0, "2 passed"),
        ({"pure": FAILED, "pty": PASSED}, (), 1, "1 failed, 1 passed"),
        ({"pure": PASSED, "pty": FAILED}, (), 1, "1 failed, 1 passed"),
        (
            {"pure": FAILED, "pty": FAILED, "pty again": PASSED},
            (),
            1,
            "1 failed, 1 passed, 1 repeated",
        ),
        ({"pure": PASSED, "pty": FAILED, "pty again": PASSED}, (), 0, "2 passed, 1 repeated"),
        ({"pure": PASSED, "pty": FAILED, "pty again": NONE}, (), 1, "1 passed, 1 errors"),
        ({"pure": PASSED, "pty": NONE}, (), 1, "1 passed"),
        ({"pure": PASSED, "pty": NONE}, ("-k", "it"), 0, "1 passed"),
        ({"pure": PASSED}, (), 1, "1 passed"),
        ({"pure": NONE, "pty": NONE}, ("-k", "nothing"), 1, "no tests ran"),
    ],
)
def test_a_failing_test_ring_fails_the_whole_run(
    tmp_path, monkeypatch, capsys, rings, options, status, closing
):
    """``rings``: the closing line and the exit code of the tests of each ring, and of those that
    are repeated because they failed."""

    def started(ring, given):
        repeated = "--last-failed" in given
        words, code = rings.get(f"{ring} again", rings[ring]) if repeated else rings[ring]
        line = f"echo '=== {words} in 0.01s ==='; exit {code}"
        return subprocess.Popen(["sh", "-c", line], stdout=subprocess.PIPE, text=True)

    monkeypatch.setattr(run_tests, "ROOT", tmp_path)
    monkeypatch.setattr(run_tests, "RINGS", {"pure": ("pure",), "pty": ("pty",)})
    monkeypatch.setattr(run_tests, "started", started)
    for ring in rings:
        (tmp_path / "test" / ring).mkdir(parents=True)
    assert run_tests.main(options) == status
    assert f" {closing} in " in capsys.readouterr().out.splitlines()[-1]


@pytest.mark.parametrize("asserted", [True, False])
def test_a_ring_is_run_by_pytest(tmp_path, monkeypatch, asserted):
    monkeypatch.setattr(run_tests, "ROOT", tmp_path)
    monkeypatch.setattr(run_tests, "RINGS", {"pure": ("pure",)})
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)
    folder = tmp_path / "test" / "pure"
    folder.mkdir(parents=True)
    (folder / "test_pure.py").write_text(f"def test_it(): assert {asserted}\n")
    process = run_tests.started("pure", ())
    output, _ = process.communicate()
    expected = "passed" if asserted else "failed"
    assert run_tests.counts_of(output.splitlines()[-1]) == {expected: 1}
    assert process.returncode == (0 if asserted else 1)


def test_colcon_finds_the_tests():
    # colcon reports success if a package declares no tests.
    python = pytest.importorskip("colcon_core.task.python.test", reason="colcon is not installed")
    setup = importlib.import_module("colcon_python_setup_py.package_identification.python_setup_py")
    information = setup.get_setup_information(ROOT / "setup.py")
    assert python.has_test_dependency(information, "pytest")
