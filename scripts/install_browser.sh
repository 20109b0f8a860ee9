#!/usr/bin/env bash
# Installs Chromium for the tests of the viewer, if there is none yet.
#
#   scripts/install_browser.sh             install it if it is missing; safe to run again
#   scripts/install_browser.sh --dry-run   print what would be done and change nothing
#
# People look at the viewer's page with the browser that they have; only the tests need this one.
set -euo pipefail

dry_run=0
say() { printf 'browser: %s\n' "$*"; }
fail() {
    printf 'browser: error: %s\n' "$1" >&2
    shift
    if (($#)); then printf '         %s\n' "$@" >&2; fi
    exit 1
}

case "${1:-}" in
    "") ;;
    --dry-run) dry_run=1 ;;
    -h | --help)
        sed -n '2,7s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"
        exit 0
        ;;
    *) fail "unknown option '$1'" "The only option is --dry-run." ;;
esac

# tests/conftest.py looks for the same names.
for name in chromium chromium-browser google-chrome; do
    if path="$(command -v "$name")"; then
        say "nothing to install: $path"
        exit 0
    fi
done
command -v apt-get >/dev/null || fail "this script installs packages on Debian only" \
    "Install Chromium or Google Chrome with your system's own tools; a program 'chromium' on PATH is enough."
sudo=()
if ((EUID != 0)); then sudo=(sudo); fi
for command in "apt-get -q update" "env DEBIAN_FRONTEND=noninteractive apt-get -q install -y --no-install-recommends chromium"; do
    say "${sudo[*]:+${sudo[*]} }$command"
    # shellcheck disable=SC2086
    if ! ((dry_run)); then "${sudo[@]}" $command; fi
done
if ! ((dry_run)); then
    chromium --version >/dev/null 2>&1 || fail "chromium is installed but does not start" \
        "On Ubuntu the package only leads to a snap, which containers cannot run: install Google Chrome instead."
    say "ready: $(command -v chromium)"
fi
