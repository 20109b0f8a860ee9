# What the installing scripts share; they set `name` and source this file.
# shellcheck shell=bash

say() { printf '%s: %s\n' "$name" "$*"; }

# Ends the script. The first argument says what is wrong, the others what to do.
fail() {
    local indent
    printf '%s: error: %s\n' "$name" "$1" >&2
    printf -v indent '%*s' $((${#name} + 2)) ''
    shift
    if (($#)); then printf "$indent%s\n" "$@" >&2; fi
    exit 1
}

# Reads the options of a script: sets dry_run, or prints the comment at the script's top and ends.
dry_run=0
read_options() {
    case "${1:-}" in
        "") ;;
        --dry-run) dry_run=1 ;;
        -h | --help)
            sed -n '2,/^[^#]/{/^#/s/^# \{0,1\}//p}' "$0"
            exit 0
            ;;
        *) fail "unknown option '$1'" "The only option is --dry-run." ;;
    esac
}

# What goes before a command that changes the system: nothing for root, sudo for others where it is there.
sudo=()
if ((EUID != 0)) && command -v sudo >/dev/null; then sudo=(sudo); fi
may_install() { ((EUID == 0 || ${#sudo[@]})); }

# apt-get without questions; both take further arguments.
apt_update=(apt-get -q update)
apt_install=(env DEBIAN_FRONTEND=noninteractive apt-get -q install -y --no-install-recommends)
