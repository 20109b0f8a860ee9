#!/usr/bin/env bash
# Installs Chromium for the tests of the viewer, if there is none yet.
#
#   scripts/install_browser.sh             install it if it is missing; safe to run again
#   scripts/install_browser.sh --dry-run   print what would be done and change nothing
#
# People look at the viewer's page with the browser that they have; only the tests need this one.
set -euo pipefail

name=browser
# shellcheck source=scripts/preamble.sh
. "$(dirname "${BASH_SOURCE[0]}")/preamble.sh"
read_options "$@"

# tests/conftest.py looks for the same names.
for program in chromium chromium-browser google-chrome; do
    if path="$(command -v "$program")"; then
        say "nothing to install: $path"
        exit 0
    fi
done
command -v apt-get >/dev/null || fail "this script installs packages on Debian only" \
    "Install Chromium or Google Chrome with your system's own tools; a program 'chromium' on PATH is enough."
commands=("${apt_update[*]}" "${apt_install[*]} chromium")
if ! ((dry_run)) && ! may_install; then
    fail "this needs root, and there is no sudo here" "Run these as root:" "${commands[@]}"
fi
for command in "${commands[@]}"; do
    say "${sudo[*]:+${sudo[*]} }$command"
    # shellcheck disable=SC2086
    if ! ((dry_run)); then "${sudo[@]}" $command; fi
done
if ! ((dry_run)); then
    chromium --version >/dev/null 2>&1 || fail "chromium is installed but does not start" \
        "On Ubuntu the package only leads to a snap, which containers cannot run: install Google Chrome instead."
    say "ready: $(command -v chromium)"
fi
