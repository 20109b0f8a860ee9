"""The `arm` table of a profile: how to reach an iiwa through the Sunrise Toolbox, and what is mounted on it."""

from dataclasses import dataclass

from maniskill_tomato.deploy.sunrise.client import TorqueKind
from maniskill_tomato.errors import InvalidInputError, check_ranges
from maniskill_tomato.robot.iiwa14 import NUM_JOINTS


@dataclass(frozen=True, kw_only=True)
class SunriseConfig:
    """Options of the driver `sunrise`."""

    host: str = "172.31.1.147"
    """Address of the controller; this is the cabinet's default on the socket X66."""
    port: int = 30001
    """TCP port of the toolbox server."""
    flange_xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where Sunrise's flange lies in the plain flange face (126 mm from the wrist), in [m]. A media flange moves it;
    KUKA's own ROS 2 model has (0, 0, 0.026)."""
    flange_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Fixed-axis roll, pitch, yaw of Sunrise's flange in the plain flange face, in [rad]."""
    tool_xyzabc: tuple[float, float, float, float, float, float] | None = None
    """A tool to mount in Sunrise's flange frame: x, y, z, in [m], A, B, C, in [rad] about z, y, x. Only the pose check
    uses it; the load must be set in Sunrise."""
    torque_margin: tuple[float, ...] = (30.0, 30.0, 15.0, 15.0, 10.0, 4.0, 4.0)
    """How far each joint's torque may leave what it is before the move until the arm stops, in [N m]; about a tenth of
    what the joints can do. Shape (7,)."""
    torque_kind: TorqueKind = "external"
    """Which torque the windows lie around. Which one Sunrise compares with them is for the first test in T1 to
    show: with the wrong one moves are stopped where nothing touches the arm."""
    largest_segment: float = 0.15
    """Moves are sent in pieces in which no joint turns farther, in [rad]: a stop takes effect at the end of a piece."""
    connect_timeout_s: float = 5.0
    """How long to try to connect, in [s]."""
    connect_pause_s: float = 1.0
    """Wait after connecting, in [s]: the server's threads come up one after the other."""
    reply_timeout_s: float = 2.0
    """How long an answer may take before the connection is given up, in [s]."""
    move_margin_s: float = 2.0
    """A piece of a move may take twice its computed time and this, in [s]."""
    pose_tolerance_m: float = 0.002
    """How far Sunrise's flange and ours may lie apart when connecting, in [m]."""
    pose_tolerance_rad: float = 0.01
    """The same for the orientation, in [rad]."""
    arrival_tolerance: float = 0.002
    """How far a joint may be from its target after a move, in [rad]; Sunrise itself allows 0.1 degrees."""
    rest_tolerance: float = 0.01
    """How far a joint may be from where it stood without a move, in [rad]."""

    def __post_init__(self) -> None:
        if not self.host or any(c.isspace() for c in self.host):
            raise InvalidInputError(f"host must be an address, got {self.host!r}")
        if len(self.torque_margin) != NUM_JOINTS or not all(0.0 < t <= 400.0 for t in self.torque_margin):
            raise InvalidInputError(
                f"torque_margin must be {NUM_JOINTS} torques above 0 and up to 400 N m, got {self.torque_margin}"
            )
        check_ranges(
            self,
            port=(1, 65535),
            largest_segment=(0.005, 6.2),
            connect_timeout_s=(0.01, 60.0),
            connect_pause_s=(0.0, 10.0),
            reply_timeout_s=(0.01, 60.0),
            move_margin_s=(0.01, 60.0),
            pose_tolerance_m=(1e-5, 0.05),
            pose_tolerance_rad=(1e-5, 0.1),
            arrival_tolerance=(1e-5, 0.1),
            rest_tolerance=(1e-5, 0.1),
        )
