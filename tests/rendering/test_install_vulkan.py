"""The Vulkan installer's decisions, on made-up machines: which packages, from where, and what it says."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "install_vulkan.sh"
PACKAGES = "mesa-vulkan-drivers libvulkan1 libx11-6"

DEBIAN_12 = (
    'ID=debian\nVERSION_ID="12"\nVERSION_CODENAME=bookworm\nPRETTY_NAME="Debian GNU/Linux 12 (bookworm)"\n'
)

DEB822 = """\
Types: deb
# A comment that deb822 allows.
URIs: http://mirror.invalid/debian
Suites: bookworm bookworm-updates
Components: main
Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg

Types: deb
URIs: http://mirror.invalid/debian-security
Suites: bookworm-security
Components: main
"""

ONE_LINE = """\
# deb http://commented.invalid/debian bookworm main
deb-src http://source.invalid/debian bookworm main
deb [arch=amd64 signed-by=/etc/keys/own.gpg] http://mirror.invalid/debian bookworm main contrib
deb http://mirror.invalid/debian-security bookworm-security main
"""


def dry_run(
    folder: Path, os_release: str, sources: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """The installer's plan for a machine with this /etc/os-release and these files under /etc/apt."""
    (folder / "os-release").write_text(os_release)
    apt = folder / "apt"
    (apt / "sources.list.d").mkdir(parents=True)
    for name, text in (sources or {}).items():
        (apt / name).write_text(text)
    environment = {**os.environ, "OS_RELEASE_FILE": str(folder / "os-release"), "APT_DIR": str(apt)}
    return subprocess.run(
        ["bash", str(SCRIPT), "--dry-run"], env=environment, capture_output=True, text=True, timeout=300
    )


def written_lines(result: subprocess.CompletedProcess[str]) -> list[str]:
    """The lines of the source file that the plan writes, or none."""
    (plan,) = [line for line in result.stdout.splitlines() if line.startswith("printf")] or [""]
    return [part for part in plan.split(" | ")[0].split("'")[3::2]]


def install_command(result: subprocess.CompletedProcess[str]) -> str:
    (command,) = [line for line in result.stdout.splitlines() if "apt-get -q install" in line]
    return command


@pytest.mark.parametrize(
    ("file", "text", "key"),
    [
        ("sources.list.d/debian.sources", DEB822, "/usr/share/keyrings/debian-archive-keyring.gpg"),
        ("sources.list", ONE_LINE, "/etc/keys/own.gpg"),
    ],
)
def test_debian_12_takes_backports_from_the_machines_own_mirror(
    file: str, text: str, key: str, tmp_path: Path
) -> None:
    result = dry_run(tmp_path, DEBIAN_12, {file: text})
    assert result.returncode == 0, result.stderr
    assert written_lines(result) == [
        "Types: deb",
        "URIs: http://mirror.invalid/debian",
        "Suites: bookworm-backports",
        "Components: main",
        f"Signed-By: {key}",
    ]
    assert install_command(result).endswith(f"-t bookworm-backports {PACKAGES}")


def test_debian_12_without_a_key_in_its_source_writes_none(tmp_path: Path) -> None:
    result = dry_run(
        tmp_path, DEBIAN_12, {"sources.list": "deb http://mirror.invalid/debian bookworm main\n"}
    )
    assert written_lines(result)[-1] == "Components: main"


def test_debian_12_with_a_key_pasted_into_the_source_writes_no_key_path(tmp_path: Path) -> None:
    pasted = (
        "Types: deb\nURIs: http://mirror.invalid/debian\nSuites: bookworm\nComponents: main\nSigned-By:\n"
    )
    pasted += " -----BEGIN PGP PUBLIC KEY BLOCK-----\n .\n mQINBF\n"
    result = dry_run(tmp_path, DEBIAN_12, {"sources.list.d/debian.sources": pasted})
    assert written_lines(result)[1:] == [
        "URIs: http://mirror.invalid/debian",
        "Suites: bookworm-backports",
        "Components: main",
    ]


def test_debian_12_that_has_backports_already_adds_no_source(tmp_path: Path) -> None:
    backports = "deb http://mirror.invalid/debian bookworm-backports main\n"
    result = dry_run(
        tmp_path, DEBIAN_12, {"sources.list.d/debian.sources": DEB822, "sources.list.d/mine.list": backports}
    )
    assert written_lines(result) == []
    assert "-t bookworm-backports" in install_command(result)


@pytest.mark.parametrize(
    "disabled",
    [
        "# deb http://mirror.invalid/debian bookworm-backports main\n",
        "deb-src http://mirror.invalid/debian bookworm-backports main\n",
    ],
)
def test_a_disabled_backports_line_does_not_count(disabled: str, tmp_path: Path) -> None:
    result = dry_run(tmp_path, DEBIAN_12, {"sources.list": ONE_LINE, "sources.list.d/mine.list": disabled})
    assert "Suites: bookworm-backports" in written_lines(result)


def test_a_disabled_stanza_is_not_taken_as_the_mirror(tmp_path: Path) -> None:
    off = "Enabled: no\nTypes: deb\nURIs: http://off.invalid/debian\nSuites: bookworm\nComponents: main\n\n"
    result = dry_run(tmp_path, DEBIAN_12, {"sources.list.d/debian.sources": off + DEB822})
    assert written_lines(result)[1] == "URIs: http://mirror.invalid/debian"


def test_debian_12_without_a_known_mirror_says_what_to_add(tmp_path: Path) -> None:
    result = dry_run(tmp_path, DEBIAN_12, {"sources.list": "deb http://mirror.invalid/debian trixie main\n"})
    assert result.returncode == 1
    assert "no source for Debian's suite 'bookworm'" in result.stderr
    assert "Add the suite 'bookworm-backports'" in result.stderr


@pytest.mark.parametrize(
    "os_release",
    [
        'ID=debian\nVERSION_ID="13"\nPRETTY_NAME="Debian GNU/Linux 13 (trixie)"\n',
        'ID=debian\nPRETTY_NAME="Debian GNU/Linux forky/sid"\n',
        'ID=ubuntu\nID_LIKE=debian\nVERSION_ID="24.04"\nPRETTY_NAME="Ubuntu 24.04.3 LTS"\n',
        'ID=ubuntu\nID_LIKE=debian\nVERSION_ID="26.04"\nPRETTY_NAME="Ubuntu 26.04 LTS"\n',
    ],
)
def test_newer_debian_and_ubuntu_need_no_other_suite(os_release: str, tmp_path: Path) -> None:
    result = dry_run(tmp_path, os_release)
    assert result.returncode == 0, result.stderr
    assert written_lines(result) == []
    assert install_command(result).endswith(f"--no-install-recommends {PACKAGES}")


@pytest.mark.parametrize(
    "os_release",
    [
        'ID=ubuntu\nID_LIKE=debian\nVERSION_ID="22.04"\nPRETTY_NAME="Ubuntu 22.04.5 LTS"\n',
        'ID=linuxmint\nID_LIKE="ubuntu debian"\nVERSION_ID="22"\nPRETTY_NAME="Linux Mint 22"\n',
    ],
)
def test_unsure_distributions_are_tried_and_said_to_be_unsure(os_release: str, tmp_path: Path) -> None:
    result = dry_run(tmp_path, os_release)
    assert result.returncode == 0, result.stderr
    assert "the check after the installation tells" in result.stdout
    assert install_command(result).endswith(PACKAGES)


@pytest.mark.parametrize(
    ("os_release", "advice"),
    [
        (
            'ID=debian\nVERSION_ID="11"\nPRETTY_NAME="Debian GNU/Linux 11 (bullseye)"\n',
            "Debian 12 or newer works",
        ),
        ('ID=ubuntu\nVERSION_ID="20.04"\nPRETTY_NAME="Ubuntu 20.04.6 LTS"\n', "Ubuntu 24.04 or newer works"),
        ('ID=fedora\nVERSION_ID=42\nPRETTY_NAME="Fedora Linux 42"\n', "dnf install mesa-vulkan-drivers"),
        ('ID=arch\nPRETTY_NAME="Arch Linux"\n', "pacman -S vulkan-swrast"),
        ('ID="opensuse-tumbleweed"\nPRETTY_NAME="openSUSE Tumbleweed"\n', "zypper install libvulkan_lvp"),
        ('ID=void\nPRETTY_NAME="Void Linux"\n', "your package manager"),
    ],
)
def test_other_distributions_are_told_what_to_do(os_release: str, advice: str, tmp_path: Path) -> None:
    result = dry_run(tmp_path, os_release)
    assert result.returncode == 1
    assert advice in result.stderr
    assert "apt-get" not in result.stdout


def test_an_unknown_option_is_refused() -> None:
    result = subprocess.run(["bash", str(SCRIPT), "--force"], capture_output=True, text=True, timeout=300)
    assert result.returncode == 1
    assert "unknown option '--force'" in result.stderr


@pytest.mark.render
def test_a_machine_that_renders_is_left_alone() -> None:
    result = subprocess.run(["bash", str(SCRIPT)], capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("vulkan: nothing to install:")


@pytest.mark.render
def test_a_hidden_driver_is_reported_as_no_device() -> None:
    environment = {**os.environ, "VK_ICD_FILENAMES": os.devnull, "VK_DRIVER_FILES": os.devnull}
    script = SCRIPT.parent / "check_vulkan.py"
    result = subprocess.run(
        [sys.executable, str(script)], env=environment, capture_output=True, text=True, timeout=300
    )
    assert result.returncode == 1
    assert result.stdout.startswith("no: the Vulkan loader found no driver")
    assert "`make vulkan`" in result.stdout


@pytest.mark.render
def test_every_device_is_listed_with_the_feature_that_sapien_needs() -> None:
    script = SCRIPT.parent / "check_vulkan.py"
    result = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout
    *devices, verdict = result.stdout.splitlines()
    assert any(
        re.search(r": Vulkan 1\.\d+\.\d+, has descriptorBindingPartiallyBound$", line) for line in devices
    )
    assert verdict == "yes: there is a Vulkan device that SAPIEN can use"
