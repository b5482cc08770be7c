# SPDX-License-Identifier: Apache-2.0
"""Devices in words and figures, for a terminal and for diagnostics: those that send, and those that could."""

from __future__ import annotations

import math
import socket
from pathlib import Path

from suspension_twin.addons.sources.common.hub import STREAMS, Device, Hub
from suspension_twin.addons.sources.common.server import network_address
from suspension_twin.signals.checks import Finding, check_rate

__all__ = ["device_line", "device_values", "discover", "findings", "serial_ports"]

#: s without anything after which a device counts as silent.
_SILENT = 2.0
#: s after which a rate has settled, and with it the judgement of a missing sensor.
_SETTLED = 5.0


def silence(device: Device, now: float) -> float:
    """s since anything came."""
    return now - max(device.last_arrival(stream) for stream in STREAMS.values())


def device_line(device: Device, now: float) -> str:
    """Rates, accuracy and clock in one line."""
    silent = silence(device, now)
    if silent > _SILENT:
        return f"{device.name}: silent" + (f" for {silent:.0f} s" if math.isfinite(silent) else "")
    rates = {stream: device.frequency(stream, now) for stream in STREAMS.values()}
    shown = ", ".join(f"{name} {rate:.3g}" for name, rate in rates.items() if rate)
    accuracy = f", ±{device.accuracy:.2g} m" if math.isfinite(device.accuracy) else ""
    return f"{device.name}: {shown} Hz{accuracy}"


def device_values(device: Device, now: float) -> dict[str, str]:
    """Everything known of a device, by what it is."""
    values = {f"{stream} (Hz)": f"{device.frequency(stream, now):.1f}" for stream in STREAMS.values()}
    values |= {name: str(count) for name, count in device.counts.items() if count}
    if math.isfinite(device.accuracy):
        values["standard deviation of the fix (m)"] = f"{device.accuracy:.3f}"
    if device.motion is not None:
        shown = f"{device.motion.lag:+.3f} ± {device.motion.sigma:.3f}"
        values["IMU later than the velocities, by its motion (s)"] = shown
    clocks = {"clock": device.clock}
    if device.position_clock is not device.clock:
        clocks["clock of the positions"] = device.position_clock
    for name, clock in clocks.items():
        if math.isnan(clock.offset):
            continue
        values[f"{name}: host ahead (s)"] = f"{clock.offset:.4f}"
        values[f"{name}: drift (ppm)"] = "-" if math.isnan(clock.drift) else f"{clock.drift * 1e6:.1f}"
        values[f"{name}: arrival jitter (s)"] = "-" if math.isnan(clock.jitter) else f"{clock.jitter:.4f}"
        if clock.steps:
            values[f"{name}: steps"] = f"{clock.steps}, the last {clock.last_step:+.3f} s"
    return values


def findings(hub: Hub, now: float) -> list[Finding]:
    """Faults at this moment."""
    found = []
    for device in list(hub.devices.values()):
        name, silent = device.name, silence(device, now)
        if silent > _SILENT:
            if math.isfinite(silent):
                text = f"{name}: silent for {silent:.0f} s: is the app in front, the phone awake, the network there?"
                found.append(Finding("warn", f"silent {name}", text))
            continue
        if hub.chosen.get("imu") is device and now - device.since > _SETTLED:
            last = device.last_arrival("imu")  # what has just stopped is not slow
            rate = check_rate(device.frequency("imu", last)) if math.isfinite(last) else None
            if rate is not None and device.counted("imu", last) > 1.0 and now - last < _SILENT:
                found.append(Finding(rate.level, f"rate {name}", f"{name}: {rate.text}"))
        missing = _missing(device, now)
        if missing:
            found.append(Finding("error", f"missing {name}", f"{name}: {missing}"))
    return found


def _missing(device: Device, now: float) -> str:
    force, rate = device.sensor_age(now)
    if force < _SILENT and rate > _SETTLED:
        return "its accelerometer comes without the gyroscope: switch it on, too"
    if rate < _SILENT and force > _SETTLED:
        if device.counts["accelerations without gravity"]:
            return "its acceleration is without gravity: switch the sensor Gravity (or Total Acceleration) on, too"
        return "its gyroscope comes without the accelerometer: switch it on, too"
    return ""


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
