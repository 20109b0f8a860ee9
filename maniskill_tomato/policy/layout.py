"""The order and the units of what a policy observes and does."""

OBSERVATION_NAMES = (
    "ee_x",
    "ee_y",
    "ee_z",
    "ee_roll",
    "ee_pitch",
    "ee_yaw",
    "target_x",
    "target_y",
    "target_z",
)
"""The observation, in order; world frame, [m] and [rad]."""

OBSERVATION_UNITS = ("m", "m", "m", "rad", "rad", "rad", "m", "m", "m")
"""The unit of each observed value."""

ACTION_NAMES = ("dx", "dy", "dz", "droll", "dpitch", "dyaw")
"""The action, in order; an action of 1 is 1 m or 1 rad."""

ACTION_UNITS = ("m", "m", "m", "rad", "rad", "rad")
"""The unit of each action value."""

TARGET_POSITION = slice(6, 9)
"""Where the target's position is in the observation."""
