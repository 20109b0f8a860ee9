"""JSON Schemas of a recording's own messages: what was run, what was decided, what a simulated camera knew."""

from typing import Any, Final

Schema = dict[str, Any]

_NUMBER: Final[Schema] = {"type": "number"}
_INTEGER: Final[Schema] = {"type": "integer"}
_TEXT: Final[Schema] = {"type": "string"}
_JOINTS: Final[Schema] = {"type": "array", "items": _NUMBER, "minItems": 7, "maxItems": 7}
_POINT: Final[Schema] = {"type": "array", "items": _NUMBER, "minItems": 3, "maxItems": 3}
_POSE: Final[Schema] = {
    "type": "array",
    "items": {"type": "array", "items": _NUMBER, "minItems": 4, "maxItems": 4},
    "minItems": 4,
    "maxItems": 4,
}
_PACKED: Final[Schema] = {
    "type": "object",
    "properties": {
        "dtype": _TEXT,
        "shape": {"type": "array", "items": _INTEGER},
        "data": {"type": "string", "contentEncoding": "base64"},
    },
    "required": ["dtype", "shape", "data"],
}


def _optional(schema: Schema) -> Schema:
    return {"anyOf": [schema, {"type": "null"}]}


def _object(properties: dict[str, Schema], *optional: str) -> Schema:
    return {
        "type": "object",
        "properties": properties,
        "required": [name for name in properties if name not in optional],
    }


INFO: Final = _object(
    {
        "format": {**_TEXT, "description": "of this recording"},
        "clock_start": {**_NUMBER, "description": "the run's clock when the recording began, in [s]"},
        "unix_start_ns": {**_INTEGER, "description": "the machine's date then, in [ns] since 1970"},
        "profile": _TEXT,
        "profile_text": {**_TEXT, "description": "TOML"},
        "policy": _TEXT,
        "policy_name": _TEXT,
        "perception": _TEXT,
        "seed": _INTEGER,
        "mode": _TEXT,
        "simulated": {"type": "boolean"},
        "version": _TEXT,
        "devices": {"type": "object"},
        "T_flange_camera": _POSE,
        "arm_model": {**_TEXT, "description": "name of the arm's model"},
        "row_moves": _INTEGER,
    },
    *(
        "profile",
        "profile_text",
        "policy",
        "policy_name",
        "perception",
        "seed",
        "mode",
        "simulated",
        "version",
    ),
    *("devices", "T_flange_camera", "arm_model", "row_moves"),
)
"""Of `/info`."""

STEP: Final = _object(
    {
        "number": {**_INTEGER, "description": "counts the looks from 0"},
        "stamp": {**_NUMBER, "description": "of the picture, by the run's clock, in [s]"},
        "frame_number": _INTEGER,
        "intrinsics": _object(
            {
                "width": _INTEGER,
                "height": _INTEGER,
                "fx": _NUMBER,
                "fy": _NUMBER,
                "cx": _NUMBER,
                "cy": _NUMBER,
            }
        ),
        "joint_positions": {**_JOINTS, "description": "in [rad]"},
        "T_world_camera": {**_POSE, "description": "the colour camera's optical frame"},
        "target_position": {**_POINT, "description": "base frame, in [m]"},
        "visible_fraction": {**_NUMBER, "description": "V_f"},
        "fraction_margin": {
            **_optional(_NUMBER),
            "description": "how far off V_f may be; the run goes by V_f less this; null where V_f is exact",
        },
        "fruits_seen": _INTEGER,
        "moves_left": _INTEGER,
        "action": {**_optional(_POINT), "description": "right, up, forward in [-1, 1]"},
        "commanded": {**_optional(_JOINTS), "description": "joint positions that were sent, in [rad]"},
        "outcome": _TEXT,
        "detail": {**_TEXT, "description": "why a move was refused or the run ended"},
        "timing_ms": {"type": "object", "additionalProperties": _NUMBER},
    },
    "fraction_margin",
)
"""Of `/step`."""

_ANY_NUMBER: Final[Schema] = {"anyOf": [_NUMBER, {"enum": ["nan", "inf", "-inf"]}]}
_ANY_JOINTS: Final[Schema] = {**_JOINTS, "items": _ANY_NUMBER}

FAULT: Final = _object(
    {
        "reason": _TEXT,
        "detail": _TEXT,
        "stamp": {**_optional(_NUMBER), "description": "when it was noticed, by the run's clock, in [s]"},
        "arm_states": {
            "type": "array",
            "items": _object(
                {
                    "stamp": _ANY_NUMBER,
                    "joint_positions": {**_ANY_JOINTS, "description": "in [rad]"},
                    "joint_velocities": {**_ANY_JOINTS, "description": "in [rad/s]"},
                }
            ),
        },
        "plan": _optional(
            _object(
                {
                    "start": {**_JOINTS, "description": "in [rad]"},
                    "goal": {**_JOINTS, "description": "in [rad]"},
                    "speed_fraction": _NUMBER,
                    "seconds": _NUMBER,
                    "sent": {**_NUMBER, "description": "in [s]"},
                    "under_way": {"type": "boolean"},
                    "worst": {"type": "object", "additionalProperties": _ANY_NUMBER},
                }
            )
        ),
        "refused": _TEXT,
        "stop": _optional(_TEXT),
        "memory": {"type": "object", "additionalProperties": _INTEGER},
        "traceback": _TEXT,
    }
)
"""Of `/fault`."""

TRUTH: Final = _object(
    {
        "labels": {"type": "string", "contentEncoding": "base64", "description": "PNG of 16 bits"},
        "target_label": _INTEGER,
        "target_position": _POINT,
        "visible_fraction": _NUMBER,
        "ripe_labels": {"type": "array", "items": _INTEGER},
        "fruit_labels": {"type": "array", "items": _INTEGER},
        "stem_labels": {"type": "array", "items": _INTEGER},
        "ripe_fractions": {"type": "array", "items": _NUMBER},
        "rays": _object({"direction_c": _PACKED, "distance": _PACKED, "label": _PACKED}),
    }
)
"""Of `/truth`."""
