"""Errors between the policy and the hardware, one family."""

from maniskill_tomato.errors import TomatoError


class DeployError(TomatoError):
    """Base of every error of `deploy`; each leaves the arm without a new command."""

    reason: str = "fault"
    """The short word for it in `result.json`."""


class NotConnectedError(DeployError):
    """A device was used before `connect` or after `disconnect`, or has gone, such as a pulled cable."""

    reason = "not_connected"


class StaleError(DeployError):
    """A device answers with what is older than asked for, or with the same thing again."""

    reason = "stale"


class DeviceTimeoutError(DeployError):
    """A device did not answer in time."""

    reason = "timeout"


class RefusedError(DeployError):
    """A command was not sent, because a check speaks against it."""

    reason = "refused"


class ProtocolError(DeployError):
    """A device answered with something that its protocol does not have."""

    reason = "protocol"


class FaultError(DeployError):
    """A device reports an error of its own, or values that cannot be true."""

    reason = "fault"


class PerceptionError(DeployError):
    """A picture cannot be used: black, without depth, or of another size than announced."""

    reason = "bad_picture"


class ProfileError(DeployError):
    """A profile, a calibration or an option cannot be used; the message names the key."""

    reason = "profile"


class RecordingError(DeployError):
    """A recording cannot be written or read."""

    reason = "recording"


class CutOffError(RecordingError):
    """A recording ends in the middle: the disk was full, or the program was killed. What came before is whole."""


class HeartbeatLostError(DeployError):
    """The loop itself stood still for too long."""

    reason = "heartbeat"


class StoppedError(DeployError):
    """Somebody asked to stop; the message says how."""

    reason = "stopped"
