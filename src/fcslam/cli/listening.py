"""Ports on which commands listen."""

import ipaddress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import socket


def listen(host: str, port: int) -> "socket.socket":
    """Listen on an address; port 0 is a free one.

    Raises:
        ServiceError: the port is in use, or the address is not of this machine.
    """
    import socket

    from fcslam.errors import ServiceError

    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family, backlog=512)
    except OSError as error:
        raise ServiceError(f"cannot listen on {host}:{port} ({error}); choose another --port or --host") from error


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
