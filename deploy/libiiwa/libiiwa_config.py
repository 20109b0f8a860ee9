"""The `arm` table of a profile: how to reach an iiwa through the LibIiwa application."""

from dataclasses import dataclass
from ipaddress import IPv4Address

from maniskill_tomato.deploy.iiwa_readings import IiwaConfig
from maniskill_tomato.errors import InvalidInputError, check_ranges


@dataclass(frozen=True, kw_only=True)
class LibiiwaConfig(IiwaConfig):
    """Options of the driver `libiiwa`."""

    controller: str = "172.31.1.147"
    """Address of the controller; whoever else connects is sent away. The cabinet's default on the socket X66."""
    host: str = "0.0.0.0"
    """Own address to listen at; the default is every one. The application must be told it in its process data."""
    port: int = 12225
    """Own TCP port to listen at; this is the application's default."""
    double_precision: bool = False
    """Whether numbers have 8 bytes instead of 4; as in the process data of the application."""
    tool_index: int | None = None
    """Which tool of the application's list to attach, counted from 0, for the load that it carries; None for none."""
    acceleration_fraction: float = 0.3
    """Share of the largest joint accelerations and jerks; the application begins with all of it."""
    contact_force: float = 40.0
    """A push on the flange along any of its axes by which the controller itself ends a move, in [N]."""
    contact_tolerance: float = 10.0
    """How inexact its estimate of that force may be, in [N]."""
    largest_segment: float = 0.3
    """Moves are sent in pieces in which no joint turns farther, in [rad]: what goes on when the cable is pulled."""
    connect_timeout_s: float = 60.0
    """How long to wait for the application to be started on the smartPAD, in [s]."""
    reply_timeout_s: float = 1.0
    """How long an answer may take before the connection is given up, in [s]."""
    move_margin_s: float = 2.0
    """A piece of a move may take twice its computed time and this, in [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("controller", "host"):
            try:
                IPv4Address(getattr(self, name))
            except ValueError as error:
                raise InvalidInputError(
                    f"{name} must be an address such as 172.31.1.147, got {getattr(self, name)!r}"
                ) from error
        if self.tool_index is not None:
            check_ranges(self, tool_index=(0, 100))
        check_ranges(
            self,
            port=(1024, 65535),
            acceleration_fraction=(0.01, 1.0),
            contact_force=(1.0, 500.0),
            contact_tolerance=(0.1, 500.0),
            largest_segment=(0.005, 1.0),
            connect_timeout_s=(0.01, 600.0),
            reply_timeout_s=(0.01, 10.0),
            move_margin_s=(0.01, 60.0),
        )
