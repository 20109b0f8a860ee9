#!/usr/bin/env bash
# Builds the source archive and, from it, the wheel; then tries the wheel in a clean environment outside the checkout.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
root="$(pwd -P)"
uv="$root/.venv/bin/uv"

name=build
# shellcheck source=scripts/preamble.sh
. scripts/preamble.sh

work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT

say "building (a log appears only if that fails)"
rm -rf build/lib build/bdist.* dist
if ! "$root/.venv/bin/python" -m build --installer uv --outdir dist . >"$work/log" 2>&1; then
    tail -n 40 "$work/log" >&2
    exit 1
fi
rm -rf build/lib build/bdist.*
wheel="$(ls dist/*.whl)"

say "installing $wheel into a clean environment"
"$uv" venv -q --python "$root/.venv/bin/python" "$work/venv"
"$uv" pip install -q --python "$work/venv/bin/python" --override overrides.txt -c constraints.txt "$wheel"

say "trying it"
# From another folder and isolated (-I), so that nothing of the checkout can be imported.
(cd "$work" && "$work/venv/bin/python" -I "$root/scripts/wheel_smoke.py")
say "trying a robot's PC: an environment without ManiSkill and SAPIEN"
"$uv" venv -q --python "$root/.venv/bin/python" "$work/robot"
"$uv" pip install -q --python "$work/robot/bin/python" --override overrides.txt \
    --override overrides-robot.txt -c constraints.txt \
    "$wheel[perception,deploy,hardware]"
(
    cd "$work"
    "$work/robot/bin/python" -I -c 'import importlib.util as u; assert not u.find_spec("mani_skill") and not u.find_spec("sapien")'
    "$work/robot/bin/maniskill-tomato" doctor --packages
    "$work/robot/bin/maniskill-tomato" deploy run --profile mock --out "$work/run" </dev/null
    "$work/robot/bin/maniskill-tomato" play --export "$work/page.html" </dev/null
)

say "done: $wheel ($(du -h "$wheel" | cut -f1))"
