"""The serial ports of this machine, by names that a port keeps when it is plugged in again.

/dev/serial/by-id has one link for all adapters that have no serial number or the same one, and it leads to the adapter
that was found last (Klipper3d/klipper, pull request 4975). Of such adapters only /dev/serial/by-path tells which is
which.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

LINKS = Path("/dev/serial")


def serial_ports() -> list[dict[str, str]]:
    """Serial ports and the system's information about them. No port is opened: opening resets some boards.

    `port` is the lasting name of a port where it has one, `device` the name of its node, as /dev/ttyUSB0.
    """
    from serial.tools.list_ports import comports

    ports = sorted(comports(), key=lambda port: port.device)
    places = defaultdict(set)  # where adapters that look alike are plugged in
    for port in ports:
        places[_looks(port)].add(_place(port))
    return [
        {
            "port": _link("by-path" if len(places[_looks(port)]) > 1 else "by-id", port.device),
            "device": port.device,
            "description": port.description or "",
            "serial_number": port.serial_number or "",
        }
        for port in ports
    ]


def lasting_name(path: str) -> str:
    """The lasting name of the port /dev/tty...; the path itself where the port has none, or is not there."""
    return next((port["port"] for port in serial_ports() if port["device"] == path), path)


def present_ports() -> str:
    """The serial ports that are there now, for a message."""
    ports = serial_ports()
    names = [p["port"] if p["port"] == p["device"] else f"{p['port']} ({p['device']})" for p in ports]
    return f"serial ports that are there: {', '.join(names)}" if names else "no serial port is there"


def _looks(port: Any) -> tuple[Any, ...]:
    return port.vid, port.pid, port.serial_number


def _place(port: Any) -> str:
    """The USB socket, without the interface: an adapter with several ports is one."""
    return str(port.location or port.device).partition(":")[0]


def _link(folder: str, device: str) -> str:
    links = sorted((LINKS / folder).glob("*"))
    return next((str(link) for link in links if str(link.resolve()) == device), device)
