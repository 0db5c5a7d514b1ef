"""Address of the page: host, free port and URL."""

import ipaddress
import socket

from legged.errors import ConfigError

HOST, PORT = "127.0.0.1", 8470
"""Default host, which only this machine reaches, and the first port that is tried."""
TRIES = 50
"""Number of ports that are tried."""


def check_port(port: int) -> int:
    """Return the port of --port.

    Raises:
        ConfigError: the number is no port.
    """
    if not 0 <= port <= 65535:
        raise ConfigError(f"--port: must be from 0 to 65535, got {port}")
    return port


def free_port(host: str, port: int | None) -> int:
    """Return `port` if it is free on `host`, or any free port for 0. Without `port`, return the first free one from PORT on.

    Raises:
        ConfigError: the host is no address of this machine, or the port is taken.
    """
    try:
        family = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][0]
    except (OSError, UnicodeError) as error:
        raise ConfigError(
            f"--host: '{host}' is no address of this machine ({error}); 127.0.0.1 is this machine alone"
        ) from error
    wanted = [port] if port is not None else [*range(PORT, PORT + TRIES), 0]
    failure: OSError | None = None
    for number in wanted:
        try:
            with socket.socket(family, socket.SOCK_STREAM) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, number))
                return int(probe.getsockname()[1])
        except OSError as error:
            failure = error
    assert failure is not None
    reason = failure.strerror or str(failure)
    if port is None:
        raise ConfigError(f"--host: no page can be served at '{host}' ({reason}); {HOST} is this machine alone")
    raise ConfigError(f"--port: {port} can't be used at '{host}' ({reason}); leave it out, and a free one is found")


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches a host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def url(host: str, port: int) -> str:
    """Return the URL of the page for a browser on this machine."""
    shown = "127.0.0.1" if host == "0.0.0.0" else "[::1]" if host == "::" else f"[{host}]" if ":" in host else host
    return f"http://{shown}:{port}"
