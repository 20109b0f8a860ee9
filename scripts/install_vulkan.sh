#!/usr/bin/env bash
# Installs CPU Vulkan (Mesa's lavapipe) for headless rendering, if no usable Vulkan device is there yet.
#
#   scripts/install_vulkan.sh             install what is missing; safe to run again
#   scripts/install_vulkan.sh --dry-run   print what would be done and change nothing
#
# Debian 12's own Mesa 22.3 lacks the Vulkan feature descriptorBindingPartiallyBound that SAPIEN needs; the
# backports suite has a newer one. Its address is taken from this machine's own apt sources.
#
# For tests: OS_RELEASE_FILE replaces /etc/os-release, APT_DIR replaces /etc/apt.
set -euo pipefail

here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
root="$(dirname "$here")"
os_release="${OS_RELEASE_FILE:-/etc/os-release}"
apt_dir="${APT_DIR:-/etc/apt}"
backports="bookworm-backports"
# SAPIEN links against libX11 even when it never opens a window.
packages=(mesa-vulkan-drivers libvulkan1 libx11-6)
name=vulkan
# shellcheck source=scripts/preamble.sh
. "$here/preamble.sh"
read_options "$@"

# Asks Vulkan itself. Status 0: usable; 1: not usable; 2: there is no Python to ask with.
check_device() {
    local python
    if [[ -x $root/.venv/bin/python ]] && "$root/.venv/bin/python" -c 'import sapien' 2>/dev/null; then
        "$root/.venv/bin/python" -W ignore "$here/check_vulkan.py" --render 2>&1
    elif python="$(command -v python3)"; then
        "$python" "$here/check_vulkan.py" 2>&1
    else
        echo "there is no python3 to ask Vulkan with"
        return 2
    fi
}

if ! ((dry_run)); then
    if answer="$(check_device)"; then
        say "nothing to install: ${answer##*$'\n'}"
        exit 0
    fi
    answer="${answer##*$'\n'}"
    say "${answer%%;*}"
fi

[[ -r $os_release ]] || fail "cannot read $os_release, so the distribution is unknown" \
    "Install your distribution's Mesa Vulkan drivers (lavapipe, version 23.3 or newer) and the Vulkan loader."
field() { (
    set +u
    # shellcheck disable=SC1090
    . "$os_release"
    eval "printf '%s' \"\${$1:-}\""
); }
id="$(field ID)"
id_like="$(field ID_LIKE)"
version="$(field VERSION_ID)"
distribution="$(field PRETTY_NAME)"
major="${version%%.*}"
[[ $major =~ ^[0-9]+$ ]] || major=""

by_hand() {
    fail "this script installs packages on Debian and Ubuntu only; this is ${distribution:-$id}" \
        "Install lavapipe with:  $1" "then run this script again: it checks the result."
}

suite=()
note=""
case "$id" in
    debian)
        if [[ -z $major ]] || ((major >= 13)); then
            : # Debian 13 has Mesa 25; testing and unstable carry no version number.
        elif ((major == 12)); then
            suite=(-t "$backports")
        else
            fail "$distribution has a Mesa too old for SAPIEN, and its backports do not help" "Debian 12 or newer works."
        fi
        ;;
    ubuntu)
        if [[ -n $major ]] && ((major < 22)); then
            fail "$distribution has a Mesa too old for SAPIEN" "Ubuntu 24.04 or newer works."
        elif [[ -n $major ]] && ((major < 24)); then
            note="$distribution has Mesa 23.2 or older, which may lack the feature; the check after the installation tells"
        fi
        ;;
    fedora | rhel | centos | rocky | almalinux) by_hand "sudo dnf install mesa-vulkan-drivers vulkan-loader libX11" ;;
    arch | manjaro | endeavouros) by_hand "sudo pacman -S vulkan-swrast vulkan-icd-loader libx11" ;;
    opensuse* | suse | sles) by_hand "sudo zypper install libvulkan_lvp libvulkan1 libX11-6" ;;
    *)
        if [[ " $id_like " == *" debian "* || " $id_like " == *" ubuntu "* ]]; then
            note="${distribution:-$id} is treated like the Debian or Ubuntu it derives from; the check after the installation tells"
        else
            by_hand "your package manager (Mesa's Vulkan drivers, 23.3 or newer, with lavapipe, and the Vulkan loader)"
        fi
        ;;
esac
((dry_run)) || command -v apt-get >/dev/null || fail "there is no apt-get on this ${distribution:-machine}" \
    "Install by hand: ${packages[*]}"

# The files with apt sources, in apt's order.
source_files() {
    local file
    for file in "$apt_dir/sources.list" "$apt_dir"/sources.list.d/*.list "$apt_dir"/sources.list.d/*.sources; do
        if [[ -f $file ]]; then printf '%s\n' "$file"; fi
    done
}

# Prints "URIs TAB Signed-By" of the first enabled binary source whose suites hold the word $1.
find_source() {
    local file
    while IFS= read -r file; do
        case "$file" in
            *.sources)
                awk -v suite="$1" '
                    function finish(   n, words, i, hit) {
                        n = split(suites, words, /[ \t]+/)
                        for (i = 1; i <= n; i++) if (words[i] == suite) hit = 1
                        if (hit && types ~ /(^|[ \t])deb([ \t]|$)/ && enabled !~ /^(no|false|off|0)$/ && uris != "" && !done) {
                            print uris "\t" key
                            done = 1
                        }
                        types = suites = uris = key = enabled = field = ""
                    }
                    /^#/ { next }
                    /^[ \t]*$/ { finish(); next }
                    /^[^ \t:]+:/ {
                        field = tolower(substr($0, 1, index($0, ":") - 1))
                        value = substr($0, index($0, ":") + 1)
                        gsub(/^[ \t]+|[ \t]+$/, "", value)
                        if (field == "types") types = value
                        if (field == "suites") suites = value
                        if (field == "uris") uris = value
                        if (field == "signed-by") key = value
                        if (field == "enabled") enabled = tolower(value)
                        next
                    }
                    field == "uris" || field == "suites" {
                        gsub(/^[ \t]+|[ \t]+$/, "")
                        if (field == "uris") uris = uris " " $0; else suites = suites " " $0
                    }
                    END { finish() }' "$file"
                ;;
            *)
                awk -v suite="$1" '
                    $1 == "deb" {
                        line = $0
                        key = ""
                        if (match(line, /\[[^]]*\]/)) {
                            options = substr(line, RSTART + 1, RLENGTH - 2)
                            line = substr(line, 1, RSTART - 1) substr(line, RSTART + RLENGTH)
                            n = split(options, words, /[ \t]+/)
                            for (i = 1; i <= n; i++) if (words[i] ~ /^signed-by=/) key = substr(words[i], 11)
                        }
                        split(line, words, /[ \t]+/)
                        if (words[3] == suite) { print words[2] "\t" key; exit }
                    }' "$file"
                ;;
        esac
    done < <(source_files) | sed -n 1p
}

new_file=""
new_text=""
if ((${#suite[@]})) && [[ -z "$(find_source "$backports")" ]]; then
    found="$(find_source bookworm)"
    [[ -n $found ]] || fail "found no source for Debian's suite 'bookworm' in $apt_dir" \
        "Add the suite '$backports' of your Debian mirror to $apt_dir/sources.list.d, then run this script again."
    uris="${found%%$'\t'*}"
    key="${found#*$'\t'}"
    new_file="$apt_dir/sources.list.d/$backports.sources"
    new_text="Types: deb"$'\n'"URIs: $uris"$'\n'"Suites: $backports"$'\n'"Components: main"
    # A key pasted into the source file spans lines and cannot be repeated here; Debian's keyring has the same one.
    if [[ $key == /* ]]; then new_text+=$'\n'"Signed-By: $key"; fi
fi

install=("${apt_install[@]}" "${suite[@]}" "${packages[@]}")

plan() {
    if [[ -n $new_file ]]; then
        printf "printf '%%s\\\\n' "
        local line
        while IFS= read -r line; do printf "'%s' " "$line"; done <<<"$new_text"
        printf '| %s > /dev/null\n' "${sudo[*]:+${sudo[*]} }tee $new_file"
    fi
    echo "${sudo[*]:+${sudo[*]} }${apt_update[*]}"
    echo "${sudo[*]:+${sudo[*]} }${install[*]}"
}

if [[ -n $note ]]; then say "$note"; fi
if ((dry_run)); then
    say "on ${distribution:-$id} this would run:"
    plan
    exit 0
fi
if ! may_install; then
    say "this needs root, and there is no sudo here; run these as root:" >&2
    plan >&2
    exit 1
fi

say "on ${distribution:-$id} this runs:"
plan | sed 's/^/    /'
log="$(mktemp)"
trap 'rm -f "$log"' EXIT
run() { "${sudo[@]}" "$@" >>"$log" 2>&1; }
# Shows what apt complained about, and takes away the source that this run added.
undo() {
    grep -E '^(W|E|Err)[:0-9]' "$log" | tail -n 15 >&2 || tail -n 15 "$log" >&2
    if [[ -n $new_file ]]; then
        "${sudo[@]}" rm -f "$new_file"
        say "took $new_file away again" >&2
    fi
}
if [[ -n $new_file ]]; then
    printf '%s\n' "$new_text" | "${sudo[@]}" tee "$new_file" >/dev/null || fail "cannot write $new_file" \
        "Run this script as a user who may."
fi
if ! run "${apt_update[@]}"; then
    undo
    fail "apt-get update failed (above)" \
        "Check the network and $apt_dir${new_file:+, and that your mirror carries $backports}; then run this script again."
fi
# apt-get update also succeeds when it could fetch nothing; the installation then fails.
if ! run "${install[@]}"; then
    undo
    fail "apt-get install failed (above)" \
        "Check the network and $apt_dir${new_file:+, and that your mirror carries $backports}." \
        "If another apt is running, wait for it; if packages conflict, 'apt-get -f install' may repair them." \
        "Then run this script again."
fi

status=0
answer="$(check_device)" || status=$?
version_now="$(dpkg-query -W -f '${Version}' mesa-vulkan-drivers 2>/dev/null || true)"
case $status in
    0) say "installed Mesa $version_now; ${answer##*$'\n'}" ;;
    2) say "installed Mesa $version_now; not checked, for ${answer##*$'\n'}" ;;
    *)
        answer="${answer##*$'\n'}"
        answer="${answer#no: }"
        fail "Mesa $version_now is installed, but ${answer%%;*}" \
            "Mesa 23.3 or newer has the feature: Debian 12 with backports, Debian 13, Ubuntu 24.04 or newer." \
            "VK_ICD_FILENAMES or VK_DRIVER_FILES, if set, must not hide the driver (now: '${VK_ICD_FILENAMES:-}${VK_DRIVER_FILES:-}')."
        ;;
esac
