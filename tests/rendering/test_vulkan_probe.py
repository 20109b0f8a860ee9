"""What is said of a machine that cannot take pictures, and of one that only takes its time."""

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from maniskill_tomato.errors import RenderingUnavailableError
from maniskill_tomato.rendering import vulkan_probe
from maniskill_tomato.segmentation.synthesis.dataset_rendering import DatasetConfig, make_dataset


@pytest.fixture(autouse=True)
def forgotten() -> Iterator[None]:
    """No test hears the answer of another one."""
    for answer in (vulkan_probe.render_backend, vulkan_probe._ask_for_a_picture):
        answer.cache_clear()
    yield
    for answer in (vulkan_probe.render_backend, vulkan_probe._ask_for_a_picture):
        answer.cache_clear()


def test_a_probe_that_takes_too_long_is_not_a_missing_device(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(vulkan_probe, "PROBE_TIMEOUT_SECONDS", 0.01)
    monkeypatch.setattr(vulkan_probe, "_PROBE", "import time; time.sleep(60)")
    with caplog.at_level(logging.WARNING):
        assert vulkan_probe.rendering_problem() is None
    assert vulkan_probe.render_backend() == "cpu"
    assert "took over 0 s: this machine is busy, or its Vulkan driver hangs" in caplog.text


@pytest.mark.parametrize(
    ("probe", "reason", "hint"),
    [
        (
            "raise RuntimeError('vk::createInstanceUnique: ErrorIncompatibleDriver')",
            "IncompatibleDriver",
            True,
        ),
        ("import no_such_module", "No module named 'no_such_module'", False),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "exit status -11", False),
    ],
)
def test_a_dataset_is_refused_with_what_happened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, probe: str, reason: str, hint: bool
) -> None:
    monkeypatch.setattr(vulkan_probe, "_PROBE", probe)
    with pytest.raises(RenderingUnavailableError, match=reason) as refused:
        make_dataset(DatasetConfig(count=1), tmp_path / "data")
    assert ("make vulkan" in str(refused.value)) == hint


def test_a_variable_that_hides_all_drivers_is_named_instead_of_an_installation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vulkan_probe, "_PROBE", "raise RuntimeError('vk::createInstanceUnique: none')")
    monkeypatch.setenv("VK_DRIVER_FILES", f"{tmp_path}/gone.json")
    monkeypatch.delenv("VK_ICD_FILENAMES", raising=False)
    problem = vulkan_probe.rendering_problem()
    assert problem is not None and "`unset VK_DRIVER_FILES`" in problem and "gone.json" in problem
    (tmp_path / "gone.json").touch()
    problem = vulkan_probe.rendering_problem()
    assert problem is not None and problem.startswith(vulkan_probe.NO_RENDERING_HINT)
