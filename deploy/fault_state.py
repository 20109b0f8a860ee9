"""What is known of a run at the moment of a fault: the last message of its recording, explained by `deploy replay`."""

import math
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Final

import numpy as np

from maniskill_tomato.deploy.deploy_errors import DeployError
from maniskill_tomato.deploy.interface import ArmState
from maniskill_tomato.deploy.move_watch import MoveWatch
from maniskill_tomato.errors import PolicyError, TomatoError

STATES_KEPT: Final = 50
"""So many of the last readings of the arm are kept."""


@dataclass(frozen=True, kw_only=True)
class FaultState:
    """Plain numbers, strings and lists; numbers may be NaN or infinite."""

    reason: str
    """The short word for it."""
    detail: str
    """In words."""
    stamp: float | None
    """When it was noticed, in [s]; None where the clock is the fault."""
    arm_states: tuple[dict[str, Any], ...] = ()
    """The last readings of the arm, the newest last: `stamp`, `joint_positions`, `joint_velocities`; units as in
    `ArmState`."""
    plan: dict[str, Any] | None = None
    """The last move that was sent: `start`, `goal` [rad], `speed_fraction`, `seconds` (how long it should take), `sent`
    (when, in [s]), `under_way`, and `worst`, the nearest that each tolerance of `MoveWatch` came to being passed."""
    refused: str = ""
    """What the guard said to the last command that it refused."""
    stop: str | None = None
    """Why the run was asked to stop, if it was."""
    memory: Mapping[str, int]
    """How many things the run held: looks, moves, plant points, and so on."""
    traceback: str = ""
    """Where in the code it was noticed."""

    def to_json(self) -> dict[str, Any]:
        """As JSON has it: numbers that are not finite become the strings `nan`, `inf` and `-inf`."""
        plain: dict[str, Any] = _named(asdict(self))
        return plain

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> "FaultState":
        """What `to_json` gave.

        Raises:
            KeyError, TypeError, ValueError: It is something else.
        """
        values = {field.name: content[field.name] for field in fields(FaultState)}
        states = tuple(
            {
                "stamp": float(state["stamp"]),
                "joint_positions": _floats(state["joint_positions"]),
                "joint_velocities": _floats(state["joint_velocities"]),
            }
            for state in values["arm_states"]
        )
        plan = values["plan"]
        if plan is not None:
            plan = {
                "start": _floats(plan["start"]),
                "goal": _floats(plan["goal"]),
                **{name: float(plan[name]) for name in ("speed_fraction", "seconds", "sent")},
                "under_way": bool(plan["under_way"]),
                "worst": {str(kind): float(share) for kind, share in plan["worst"].items()},
            }
        stamp = values["stamp"]
        return FaultState(
            reason=str(values["reason"]),
            detail=str(values["detail"]),
            stamp=None if stamp is None else float(stamp),
            arm_states=states,
            plan=plan,
            refused=str(values["refused"]),
            stop=None if values["stop"] is None else str(values["stop"]),
            memory={str(name): int(count) for name, count in values["memory"].items()},
            traceback=str(values["traceback"]),
        )


def state_facts(state: ArmState) -> dict[str, Any]:
    """A reading of the arm in plain numbers."""
    return {
        "stamp": state.stamp,
        "joint_positions": state.joint_positions.tolist(),
        "joint_velocities": state.joint_velocities.tolist(),
    }


def plan_facts(watch: MoveWatch, is_under_way: bool) -> dict[str, Any]:
    """The last move in plain numbers."""
    return {
        "start": watch.start.tolist(),
        "goal": watch.goal.tolist(),
        "speed_fraction": watch.speed_fraction,
        "seconds": watch.seconds,
        "sent": watch.began,
        "under_way": is_under_way,
        "worst": dict(watch.worst),
    }


def reason_of(error: Exception) -> str:
    """The short word for an error; `unexpected` for one that nobody raised on purpose."""
    if isinstance(error, PolicyError):
        return "policy"
    if isinstance(error, DeployError):
        return error.reason
    return "fault" if isinstance(error, TomatoError) else "unexpected"


def detail_of(error: Exception) -> str:
    """An error in words."""
    if isinstance(error, TomatoError):
        return str(error)
    return (
        f"{type(error).__name__}: {error}; this is a fault of maniskill-tomato or of a package that it uses"
    )


def early_fault(error: Exception) -> FaultState:
    """What is known of a fault before the first look."""
    return FaultState(
        reason=reason_of(error), detail=detail_of(error), stamp=None, memory={}, traceback=lines_of(error)
    )


def lines_of(error: BaseException) -> str:
    """The traceback of an error."""
    return "".join(traceback.format_exception(error))


def explained(fault: FaultState, profile: str) -> Iterator[str]:
    """Lines for people.

    Args:
        fault: What was kept.
        profile: Name of the run's profile.
    """
    when = "at an unknown time" if fault.stamp is None else f"at {fault.stamp:.3f} s"
    yield f"fault   {fault.reason}: {fault.detail} (noticed {when}, profile {profile})"
    if not fault.arm_states:
        yield "arm     it had given no reading"
    else:
        last = fault.arm_states[-1]
        joints = np.array(last["joint_positions"])
        first = fault.arm_states[0]["stamp"]
        yield f"arm     {len(fault.arm_states)} readings from {first:.3f} to {last['stamp']:.3f} s; the last: "
        yield f"        joints at ({_degrees(joints)}) deg, turning at ({_degrees(last['joint_velocities'])}) deg/s"
        bad = [f"A{k + 1}" for k in np.flatnonzero(~np.isfinite(joints))]
        if bad:
            yield f"        not finite: {', '.join(bad)}"
    if fault.plan is None:
        yield "move    none had been sent"
    else:
        yield from _move_lines(fault.plan, fault.arm_states)
    if fault.refused:
        yield f"refused {fault.refused}"
    if fault.stop is not None:
        yield f"stop    asked for: {fault.stop}"
    held = ", ".join(f"{count} {name}" for name, count in fault.memory.items())
    yield f"memory  {held or 'nothing yet: it was before the first look'}"
    yield from fault.traceback.rstrip().splitlines()


def _move_lines(plan: dict[str, Any], states: tuple[dict[str, Any], ...]) -> Iterator[str]:
    goal = np.array(plan["goal"])
    what = "was under way" if plan["under_way"] else "had ended or was stopped"
    yield f"move    to ({_degrees(goal)}) deg at {plan['speed_fraction']:g} of the speed, sent at {plan['sent']:.3f} s"
    yield f"        for {plan['seconds']:.1f} s; it {what}"
    if states:
        left = np.abs(goal - np.array(states[-1]["joint_positions"]))
        if np.isfinite(left).all():
            k = int(left.argmax())
            yield f"        at the last reading A{k + 1} was {left[k]:.4f} rad from its end"
    near = ", ".join(f"{kind} {share:.0%}" for kind, share in plan["worst"].items() if share > 0.0)
    if near:
        yield f"        of the tolerances were used up: {near}"


def _degrees(radians: Any) -> str:
    return ", ".join(f"{math.degrees(v):.2f}" if math.isfinite(v) else str(v) for v in radians)


def _floats(values: Any) -> list[float]:
    if len(values) != 7:
        raise ValueError(f"{len(values)} joints in place of 7")
    return [float(value) for value in values]


def _named(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _named(v) for name, v in value.items()}
    if isinstance(value, list | tuple):
        return [_named(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value
