#!/usr/bin/env bash
# Creates .venv with what this project needs, at the versions of constraints.txt, or brings it up to date.
#
#   scripts/setup_env.sh             install what is missing; safe to run again
#   scripts/setup_env.sh --dry-run   say what would be installed and how large it is, and change nothing
#
# What it reads from the environment, and `make venv` from its command line:
#
#   PYTHON=/path/to/python   the interpreter; else the first of python3.11, python3.12, python3.13, python3
#   TORCH=cuda | cpu         PyTorch's usual build, or its smaller one that uses no GPU
#   KIND=full | robot        everything, or a robot's PC: no ManiSkill, no SAPIEN and no tools for development
#
# Without TORCH or KIND an environment stays what it is, and a new one is cuda and full. Nothing is installed outside
# .venv. `make` runs this only when the environment is missing, out of date or of another sort than asked for.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
here="$(pwd -P)"
venv=.venv
python="$venv/bin/python"
# The folder of a finished installation, and "TORCH KIND" of one that was begun; the Makefile reads both.
stamp="$venv/.installed-from"
sort="$venv/.installed-kind"

name=setup
# shellcheck source=scripts/preamble.sh
. scripts/preamble.sh
read_options "$@"

version_of() { "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null; }
new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }

find_python() {
    local candidate
    if [[ -n ${PYTHON:-} ]]; then
        echo "$PYTHON"
        return
    fi
    for candidate in python3.11 python3.12 python3.13 python3; do
        if command -v "$candidate" >/dev/null && new_enough "$candidate"; then
            echo "$candidate"
            return
        fi
    done
    fail "no Python 3.11 or newer on PATH" \
        "On Debian 12 or newer and Ubuntu 24.04 or newer:  sudo apt-get install python3 python3-venv" \
        "Elsewhere, name one:  make venv PYTHON=/path/to/python3.11"
}

# Refused before anything is removed.
if [[ -n ${PYTHON:-} ]]; then
    found="$(version_of "$PYTHON" || true)"
    [[ -n $found ]] || fail "PYTHON=$PYTHON does not run" "Give the name or path of a Python 3.11 or newer."
    new_enough "$PYTHON" || fail "PYTHON=$PYTHON is Python $found" "Give the name or path of a Python 3.11 or newer."
fi
case "${TORCH:-}" in "" | cuda | cpu) ;; *) fail "TORCH=$TORCH is unknown" "Give cuda or cpu." ;; esac
case "${KIND:-}" in "" | full | robot) ;; *) fail "KIND=$KIND is unknown" "Give full or robot." ;; esac

was_torch=cuda was_kind=full was_folder="$here"
if [[ -f $sort ]]; then read -r was_torch was_kind <"$sort"; fi
if [[ -f $stamp ]]; then was_folder="$(cat "$stamp")"; fi
torch="${TORCH:-$was_torch}"
kind="${KIND:-$was_kind}"

# Said before the first byte is loaded. Measured for Python 3.11 on x86-64, with the versions of constraints.txt.
case "$kind $torch" in
    "full cuda") size="4.0 GB to download, 8.3 GB of disk" ;;
    "robot cuda") size="3.5 GB to download, 7.0 GB of disk" ;;
    "full cpu") size="1.0 GB to download, 2.9 GB of disk, and PyTorch's build for the CPU" ;;
    "robot cpu") size="0.5 GB to download, 1.5 GB of disk, and PyTorch's build for the CPU" ;;
esac
case "$kind" in
    full) fallback_size="3.4 GB to download, 6.9 GB of disk" ;;
    robot) fallback_size="2.9 GB to download, 5.6 GB of disk" ;;
esac
size_words() { say "the packages (TORCH=$torch KIND=$kind): $1; what uv's cache already holds is not downloaded"; }

why=""
if [[ -e $venv ]]; then
    if ! new_enough "$python"; then
        why="its Python is gone or older than 3.11"
    elif [[ $was_folder != "$here" ]]; then
        why="it was made for $was_folder"
    elif [[ -n ${PYTHON:-} && $(version_of "$python") != $(version_of "$PYTHON") ]]; then
        why="it has Python $(version_of "$python"), not that of PYTHON=$PYTHON"
    elif [[ "$was_torch $was_kind" != "$torch $kind" ]]; then
        why="it has TORCH=$was_torch KIND=$was_kind, not TORCH=$torch KIND=$kind"
    fi
fi
if ((dry_run)); then
    if [[ -n $why ]]; then say "would make $venv anew: $why"; fi
    size_words "$size"
    if [[ $torch == cpu ]]; then say "where that build cannot be reached: $fallback_size"; fi
    exit 0
fi
if [[ -n $why ]]; then
    say "making $venv anew: $why"
    rm -rf "$venv"
fi
rm -f "$stamp"

if [[ ! -x $python ]]; then
    base="$(find_python)"
    say "creating $venv with $base (Python $(version_of "$base"))"
    if ! log="$("$base" -m venv "$venv" 2>&1)"; then
        rm -rf "$venv"
        fail "$base cannot create a virtual environment:" "${log%%$'\n'*}" \
            "On Debian and Ubuntu:  sudo apt-get install python3-venv"
    fi
fi
printf '%s %s\n' "$torch" "$kind" >"$sort"
# Asked first, because the answer would otherwise come after gigabytes.
if [[ $kind == full && $(uname -s) == Linux ]] &&
    ! "$python" -c 'import ctypes; ctypes.CDLL("libX11.so.6")' 2>/dev/null; then
    fail "SAPIEN needs the system library libX11, even without a screen" \
        "Run  make vulkan  (it also installs a CPU renderer), or:  sudo apt-get install libx11-6"
fi
if [[ ! -x $venv/bin/uv ]]; then
    say "installing uv into $venv"
    "$python" -m pip --version >/dev/null 2>&1 || "$python" -m ensurepip >/dev/null 2>&1 || fail "$venv has no pip" \
        "Remove it and run this again:  rm -rf $venv && make venv TORCH=$torch KIND=$kind"
    "$python" -m pip install -q --disable-pip-version-check -c constraints.txt uv ||
        fail "pip could not install uv (above)" "Check the network and pip's settings (pip config list), then run this again."
fi

uv_install() { "$venv/bin/uv" pip install --python "$python" -c constraints.txt "$@"; }

what=(--override overrides.txt)
if [[ $kind == robot ]]; then
    what+=(--override overrides-robot.txt -e ".[perception,deploy,hardware]")
else
    what+=(-e ".[dev,perception,deploy,hardware,sb3,lerobot,ray]")
fi
if [[ $torch == cpu ]]; then
    # Asked with torch alone, so that nothing else can be the reason for a no, and anew, whatever is installed.
    if uv_install -q --dry-run --reinstall-package torch --torch-backend cpu torch >/dev/null 2>&1; then
        what+=(--torch-backend cpu)
    else
        what+=(--override overrides-cpu.txt)
        say "PyTorch's builds for the CPU cannot be reached from here, so its usual build is taken, less what only a GPU needs"
        size="$fallback_size"
    fi
fi
size_words "$size"

say "installing them (minutes the first time, seconds when they are in the cache)"
if [[ -t 2 ]]; then
    uv_install "${what[@]}" && status=0 || status=$?
else
    # Without a terminal uv shows no bars; its list of 150 names is left out.
    { uv_install "${what[@]}" 2>&1 && status=0 || status=$?; } > >(grep --line-buffered -v '^ [-+~] ' || true)
fi
((status == 0)) || fail "uv could not install the packages (above)" \
    "Check the network and the free disk space (df -h .), then run this again: what has arrived is kept."

say "checking the environment"
"$venv/bin/maniskill-tomato" doctor --packages || exit 1
printf '%s\n' "$here" >"$stamp"
say "ready: $venv ($("$python" --version), TORCH=$torch, KIND=$kind)"
