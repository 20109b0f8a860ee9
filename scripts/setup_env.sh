#!/usr/bin/env bash
# Creates .venv with everything that this project needs, at the versions of constraints.txt, or brings it up to date.
#
#   scripts/setup_env.sh                     takes the first of python3.11, python3.12, python3.13, python3
#   PYTHON=/path/to/python scripts/setup_env.sh
#
# Nothing is installed outside .venv. `make` runs this only when the environment is missing or out of date.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
here="$(pwd -P)"
venv=.venv
python="$venv/bin/python"
stamp="$venv/.installed-from"

say() { printf 'setup: %s\n' "$*"; }
fail() {
    printf 'setup: error: %s\n' "$1" >&2
    shift
    if (($#)); then printf '       %s\n' "$@" >&2; fi
    exit 1
}
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

if [[ -e $venv ]]; then
    why=""
    if ! new_enough "$python"; then
        why="its Python is gone or older than 3.11"
    elif [[ -f $stamp && $(cat "$stamp") != "$here" ]]; then
        why="it was made for $(cat "$stamp")"
    elif [[ -n ${PYTHON:-} && $(version_of "$python") != $(version_of "$PYTHON") ]]; then
        why="it has Python $(version_of "$python"), not that of PYTHON=$PYTHON"
    fi
    if [[ -n $why ]]; then
        say "making $venv anew: $why"
        rm -rf "$venv"
    fi
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
# Asked first, because the answer would otherwise come after gigabytes.
if [[ $(uname -s) == Linux ]] && ! "$python" -c 'import ctypes; ctypes.CDLL("libX11.so.6")' 2>/dev/null; then
    fail "SAPIEN needs the system library libX11, even without a screen" \
        "Run  make vulkan  (it also installs a CPU renderer), or:  sudo apt-get install libx11-6"
fi
if [[ ! -x $venv/bin/uv ]]; then
    say "installing uv into $venv"
    "$python" -m pip --version >/dev/null 2>&1 || "$python" -m ensurepip >/dev/null 2>&1 || fail "$venv has no pip" \
        "Remove it and run this again:  rm -rf $venv && make venv"
    "$python" -m pip install -q --disable-pip-version-check -c constraints.txt uv ||
        fail "pip could not install uv (above)" "Check the network and pip's settings (pip config list), then run this again."
fi

say "installing the packages (about 5 GB; minutes the first time, seconds when they are in uv's cache)"
install() {
    "$venv/bin/uv" pip install --python "$python" --override overrides.txt -c constraints.txt -e ".[dev,perception,deploy,hardware,sb3]"
}
if [[ -t 2 ]]; then
    install && status=0 || status=$?
else
    # Without a terminal uv shows no bars; its list of 150 names is left out.
    { install 2>&1 && status=0 || status=$?; } > >(grep --line-buffered -v '^ [-+~] ' || true)
fi
((status == 0)) || fail "uv could not install the packages (above)" \
    "Check the network and the free disk space (df -h .), then run this again: what has arrived is kept."

say "checking the environment"
"$venv/bin/maniskill-tomato" doctor --packages || exit 1
printf '%s\n' "$here" >"$stamp"
say "ready: $venv ($("$python" --version))"
