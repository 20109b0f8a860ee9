"""Which tests this machine can run: `render` needs a Vulkan device, `browser` needs Chromium, `gpu` needs CUDA.

Where pictures must work (CI=true or TOMATO_REQUIRE_RENDER=1), a `render` test that cannot run fails;
elsewhere it is skipped. So does a `browser` test with CI=true. Every other skip fails then too, of a test as of a
whole module, unless `ALLOWED_SKIPS` lists it: a package that cannot be imported any more must not take its tests along
unseen.
"""

import functools
import os
import shutil
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    import torch

    from maniskill_tomato.experiments.episode_record import EpisodeRecord
    from maniskill_tomato.raycast.embree import Backend

ROOT = Path(__file__).resolve().parent.parent
PROBE_SECONDS = 300
"""A picture takes a second or two when the machine is idle."""

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
"""Programs that can be Chromium."""

STORED_ID = "TomatoViewpoint-v1"
STORED_OPTIONS: dict[str, Any] = {"episodes": "held_out"}

NO_BROWSER = "no Chromium on PATH; `make browser` installs one"

ALLOWED_SKIPS = {
    "tests/test_examples.py::test_ap_gym_takes_a_prediction_of_what_is_visible_with_every_move": (
        "ap_gym is not installed"  # With what it needs it takes 400 MB.
    ),
    "tests/learning/test_learning_wandb.py::test_the_real_package_logs_without_a_network": (
        "wandb is not installed; it is an extra"
    ),
    "tests/deploy/test_deploy_calibration.py::test_the_closed_form_is_that_of_opencv": (
        "this OpenCV hides its own solution from Python"
    ),
    "tests/deploy/test_recording_viewers.py::test_rerun_reads_the_recording_as_arm_pictures_and_points": (
        "no rerun on PATH"  # With what it needs it takes 800 MB.
    ),
    **{
        f"tests/integrations/test_lerobot.py::{name}": (
            "MANISKILL_TOMATO_LEROBOT_PYTHON names no environment with LeRobot"  # It takes 6 GB.
        )
        for name in (
            "test_lerobot_loads_runs_as_they_were_recorded",
            "test_lerobot_loads_demonstrations_with_images",
            "test_lerobot_drives_the_guarded_arm_and_is_refused_what_is_unsafe",
            "test_lerobot_replays_a_converted_run_on_its_twin_and_on_no_other",
            "test_lerobots_evaluation_counts_successes_as_a_plain_loop_does",
        )
    },
}
"""What may be skipped with CI=true, and the reason that it gives."""

# ManiSkill asks on the terminal before it downloads an asset; a test must not wait for an answer.
os.environ.setdefault("MS_SKIP_ASSET_DOWNLOAD_PROMPT", "1")

# Two threads that wait for each other on cores that have other work are many times slower than one; the networks and
# batches of tests are small. Set before PyTorch is imported, and handed on to the processes that tests start.
os.environ.setdefault("OMP_NUM_THREADS", "1")


@functools.cache
def rendering_problem() -> str | None:
    """Why SAPIEN cannot render here, or None if it can; asked once, in another process: drivers crash."""
    command = [sys.executable, "-W", "ignore", str(ROOT / "scripts" / "check_vulkan.py"), "--render"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        return f"a first picture took more than {PROBE_SECONDS} s"
    if result.returncode == 0:
        return None
    output = (result.stdout + result.stderr).strip().splitlines()
    return output[-1].removeprefix("no: ") if output else f"the probe ended with status {result.returncode}"


def rendering_required() -> bool:
    """Whether a test that cannot render is a failure."""
    return os.environ.get("CI") == "true" or os.environ.get("TOMATO_REQUIRE_RENDER") == "1"


def browser_path() -> str | None:
    """The Chromium of this machine, None if it has none; `scripts/install_browser.sh` looks for the same names."""
    return next((path for name in BROWSERS if (path := shutil.which(name)) is not None), None)


@pytest.fixture
def chromium() -> str:
    """The path of a Chromium; for tests with the marker `browser`."""
    path = browser_path()
    assert path is not None
    return path


@pytest.fixture(scope="session")
def stored() -> "dict[str, list[EpisodeRecord]]":
    """What two policies did in the same two episodes, for tests of the viewer."""
    from maniskill_tomato.experiments.rollout import run_episode
    from maniskill_tomato.policies.opening import open_policy
    from maniskill_tomato.tasks.vector_env import make_vector_env

    env: Any = make_vector_env(STORED_ID, arrays="torch", autoreset_mode="Disabled", **STORED_OPTIONS)
    return {
        name: [run_episode(env, open_policy(name, env_id=STORED_ID), seed) for seed in (0, 1)]
        for name in ("nbv", "random_step")
    }


@pytest.fixture(scope="session")
def record_folder(tmp_path_factory: pytest.TempPathFactory, stored: "dict[str, list[EpisodeRecord]]") -> Path:
    """The folder of these episodes."""
    from maniskill_tomato.experiments.stored_episodes import store_episodes

    folder = tmp_path_factory.mktemp("record") / "benchmark"
    store_episodes(folder, STORED_ID, STORED_OPTIONS, {name: name for name in stored}, stored)
    return folder


def unlisted_skip(report: pytest.TestReport | pytest.CollectReport) -> str | None:
    """Why a report fails where every skip must be listed; None if it does not."""
    if os.environ.get("CI") != "true" or not report.skipped or hasattr(report, "wasxfail"):
        return None
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    reason = reason.removeprefix("Skipped: ")
    if "gpu" in getattr(report, "keywords", ()) and reason == cuda_problem():
        return None
    if ALLOWED_SKIPS.get(report.nodeid) == reason:
        return None
    return (
        f"skipped, but no skip of it with this reason is listed: {reason}\n"
        "With CI=true everything runs. Install what is missing, or give the reason in ALLOWED_SKIPS of "
        "tests/conftest.py."
    )


@functools.cache
def cuda_problem() -> str | None:
    """Why CUDA cannot be used here, or None if it can."""
    import torch

    return None if torch.cuda.is_available() else "no CUDA device"


@functools.cache
def keep_renderer_alive() -> object:
    """Holds SAPIEN's renderer for the session: it goes with its last scene, and the next compiles its shaders anew."""
    import sapien
    import torch

    return sapien.render.RenderSystem(sapien.Device("cuda" if torch.cuda.is_available() else "cpu"))


LONG_FILES = (
    "test_learning_resume.py",
    "test_world.py",
    "test_cli.py",
    "test_camera_perception.py",
    "test_learning_seeds.py",
    "test_deploy_loop.py",
    "test_plants.py",
    "test_row_env.py",
    "test_tasks_options.py",
    "test_tasks_rendered.py",
    "test_maniskill_contract.py",
    "test_view_quality.py",
    "test_learning_training.py",
    "test_deploy_sunrise_loop.py",
    "test_tasks_state.py",
    "test_deploy_cli.py",
    "test_light_segmenter.py",
    "test_planners.py",
    "test_examples.py",
    "test_deploy_inspect.py",
    "test_inspected_rows.py",
    "test_planners_env.py",
    "test_comparison.py",
    "test_worker_pool.py",
    "test_play.py",
    "test_page_browser.py",
    "test_page.py",
    "test_play_session.py",
)
"""Those that take longest come first, so that no process is left with one of them at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if cuda_problem() is None and any(item.get_closest_marker("gpu") is not None for item in items):
        # PhysX takes a GPU only before anything else was simulated in the process.
        import sapien

        if not sapien.physx.is_gpu_enabled():
            sapien.physx.enable_gpu()
    rank = {name: k for k, name in enumerate(LONG_FILES)}
    items.sort(key=lambda item: rank.get(item.path.name, len(LONG_FILES)))


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("gpu") is not None and (problem := cuda_problem()) is not None:
        pytest.skip(problem)
    if item.get_closest_marker("render") is not None and (problem := rendering_problem()) is not None:
        if rendering_required():
            pytest.fail(f"rendering is required here, but {problem}", pytrace=False)
        pytest.skip(problem)
    if item.get_closest_marker("render") is not None:
        keep_renderer_alive()
    if item.get_closest_marker("browser") is not None and browser_path() is None:
        if os.environ.get("CI") == "true":
            pytest.fail(NO_BROWSER, pytrace=False)
        pytest.skip(NO_BROWSER)


@pytest.fixture(params=("embree", "warp"))
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> "Backend":
    """What traces the rays of scenes on a CPU that name no backend; tests that use it run once with each."""
    from maniskill_tomato.raycast import scene
    from maniskill_tomato.raycast.embree import choose_backend

    name: Backend = request.param

    def choose(device: "torch.device", wanted: "Backend | None") -> "Backend":
        return choose_backend(device, wanted or (name if device.type == "cpu" else "warp"))

    monkeypatch.setattr(scene, "choose_backend", choose)
    return name


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    report = yield
    if (why := unlisted_skip(report)) is not None:
        report.outcome, report.longrepr = "failed", why
    return report


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if (why := unlisted_skip(report)) is not None:
        report.outcome, report.longrepr = "failed", why
    return report


@pytest.fixture(scope="session")
def extras_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package of `examples/make_it_yours`, built and installed outside of the repository."""
    import uv

    source, site = tmp_path_factory.mktemp("make_it_yours"), tmp_path_factory.mktemp("site")
    shutil.copytree(ROOT / "examples" / "make_it_yours", source, dirs_exist_ok=True)
    options = ["--quiet", "--offline", "--no-deps", "--no-build-isolation", "--python", sys.executable]
    command = [uv.find_uv_bin(), "pip", "install", *options, "--target", str(site), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return site


@pytest.fixture(autouse=True)
def _no_code_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """A test begins as a process does, in which nothing of others has been loaded."""
    from maniskill_tomato import extension_points

    monkeypatch.setattr(extension_points, "_foreign", {})
    monkeypatch.setattr(extension_points, "_loaded", set())


@pytest.fixture
def extras(extras_site: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Has that package in this process; what it registers is forgotten afterwards."""
    import gymnasium

    from maniskill_tomato import task_registry

    monkeypatch.syspath_prepend(str(extras_site))
    monkeypatch.setattr(task_registry, "_registered", dict(task_registry._registered))
    monkeypatch.setattr(task_registry, "_of_path", {})
    known = set(gymnasium.registry)
    yield extras_site
    for env_id in set(gymnasium.registry) - known:
        del gymnasium.registry[env_id]
    for module in [name for name in sys.modules if name.startswith("tomato_extras")]:
        del sys.modules[module]
