"""How far a profile may go: every number has a floor and a ceiling with a reason, and what a profile relaxes is told.

The dataclasses check that a number means something; what is here is what a lab may choose, in a profile or, for a real
arm, in a program. The base of the arm stays a forbidden zone. `docs/deploy.md` has the table.
"""

from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any, Final, Literal

from maniskill_tomato.deploy.collision import Box
from maniskill_tomato.deploy.safety_config import LARGEST_SPEED_FRACTION, SafetyConfig
from maniskill_tomato.errors import InvalidInputError

Laxer = Literal["more", "less"]
"""Which way from its default a number relaxes a check."""


@dataclass(frozen=True)
class Bound:
    """What a profile may choose for one number."""

    low: float
    high: float
    laxer: Laxer | None
    """None where no check depends on it."""
    reason: str
    """Why not less or not more."""


BOUNDS: Final[dict[str, dict[str, Bound]]] = {
    "safety": {
        "speed_fraction": Bound(0.005, LARGEST_SPEED_FRACTION, "more", "people must be able to react"),
        "max_speed_fraction": Bound(0.005, LARGEST_SPEED_FRACTION, "more", "people must be able to react"),
        "joint_margin": Bound(0.01, 0.5, "less", "drivers let joints be up to 0.01 rad off"),
        "max_joint_step": Bound(0.001, 2.0, "more", "in a longer move nothing new is seen of the plant"),
        "max_flange_step": Bound(
            0.001, 0.6, "more", "in a longer move nothing new is seen of the plant; the camera needs 0.12 m"
        ),
        "table_height": Bound(-1.0, 0.3, "less", "a surface farther down is not what the arm stands on"),
        "table_clearance": Bound(0.01, 0.5, "less", "heights are measured to a few millimetres"),
        "self_clearance": Bound(0.002, 0.5, "less", "meshes and joints are exact to about a millimetre"),
        "obstacle_clearance": Bound(0.01, 0.5, "less", "places of things are measured to a few millimetres"),
        "plant_clearance": Bound(-0.025, 0.3, "less", "the spheres are up to 25 mm larger than the links"),
        "plant_points_needed": Bound(1, 50, "more", "50 points are about 0.01 m^2 of leaf"),
        "leave_within": Bound(0.005, 0.05, "more", "0.05 rad are 40 mm at the hand"),
        "max_state_age": Bound(0.02, 2.0, "more", "at 0.3 of its speed a joint turns 1.4 rad in 2 s"),
        "max_frame_age": Bound(0.1, 60.0, "more", "plants and people move"),
        "arrival_tolerance": Bound(0.001, 0.05, "more", "0.05 rad are 40 mm at the hand"),
    },
    "loop": {
        "threshold": Bound(0.05, 0.999, None, "V_f is a share; above 0.999 it is never reached"),
        "max_moves": Bound(1, 1000, None, "a run ends within hours"),
        "lost_after": Bound(1, 1000, None, "a run ends within hours"),
        "refused_after": Bound(1, 100, None, "what is refused a hundred times in a row is refused again"),
        "settle": Bound(0.0, 10.0, "less", "an arm stands after seconds"),
    },
    "capture": {
        "attempts": Bound(1, 100, "more", "a camera that fails a hundred times is broken"),
        "pause": Bound(0.0, 10.0, None, "longer is waiting for nothing"),
        "max_age": Bound(0.02, 5.0, "more", "plants and people move"),
        "min_depth_share": Bound(1e-4, 0.999, "less", "without depth nobody knows what is near"),
    },
    "stop": {
        "heartbeat": Bound(1.0, 300.0, "more", "an arm whose program hangs must not wait for minutes"),
    },
}
"""By table and key."""

LARGEST_WORKSPACE: Final = Box(low=(-1.0, -1.0, 0.0), high=(1.0, 1.0, 1.4))
"""The flange reaches 0.95 m from the shoulder; outside this box a limit would be none."""

BASE_ZONE: Final = SafetyConfig().forbidden[0]
"""Around the base (Eq. 5-4): no profile takes it away."""


def check_bounds(table: str, config: Any) -> None:
    """Accepts a table of a profile whose numbers are within their bounds.

    Args:
        table: Its name, a key of `BOUNDS`.
        config: Its dataclass.

    Raises:
        InvalidInputError: One is not, with the key, the value, what is allowed and why.
    """
    for name, bound in BOUNDS[table].items():
        value = getattr(config, name)
        if value is not None and not bound.low <= value <= bound.high:
            raise InvalidInputError(
                f"{table}.{name} must be from {bound.low:g} to {bound.high:g}, got {value:g} ({bound.reason})"
            )
    if isinstance(config, SafetyConfig):
        _check_workspace(config.workspace)


def _check_workspace(box: Box) -> None:
    largest = LARGEST_WORKSPACE
    for name, corner, low, high in (
        ("low", box.low, largest.low, largest.high),
        ("high", box.high, largest.low, largest.high),
    ):
        for axis, value, least, most in zip("xyz", corner, low, high, strict=True):
            if not least <= value <= most:
                raise InvalidInputError(
                    f"safety.workspace.{name} must have {axis} from {least:g} to {most:g} m, got {value:g} (the arm "
                    "reaches no farther, so that the limit would be none)"
                )


def check_envelope(config: SafetyConfig) -> None:
    """Accepts an envelope that a real arm may have, whoever made it.

    Raises:
        InvalidInputError: A number is outside its bounds, or the zone around the base is missing.
    """
    check_bounds("safety", config)
    if BASE_ZONE not in config.forbidden:
        raise InvalidInputError(
            f"safety.forbidden must keep the zone around the base, {BASE_ZONE}, got {config.forbidden}; "
            "`with_base_zone` adds it"
        )


def with_base_zone(config: SafetyConfig) -> SafetyConfig:
    """The envelope with the forbidden zone around the base, which a profile can only add to."""
    if BASE_ZONE in config.forbidden:
        return config
    return replace(config, forbidden=(*config.forbidden, BASE_ZONE))


def relaxed(table: str, config: Any, laxer: Mapping[str, Laxer] | None = None) -> Iterator[str]:
    """What a table relaxes against its defaults, one line a number.

    Args:
        table: Its name in the profile.
        config: Its dataclass.
        laxer: Which way each number relaxes; None for those of `BOUNDS`.
    """
    if laxer is None:
        laxer = {name: b.laxer for name, b in BOUNDS[table].items() if b.laxer is not None}
    for field in fields(config):
        value = getattr(config, field.name)
        if field.default is MISSING:
            continue
        if field.name == "workspace" and not _inside(value, field.default):
            yield f"{table}.workspace = {value} (default {field.default})"
        way = laxer.get(field.name)
        if way is not None and _is_laxer(value, field.default, way):
            yield f"{table}.{field.name} = {_text(value)} (default {_text(field.default)})"


def _is_laxer(value: Any, default: Any, way: Laxer) -> bool:
    if value is None or default is None:
        return value is None and default is not None
    if isinstance(value, tuple):
        return any(_is_laxer(v, d, way) for v, d in zip(value, default, strict=True))
    return bool(value > default if way == "more" else value < default)


def _inside(box: Box, outer: Box) -> bool:
    return all(a >= b for a, b in zip(box.low, outer.low, strict=True)) and all(
        a <= b for a, b in zip(box.high, outer.high, strict=True)
    )


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return str(list(value))
    return "off" if value is None else f"{value:g}"
