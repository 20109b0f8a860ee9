"""The `arm` table of a profile: how to reach an iiwa through the Sunrise Toolbox."""

from dataclasses import dataclass

from maniskill_tomato.deploy.iiwa_readings import IiwaConfig
from maniskill_tomato.deploy.sunrise.client import TorqueKind
from maniskill_tomato.errors import InvalidInputError, check_ranges


@dataclass(frozen=True, kw_only=True)
class SunriseConfig(IiwaConfig):
    """Options of the driver `sunrise`."""

    host: str = "172.31.1.147"
    """Address of the controller; this is the cabinet's default on the socket X66."""
    port: int = 30001
    """TCP port of the toolbox server."""
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

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.host or any(c.isspace() for c in self.host):
            raise InvalidInputError(f"host must be an address, got {self.host!r}")
        check_ranges(
            self,
            port=(1, 65535),
            largest_segment=(0.005, 0.5),
            connect_timeout_s=(0.01, 60.0),
            connect_pause_s=(0.0, 10.0),
            reply_timeout_s=(0.01, 30.0),
            move_margin_s=(0.01, 30.0),
        )
