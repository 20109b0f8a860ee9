"""No number of a profile goes beyond its floor or ceiling, and what a profile relaxes is told at every start."""

import logging
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from maniskill_tomato.deploy.capture import CaptureConfig
from maniskill_tomato.deploy.clock import MonotonicClock
from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.drivers import DriverContext, make_arm
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.profile import Profile, StopConfig, parse_profile
from maniskill_tomato.deploy.profile_bounds import BASE_ZONE, BOUNDS, LARGEST_WORKSPACE
from maniskill_tomato.deploy.run_records import LoopConfig
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.deploy.workcell import make_workcell
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.iiwa14 import IIWA14


class EnvelopeOf(Safety):
    """The checks without their collision model, which takes a while to build."""

    def __init__(self, config: SafetyConfig) -> None:
        self.config, self.model = config, IIWA14


TAKEN_BY_THE_DATACLASS = {("safety", "max_speed_fraction"), ("loop", "settle"), ("capture", "pause")}
"""Whose bounds the dataclass has already."""

DEVICES = '[arm]\ndriver = "mock"\n[camera]\ndriver = "mock"\n'
TABLES: dict[str, Any] = {
    "safety": SafetyConfig,
    "loop": LoopConfig,
    "capture": CaptureConfig,
    "stop": StopConfig,
}
EACH = [(table, name) for table, bounds in BOUNDS.items() for name in bounds]
DOCS = Path(__file__).resolve().parents[2] / "docs" / "deploy.md"


def profile(more: str) -> Profile:
    return parse_profile(DEVICES + more, Path("lab.toml"))


def table(name: str, *lines: str) -> Profile:
    return profile("\n".join([f"[{name}]", *lines]))


def test_every_number_of_these_tables_has_a_bound_around_its_default() -> None:
    for name, kind in TABLES.items():
        numbers = [f for f in fields(kind) if type(f.default) in (int, float)]
        assert {f.name for f in numbers} == set(BOUNDS[name])
        for field in numbers:
            bound = BOUNDS[name][field.name]
            assert isinstance(field.default, int | float)
            assert bound.low <= field.default <= bound.high
            assert math.isfinite(bound.low) and math.isfinite(bound.high)


@pytest.mark.parametrize(("name", "key"), EACH)
def test_what_lies_outside_its_bounds_is_refused_with_key_value_and_range(name: str, key: str) -> None:
    bound = BOUNDS[name][key]
    # A lower largest speed would refuse the usual one.
    lines = ["speed_fraction = 0.005"] if key == "max_speed_fraction" else []
    for value in (bound.low, bound.high):
        found = getattr(table(name, *lines, f"{key} = {value!r}"), name)
        assert getattr(found, key) == value
    step = 1 if isinstance(bound.low, int) else 1e-9
    for value in (bound.low - step, bound.high + step, 1e9 if step != 1 else 10**9, -1e9):
        with pytest.raises(ProfileError) as told:
            table(name, *lines, f"{key} = {value!r}")
        assert key in str(told.value) and "lab.toml" in str(told.value)
    with pytest.raises(ProfileError, match=rf"lab.toml: {name}.{key} must be from .* got 1e\+09|must be"):
        table(name, *lines, f"{key} = 1e9")


def test_the_error_names_the_key_the_value_and_what_is_allowed() -> None:
    with pytest.raises(
        ProfileError, match=r"lab.toml: safety.leave_within must be from 0.005 to 0.05, got 1e-12"
    ):
        table("safety", "leave_within = 1e-12")
    with pytest.raises(
        ProfileError, match=r"safety.arrival_tolerance must be from 0.001 to 0.05, got 1e\+09"
    ):
        table("safety", "arrival_tolerance = 1e9")


@pytest.mark.parametrize(
    "name", ["a\\u0000b", "..", ".", "", "a/b", "run.mcap", "calibration.json", "Report.PNG"]
)
def test_a_stop_file_is_named_as_a_file_that_nothing_else_writes(name: str) -> None:
    with pytest.raises(ProfileError, match=r"stop: file must"):
        profile(f'[stop]\nfile = "{name}"\n')
    assert profile('[stop]\nfile = "halt.txt"\n').stop.file == "halt.txt"


def test_no_profile_takes_the_zone_around_the_base_away() -> None:
    assert table("safety", "forbidden = []").safety.forbidden == (BASE_ZONE,)
    more = table("safety", "forbidden = [{ low = [0.5, 0.0, 0.0], high = [0.6, 1.0, 1.0] }]").safety
    assert BASE_ZONE in more.forbidden and len(more.forbidden) == 2


@pytest.mark.parametrize("corner", range(6))
def test_the_workspace_ends_where_the_arm_does(corner: int) -> None:
    values = [*LARGEST_WORKSPACE.low, *LARGEST_WORKSPACE.high]

    def box() -> Profile:
        return table("safety", f"workspace = {{ low = {values[:3]}, high = {values[3:]} }}")

    assert box().safety.workspace == LARGEST_WORKSPACE
    values[corner] += 0.01 if corner >= 3 else -0.01
    with pytest.raises(
        ProfileError, match=rf"workspace.{'low' if corner < 3 else 'high'} must have {'xyz'[corner % 3]}"
    ):
        box()


def test_what_a_profile_relaxes_is_told_and_what_it_tightens_is_not() -> None:
    found = profile(
        "[safety]\nmax_joint_step = 1.9\njoint_margin = 0.01\nplant_clearance = 0.1\nmax_state_age = 0.1\n"
        "workspace = { low = [-0.95, -0.5, 0.2], high = [0.5, 0.5, 1.0] }\n[stop]\nheartbeat = 61.0\n"
    ).relaxations()
    assert [line.split(" = ")[0] for line in found] == [
        "safety.joint_margin",
        "safety.max_joint_step",
        "safety.workspace",
        "stop.heartbeat",
    ]
    assert found[1] == "safety.max_joint_step = 1.9 (default 1.5)"
    assert profile("").relaxations() == ()


def test_every_start_tells_what_is_relaxed(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        make_workcell(table("safety", "max_joint_step = 1.9"))
    assert "the profile relaxes safety.max_joint_step = 1.9 (default 1.5)" in caplog.text


def test_options_of_an_iiwa_have_ceilings_too_and_are_told() -> None:
    context = DriverContext(clock=MonotonicClock())
    for driver in ("sunrise", "libiiwa"):
        margins = [30.0, 31.0, 15.0, 15.0, 10.0, 4.0, 4.0]
        arm = make_arm(
            driver, {"torque_margin": margins, "rest_tolerance": 0.02, "largest_segment": 0.1}, context
        )
        assert [line.split(" = ")[0] for line in arm.relaxations()] == [
            "arm.torque_margin",
            "arm.rest_tolerance",
        ]
        with pytest.raises(ProfileError, match=r"up to half of what the joints can do, \[160.0"):
            make_arm(driver, {"torque_margin": [161.0, *margins[1:]]}, context)
        with pytest.raises(ProfileError, match="rest_tolerance must be from 1e-05 to 0.05, got 1000000000.0"):
            make_arm(driver, {"rest_tolerance": 1e9}, context)


@pytest.mark.parametrize(("name", "key"), EACH)
def test_a_program_gives_a_real_arm_no_number_beyond_its_bounds_either(name: str, key: str) -> None:
    bound = BOUNDS[name][key]
    real = parse_profile('[arm]\ndriver = "sunrise"\n[camera]\ndriver = "realsense"\n', Path("lab.toml"))
    refused = 0
    step = 1 if isinstance(bound.low, int) else 1e-6
    for value in (bound.low - step, bound.high + step):
        try:
            wide = replace(getattr(real, name), **{key: value})
        except InvalidInputError:
            continue  # Its own dataclass does not take it.
        with pytest.raises(ProfileError, match=rf"lab: {name}.{key} must be from"):
            make_workcell(replace(real, **{name: wide}))
        refused += 1
        if name == "safety":
            arm = make_arm("sunrise", {}, DriverContext(clock=MonotonicClock()))
            with pytest.raises(ProfileError, match=rf"the guard of a real arm: safety.{key} must be from"):
                GuardedArm(arm, EnvelopeOf(wide), MonotonicClock())
    assert refused or (name, key) in TAKEN_BY_THE_DATACLASS


def test_the_guard_of_a_real_arm_keeps_the_zone_around_the_base() -> None:
    arm = make_arm("sunrise", {}, DriverContext(clock=MonotonicClock()))
    with pytest.raises(ProfileError, match="must keep the zone around the base"):
        GuardedArm(arm, EnvelopeOf(SafetyConfig(forbidden=())), MonotonicClock())
    GuardedArm(arm, EnvelopeOf(SafetyConfig()), MonotonicClock())
    arm.simulated = True
    GuardedArm(arm, EnvelopeOf(SafetyConfig(forbidden=(), max_state_age=10.0)), MonotonicClock())


def test_the_table_of_the_documentation_is_what_is_checked() -> None:
    text = DOCS.read_text(encoding="utf-8")
    for name, key in EACH:
        bound = BOUNDS[name][key]
        default = next(f.default for f in fields(TABLES[name]) if f.name == key)
        told = {"more": "larger", "less": "smaller", None: ""}[bound.laxer]
        row = f"| `{name}.{key}` | {default:g} | {bound.low:g} to {bound.high:g} | {told} | {bound.reason} |"
        assert row in text, row
