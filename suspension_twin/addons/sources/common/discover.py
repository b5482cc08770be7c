# SPDX-License-Identifier: Apache-2.0
"""Phones, receivers and IMUs that this machine can reach, and the URL for each."""

from __future__ import annotations

import socket
from pathlib import Path

from suspension_twin.addons.sources.common.server import network_address

__all__ = ["discover", "serial_ports"]

#: Programs on this machine that sources connect to: name, port, URL.
_PROGRAMS = (("gpsd", 2947, "gpsd://localhost"), ("an MQTT broker", 1883, "mqtt://localhost/sensor-logger"))
_UBLOX = "u-blox"


def serial_ports(dev: Path = Path("/dev")) -> list[tuple[str, str]]:
    """Serial ports by which receivers are connected: path, and what the device calls itself."""
    named = {}
    by_id = dev / "serial" / "by-id"
    if by_id.is_dir():
        named = {link.resolve().name: link.name.removeprefix("usb-") for link in sorted(by_id.iterdir())}
    ports = [*dev.glob("ttyACM*"), *dev.glob("ttyUSB*")]
    return [(str(port), named.get(port.name, "")) for port in sorted(ports)]


def discover() -> list[str]:
    """A line for each thing that was found, with its URL. Only this machine is asked."""
    from suspension_twin.addons.sources.iio import devices

    address = network_address()
    if address.startswith("127."):
        lines = ["no network: connect the laptop to the phone's hotspot, or both to one network"]
    else:
        lines = [f"network: this machine is {address}; a phone in the same network reaches it there"]
    for path, name in serial_ports():
        scheme = "ubx" if _UBLOX in name else "nmea"
        lines.append(f"serial port: --source {scheme}:{path}{f'  ({name})' if name else ''}")
    lines += [f"IMU: --source iio:{name}" for name in devices()]
    for name, port, url in _PROGRAMS:
        with socket.socket() as probe:
            probe.settimeout(0.2)
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                lines.append(f"{name}: --source {url}")
    return lines
