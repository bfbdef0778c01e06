"""Build what env.sh needs if it is missing or out of date: .venv, the messages, the package.

env.sh runs this file with the interpreter from which .venv is made, in isolated mode (``-I -S``),
so it uses only the standard library. At its end, each stage writes a fingerprint of all its inputs.
A stage that was interrupted has no fingerprint and is repeated from the beginning.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
BUILD = ROOT / "build"
INSTALL = ROOT / "install"
LOG = ROOT / "log"
LOCK = ROOT / "requirements.lock"

RECIPE = 2  # increase it after a change of the stages, so that they are built again
PYTHON_VERSIONS = ((3, 10), (3, 13))  # first and last version with ROS 2 Jazzy wheels
DISK_FOR_VENV = 2.0e9  # bytes; .venv needs 0.7e9, its downloads and the build need the rest
DISK_FOR_BUILD = 0.2e9  # bytes; the messages need 0.03e9
SIGN_OF_LIFE = 20  # s between progress messages of a long step
GLIBC = (2, 28)  # required by the ROS wheels
CMAKE = (3, 20)  # required by msg_defs/CMakeLists.txt

VERSION = f"{sys.version_info[0]}.{sys.version_info[1]}"  # of this interpreter

# These are built without pip's isolated build environments, with the setuptools version of the
# lock.
SOURCE_DISTRIBUTIONS = ("empy",)
# With ROS 2 from apt, these packages also come from apt, because the compiled messages of this ROS
# need the version of numpy from apt.
FROM_APT = ("ros-", "colcon-", "numpy", "empy", "lark-parser", "catkin-pkg", "setuptools")
# The build needs these packages. The other packages are installed while the messages are built.
BUILD_TOOLS = (*FROM_APT, "distlib", "packaging", "pyparsing", "python-dateutil", "six")
# Variables that would make pip, CMake or colcon use another environment or another make.
FOREIGN_VARIABLES = re.compile(
    r"PYTHON(HOME|STARTUP)|PIP_(USER|TARGET|PREFIX|REQUIREMENT|CONSTRAINT|NO_DEPS)|COLCON_.*"
    r"|VIRTUAL_ENV|CONDA_PREFIX|MAKEFLAGS|MAKELEVEL|MFLAGS|DESTDIR|CMAKE_(GENERATOR|INSTALL_PREFIX)"
)
ROS_VARIABLES = re.compile(
    r"AMENT_PREFIX_PATH|CMAKE_PREFIX_PATH|LD_LIBRARY_PATH|PKG_CONFIG_PATH|PYTHONPATH"
)


class SetUpError(RuntimeError):
    """Raised if the set-up cannot continue; the message gives the problem and the remedy."""


def report(message: str) -> None:
    """Print a progress message."""
    print(f"tapping cell: {message}", file=sys.stderr, flush=True)


# ---- inputs of a stage


def fingerprint(files: Iterable[Path], *texts: str) -> str:
    """Return one digest of the texts and of the files' names and contents."""
    digest = hashlib.sha256()
    for text in texts:
        digest.update(f"{text}\0".encode())
    for file in sorted(files):
        content = hashlib.sha256(file.read_bytes()).hexdigest()
        digest.update(f"{file.relative_to(ROOT)}\0{content}\0".encode())
    return digest.hexdigest()


def files_below(*folders: Path) -> list[Path]:
    """Return every file below the folders, except Python's caches."""
    return [
        file
        for folder in folders
        for file in folder.rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    ]


def is_made(stamp: Path, wanted: str) -> bool:
    """Return whether the stage that wrote this stamp was completed with these inputs."""
    try:
        return stamp.read_text() == wanted
    except OSError:
        return False


def write_stamp(stamp: Path, text: str) -> None:
    """Write the stamp atomically."""
    partial = stamp.with_name(stamp.name + ".partial")
    partial.write_text(text)
    partial.replace(stamp)


# ---- requirements of the machine


def require_disk(limit: float) -> None:
    """Raise `SetUpError` if less than ``limit`` bytes are free on the cell's disk."""
    free = shutil.disk_usage(ROOT).free
    if free < limit:
        raise SetUpError(
            f"the disk of {ROOT} has {free / 1e9:.2f} GB free and the set-up needs"
            f" {limit / 1e9:.1f} GB: free some space, or move the cell to a larger disk."
        )


def require_writable() -> None:
    """Raise `SetUpError` if the cell's folder cannot be written."""
    if os.access(ROOT, os.W_OK):
        return
    raise SetUpError(
        f"{ROOT} cannot be written by user {os.getuid()} and the set-up builds in it:"
        " copy the cell to a folder of yours."
    )


def require_plain_path() -> None:
    """Raise `SetUpError` if colcon's and pip's scripts would break in the cell's folder."""
    odd = re.findall(r"[^\w/.,+@=-]", str(ROOT), re.ASCII)
    if odd:
        raise SetUpError(
            f"the path of {ROOT} has the character {odd[0]!r} and the scripts that colcon writes"
            " work with ASCII letters, digits and / . , + @ = _ - only: move the cell to a path of"
            " such characters."
        )


def require_wheel_platform() -> None:
    """Raise `SetUpError` if no ROS 2 wheels exist for this machine."""
    machine = platform.machine()
    name, version = platform.libc_ver()
    wanted = f"Linux on x86_64 with glibc {GLIBC[0]}.{GLIBC[1]} or newer"
    advice = "use such a machine, or one with ROS 2 Jazzy in /opt/ros/jazzy."
    if sys.platform != "linux" or machine != "x86_64":
        raise SetUpError(
            f"this is {sys.platform} on {machine} and the ROS 2 wheels need {wanted}: {advice}"
        )
    if name != "glibc" or tuple(map(int, version.split(".")[:2])) < GLIBC:
        raise SetUpError(
            f"this machine's C library is {name or 'unknown'} {version} and the ROS 2 wheels need"
            f" {wanted}: {advice}"
        )


def require_python(version: tuple[int, int]) -> None:
    """Raise `SetUpError` if no ROS 2 wheels exist for this version of Python."""
    first, last = PYTHON_VERSIONS
    if not first <= version <= last:
        raise SetUpError(
            f"this Python is {version[0]}.{version[1]} and the cell needs {first[0]}.{first[1]} to"
            f" {last[0]}.{last[1]}: set PYTHON to the path of one that suits."
        )


def require_build_tools() -> None:
    """Raise `SetUpError` if the messages cannot be compiled here."""
    compiler = os.environ.get("CXX", "g++").split()[0]
    wanted = {"cmake": "cmake", "make": "make", compiler: "g++", os.environ.get("CC", "gcc"): "gcc"}
    missing = {tool: package for tool, package in wanted.items() if shutil.which(tool) is None}
    if missing:
        raise SetUpError(
            f"the messages are compiled with {', '.join(wanted)}, and {' and '.join(missing)}"
            f" cannot be found on the PATH: install {'it' if len(missing) == 1 else 'them'}"
            f" (on Debian and Ubuntu: apt install {' '.join(missing.values())})."
        )
    answer = subprocess.run(["cmake", "--version"], capture_output=True, text=True).stdout
    found = re.search(r"(\d+)\.(\d+)", answer)
    if found is None or (int(found[1]), int(found[2])) < CMAKE:
        raise SetUpError(
            f"cmake is {found[0] if found else 'of an unknown version'} and the messages need"
            f" {CMAKE[0]}.{CMAKE[1]} or newer: install a newer one."
        )


def require_python_headers(python: Path) -> None:
    """Raise `SetUpError` if the interpreter's C headers are not installed."""
    include = ask(python, "import sysconfig; print(sysconfig.get_path('include'))")
    if not Path(include, "Python.h").is_file():
        raise SetUpError(
            f"{include}/Python.h is not there and the messages are compiled with it: install this"
            " Python's headers (on Debian and Ubuntu: apt install"
            f" python{VERSION}-dev), or set PYTHON to one that has them."
        )


# ---- running other programs


def ask(python: Path, program: str) -> str:
    """Return the output of a one-line program in the interpreter."""
    environment = build_environment(os.environ, ros_sourced())
    answer = subprocess.run(
        [python, "-c", program], env=environment, capture_output=True, text=True, check=False
    )
    return answer.stdout.strip()


def ros_sourced() -> bool:
    """Return whether an installed ROS 2 Jazzy is sourced. Otherwise, ROS is installed as wheels."""
    return os.environ.get("ROS_DISTRO") == "jazzy"


def build_environment(outside: Mapping[str, str], sourced: bool) -> dict[str, str]:
    """Return the environment variables of the build: the variables of the shell, without the
    variables of other environments.

    The variables of a sourced ROS are kept, except for the folders that env.sh added. Without a
    sourced ROS, the variables of other ROS environments are replaced by the folders of the wheels.
    """
    kept = {name: value for name, value in outside.items() if not FOREIGN_VARIABLES.fullmatch(name)}
    if sourced:
        for name in filter(ROS_VARIABLES.fullmatch, outside):
            folders = outside[name].split(":")
            kept[name] = ":".join(x for x in folders if not Path(x).is_relative_to(ROOT))
    else:
        kept = {name: value for name, value in kept.items() if not ROS_VARIABLES.fullmatch(name)}
        libraries = [VENV / "lib", *VENV.glob("lib/python3.*/site-packages/ros_*.libs")]
        kept["LD_LIBRARY_PATH"] = ":".join(map(str, libraries))
        kept["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"
        kept["AMENT_PREFIX_PATH"] = kept["CMAKE_PREFIX_PATH"] = str(VENV)
    # Without this, colcon tells make to wait while the load of the machine is above its cores.
    kept["MAKEFLAGS"] = f"-j{len(os.sched_getaffinity(0))}"
    kept["PATH"] = f"{VENV / 'bin'}:{outside.get('PATH', os.defpath)}"
    kept["VIRTUAL_ENV"] = str(VENV)
    kept["PIP_USER"] = "0"
    kept["PIP_DISABLE_PIP_VERSION_CHECK"] = "1"
    kept["COLCON_DEFAULTS_FILE"] = os.devnull
    kept["COLCON_EXTENSION_BLOCKLIST"] = "colcon_core.event_handler.desktop_notification"
    return kept


def run(words: list[str], log: Path, failure: str) -> None:
    """Run a program with its output in ``log``; raise `SetUpError` with the cause if it fails."""
    with beside(words, log, failure):
        pass


@contextmanager
def beside(words: list[str], log: Path, failure: str) -> Iterator[None]:
    """Run a program in parallel with the block, and wait for its end after the block.

    Its output is written to ``log``. Raise `SetUpError` with the cause if it fails. If the block
    fails, the program is terminated.
    """
    log.parent.mkdir(exist_ok=True)
    # The program inherits the lock (see `locked`). If this process is killed, the next set-up
    # therefore also waits until the program has ended.
    with (
        log.open("w") as output,
        subprocess.Popen(
            words,
            cwd=ROOT,
            env=build_environment(os.environ, ros_sourced()),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            close_fds=False,
        ) as process,
    ):
        try:
            yield
        except BaseException:
            process.terminate()
            raise
        waited = 0
        while True:
            try:
                status = process.wait(SIGN_OF_LIFE)
                break
            except subprocess.TimeoutExpired:
                waited += SIGN_OF_LIFE
                report(f"... {waited} s")
    if status != 0:
        text = log.read_text(errors="replace")
        raise SetUpError(f"{failure}: {cause_of(text)} (all of it: {log.relative_to(ROOT)}).")


CAUSES = (
    (
        r"DO NOT MATCH THE HASHES",
        "the package index sent another file than requirements.lock names: do not install it;"
        " try another index, and tell the maintainers if it goes on",
    ),
    (r"No space left on device|Errno 28\b", "the disk is full: free some space and try again"),
    (
        r"NewConnectionError|ProxyError|Cannot connect to proxy|Name or service not known"
        r"|name resolution|ConnectTimeout|ReadTimeout|Network is unreachable|Connection reset",
        "the package index does not answer: check the network and the proxy variables and then"
        " try again",
    ),
    (
        r"CERTIFICATE_VERIFY_FAILED|SSLError",
        "the package index's certificate is not trusted here: set PIP_CERT to your network's"
        " certificates and try again",
    ),
    (
        r'package configuration file provided by "(\w+)"',
        r"the ROS 2 package \1 is not installed: call  rosdep install --from-paths . msg_defs"
        " --ignore-src -y  and try again",
    ),
    (
        r"No module named 'colcon",
        "colcon is not installed: apt install python3-colcon-common-extensions and try again",
    ),
    (r"Killed signal terminated", "the machine ran out of memory: close programs and try again"),
)


def cause_of(text: str) -> str:
    """Return the probable cause from a program's output, or the line that reports the error."""
    for pattern, cause in CAUSES:
        found = re.search(pattern, text)
        if found:
            return found.expand(cause)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if re.search(r"\berror\b", line, re.IGNORECASE)]
    return (errors or lines or ["it printed nothing"])[0][:300]


# ---- the stages


def pinned(lock: str, sourced: bool) -> list[str]:
    """Return the lock's requirements to install, one per line with its hashes. For a ROS from apt,
    these are only the packages that this ROS does not contain."""
    logical = lock.replace("\\\n", " ").splitlines()
    lines = [line for line in logical if line and not line.startswith("#")]
    return [line for line in lines if not (sourced and line.startswith(FROM_APT))]


def pip_install(name: str, lines: list[str], *options: str) -> list[str]:
    """Return the command that installs the requirements in ``lines`` into .venv."""
    wanted = VENV / f"{name}.txt"
    wanted.write_text("\n".join(lines))
    install = [str(VENV / "bin" / "python"), "-m", "pip", "install", "--no-input", "--no-deps"]
    install += ["--progress-bar", "off", "--no-warn-script-location", "--retries", "2"]
    # Most of these files are never imported. `compile_imported` compiles the others.
    return [*install, "--require-hashes", "--no-compile", *options, "-r", str(wanted)]


@contextmanager
def making_venv(stamp: Path, wanted: str) -> Iterator[None]:
    """Create .venv and install the packages of the lock.

    The block begins as soon as the packages that the build needs are installed. pip waits for the
    package index most of the time, so three calls of pip run in parallel.
    """
    sourced = ros_sourced()
    require_disk(DISK_FOR_VENV)
    if not sourced:
        require_wheel_platform()
    require_build_tools()
    python = Path(sys.executable).resolve()
    version = platform.python_version()
    if VENV.exists():
        report(f"making .venv again for Python {version}: it was unfinished or is out of date")
        shutil.rmtree(VENV)
    lines = pinned(LOCK.read_text(), sourced)
    report(f"installing {len(lines)} packages for Python {version} into .venv")
    site = ["--system-site-packages"] if sourced else []
    venv = [str(python), "-I", "-m", "venv", *site, str(VENV)]
    run(venv, LOG / "venv.log", "making .venv failed")

    sources = [line for line in lines if line.startswith(SOURCE_DISTRIBUTIONS)]
    wheels = [line for line in lines if line not in sources]
    tools = [line for line in wheels if line.startswith(BUILD_TOOLS)]
    others = [line for line in wheels if line not in tools]

    def installed(name: str, part: list[str]) -> AbstractContextManager[None]:
        words = pip_install(name, part, "--only-binary", ":all:")
        return beside(words, LOG / f"pip_{name}.log", "installing packages failed")

    with installed("others", others):
        with installed("tools_1", tools[::2]), installed("tools_2", tools[1::2]):
            pass
        if sources:  # built with the setuptools of the lock
            words = pip_install("sources", sources, "--no-build-isolation", "--use-pep517")
            run(words, LOG / "pip_sources.log", "installing packages failed")
        if not sourced:
            repair_exports(VENV)
        yield
    write_stamp(stamp, wanted)


def repair_exports(prefix: Path) -> None:
    """Replace the header folders in the CMake targets of the ROS wheels by those of this
    interpreter.

    The CMake targets of the interface wheels contain the include folders of the Python and numpy
    with which the wheels were built. A build with these targets fails because the folders do not
    exist on this machine.
    """
    python = prefix / "bin" / "python"
    include = ask(python, "import sysconfig; print(sysconfig.get_path('include'))")
    numpy = ask(python, "import numpy; print(numpy.get_include())")
    for file in prefix.glob("share/*/cmake/export_*__rosidl_generator_pyExport.cmake"):
        file.write_text(replace_image_paths(file.read_text(), include, numpy))


def replace_image_paths(text: str, include: str, numpy: str) -> str:
    """Return the text with the header folders of the wheels' numpy and Python replaced."""
    image = r"/opt/python/cp3\d+-cp3\d+"
    text = re.sub(rf"{image}/lib/python3\.\d+/site-packages/numpy/_?core/include", numpy, text)
    return re.sub(rf"{image}/include/python3\.\d+", include, text)


def build(packages: list[str], message: str) -> None:
    """Build packages with colcon."""
    require_disk(DISK_FOR_BUILD)
    python = VENV / "bin" / "python"
    if "tapping_cell_msgs" in packages:
        require_build_tools()
        require_python_headers(python)
    report(message)
    for package in packages:
        for folder in (BUILD / package, INSTALL / package):
            shutil.rmtree(folder, ignore_errors=True)
    colcon = "import sys; from colcon_core.command import main; sys.exit(main())"
    options = ["--base-paths", ".", "msg_defs", "--symlink-install", "--packages-select", *packages]
    cmake = ["--cmake-args", f"-DPython3_EXECUTABLE={python}", "-DBUILD_TESTING=OFF"]
    if not ros_sourced():
        cmake.append("-DPYTHON_AND_FAST_DDS_ONLY=ON")  # the wheels contain nothing else
    run(
        [str(python), "-c", colcon, "build", *options, *cmake],
        LOG / "colcon.log",
        f"building {' and '.join(packages)} failed",
    )


# Import every module of the package. A module whose import fails is reported where it is used.
IMPORT_ALL = """
import importlib, pkgutil, sys
sys.dont_write_bytecode = False
sys.path[:0] = sys.argv[1:]
import tapping_cell
for module in pkgutil.walk_packages(tapping_cell.__path__, "tapping_cell.", lambda name: None):
    if not module.name.endswith("__main__"):
        try:
            importlib.import_module(module.name)
        except ImportError:
            pass
"""


def compile_imported() -> None:
    """Compile the package and what it imports.

    Otherwise, the nodes of the first graph compile the same files at the same time. In a shell with
    PYTHONDONTWRITEBYTECODE, which is usual in containers, each node compiles them at every start,
    which takes longer than the rest of its start.
    """
    report("compiling the Python modules")
    messages = sorted(str(path) for path in INSTALL.glob("*_msgs/lib/python3.*/site-packages"))
    run(
        [str(VENV / "bin" / "python"), "-c", IMPORT_ALL, str(ROOT), *messages],
        LOG / "compile.log",
        "importing the package failed",
    )


def set_up() -> None:
    """Bring every stage up to date."""
    sourced = ros_sourced()
    base = str(Path(sys.executable).resolve())
    origin = "sourced" if sourced else "wheels"
    venv = fingerprint([LOCK], str(RECIPE), str(ROOT), VERSION, base, origin)
    messages = fingerprint(files_below(ROOT / "msg_defs"), venv)
    sources = [ROOT / name for name in ("setup.py", "setup.cfg", "package.xml")]
    listed = files_below(ROOT / "resource", ROOT / "config", ROOT / "launch")
    names = [str(file.relative_to(ROOT)) for file in sorted(listed)]
    package = fingerprint(sources, messages, *names)

    stages = (
        (VENV / ".fingerprint", venv),
        (INSTALL / "tapping_cell_msgs" / ".fingerprint", messages),
        (INSTALL / "tapping_cell" / ".fingerprint", package),
    )
    if all(is_made(stamp, wanted) for stamp, wanted in stages):
        return
    require_plain_path()
    require_writable()
    require_python(sys.version_info[:2])
    started = time.monotonic()
    with locked():
        with nullcontext() if is_made(*stages[0]) else making_venv(*stages[0]):
            if not is_made(*stages[1]):
                build(
                    ["tapping_cell_msgs", "tapping_cell"], "building the messages and the package"
                )
            elif not is_made(*stages[2]):
                build(["tapping_cell"], "building the package")
                write_stamp(*stages[2])
        if not is_made(*stages[1]):
            compile_imported()
            write_stamp(*stages[1])
            write_stamp(*stages[2])
    report(f"set up in {time.monotonic() - started:.0f} s")


@contextmanager
def locked() -> Iterator[None]:
    """Hold a lock on this folder, so that only one set-up runs in it at a time."""
    folder = os.open(ROOT, os.O_RDONLY)
    try:
        os.set_inheritable(folder, True)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            report("waiting for another set-up of this folder to end")
            fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def main() -> int:
    """Run the set-up. Return the exit code: 0, 1 after an error, or 130 if interrupted."""
    try:
        set_up()
    except SetUpError as error:
        report(str(error))
        return 1
    except OSError as error:
        report(f"the set-up failed: {error}.")
        return 1
    except KeyboardInterrupt:
        report("interrupted: the next call goes on from the last finished stage.")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
