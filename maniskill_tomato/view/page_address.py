"""Whether a page can be served at an address; free of anything that is slow to import."""

import socket

from maniskill_tomato.errors import InvalidInputError


def check_port(host: str, port: int) -> None:
    """Accepts a port that nobody listens at.

    Raises:
        InvalidInputError: It is taken, or the address is not this machine's.
    """
    if not 0 <= port <= 65535:
        raise InvalidInputError(f"port must be from 0 to 65535, got {port}")
    try:
        with socket.create_server((host, port)):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise InvalidInputError(
            f"cannot serve the page at {host}:{port} ({reason}); choose another --port (0 takes a free one) or --host"
        ) from error
