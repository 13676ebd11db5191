"""Checks of the machine of a gateway: clock, disk, certificates, router, MQTT broker, optional parts."""

from __future__ import annotations

import ctypes
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from agent.config import Config
from agent.config.key_file import KeyFileError
from agent.config.knowledge import Certificate
from agent.config.tls import SOON, expiry_warning
from agent.delivery.history import FILE_NAME, History
from agent.delivery.mqtt import MqttPublisher
from agent.recording.files import recordings
from agent.setup.extras import extras
from agent.setup.finding import Finding
from hw.sensor import ConfigurationError, Options

# adjtimex(2): the kernel's clock state. The structure has 208 bytes on 64-bit Linux; `status` is an int at byte 40, and
# `maxerror`, a long in us, at byte 24.
TIMEX_BYTES, STATUS_AT, MAXERROR_AT = 208, 40, 24
UNSYNCHRONISED = 0x0040  # STA_UNSYNC
DAY_S = 86_400.0
# Measured on `fieldcal run` (an ADXL355 and a `serial-csv` of one axis, both at 1 kHz): docs/performance.md. Devices
# with little noise need less, decimals of which a block has no short text up to eight bytes.
BYTES_A_VALUE = 1.9
SOON_FULL_DAYS = 7.0
CONNECT_S = 2.0


def clock_findings(data_dir: Path, now: datetime) -> Iterator[Finding]:
    """Is UTC synchronised, and not earlier than what is already recorded?"""
    state = kernel_clock()
    if state is None:
        yield Finding("clock", "advice", "the kernel does not tell whether UTC is synchronised", "check it by hand")
    elif state[0] & UNSYNCHRONISED:
        yield Finding(
            "clock", "advice", "UTC is not synchronised: times in results may be wrong, and commands may be refused",
            "install chrony or systemd-timesyncd, and let it reach a time server; `timedatectl` shows the state",
        )  # fmt: skip
    else:
        yield Finding("clock", "good", f"UTC is synchronised; greatest error by the kernel {state[1] * 1e-6:.3g} s")
    newest = max((path.stat().st_mtime for _, path in recordings(data_dir)), default=0.0) if data_dir.is_dir() else 0.0
    if newest > now.timestamp() + 60.0:
        yield Finding(
            "clock", "fault", f"UTC is {newest - now.timestamp():.0f} s before the newest recording in {data_dir}",
            "set the clock, or connect the battery of the real-time clock",
        )  # fmt: skip


def kernel_clock() -> tuple[int, int] | None:
    """Status bits and greatest error (us) of the system's clock; None where the system does not tell."""
    buffer = ctypes.create_string_buffer(TIMEX_BYTES)
    try:
        result = ctypes.CDLL(None, use_errno=True).adjtimex(buffer)
    except (OSError, AttributeError):
        return None
    if result < 0:
        return None
    return (
        int.from_bytes(buffer.raw[STATUS_AT : STATUS_AT + 4], sys.byteorder),
        int.from_bytes(buffer.raw[MAXERROR_AT : MAXERROR_AT + 8], sys.byteorder),
    )


def disk_findings(config: Config | None, options: dict[str, Options], data_dir: Path) -> Iterator[Finding]:
    """How long the free disk lasts at the rate of the newest recordings, or else at the configured rates."""
    there = next((path for path in (data_dir, *data_dir.absolute().parents) if path.is_dir()), Path("/"))
    if not os.access(there, os.W_OK):
        yield Finding(
            "disk", "fault", f"{there}: this user ({_user()}) may not write there",
            f"run this as the agent's user, or: sudo chown {_user()} {there}",
        )  # fmt: skip
    space = os.statvfs(there)
    free = space.f_bavail * space.f_frsize
    kept = int(config.recording.least_free_bytes) if config else 0
    a_day, source = _bytes_a_day(options, data_dir)
    free_text = f"{free / 1e9:.3g} GB are free at {there}"
    if free < kept:
        yield Finding(
            "disk", "fault", f"{free_text}, less than recording.least_free_bytes ({kept / 1e9:.3g} GB)",
            "free some space, or set recording.keep_days; if this lasts, the agent deletes its oldest recordings",
        )  # fmt: skip
        return
    if not a_day:
        yield Finding("disk", "good", f"{free_text}; how long it lasts is not known without a configuration")
        return
    days = (free - kept) / a_day
    says = f"{free_text}; {a_day / 1e9:.2g} GB a day ({source}) fill it in {_time(days)}"
    limited = config is not None and (config.recording.keep_days is not None or config.recording.keep_bytes is not None)
    if days < SOON_FULL_DAYS and not limited:
        remedy = "then the oldest recordings are deleted: use a larger disk, or copy them away (`fieldcal backup`)"
        yield Finding("disk", "advice", says, remedy)
    else:
        yield Finding("disk", "good", says + ("; older recordings are deleted before" if limited else ""))


def _bytes_a_day(options: dict[str, Options], data_dir: Path) -> tuple[float, str]:
    files = [path.stat() for _, path in recordings(data_dir)][-10:] if data_dir.is_dir() else []
    if len(files) > 2 and files[-1].st_mtime > files[0].st_mtime:
        a_second = sum(file.st_size for file in files[1:]) / (files[-1].st_mtime - files[0].st_mtime)
        return a_second * DAY_S, f"as the last {len(files) - 1} recordings show"
    values = sum(
        float(getattr(held, "rate_hz", 0.0) or 0.0) * int(getattr(held, "axes", 3)) for held in options.values()
    )
    return BYTES_A_VALUE * values * DAY_S, "estimated from the configured rates"


def certificate_findings(config: Config, now: datetime) -> Iterator[Finding]:
    """Until when the certificates hold: TLS, and those of the references."""
    if config.zenoh.tls is not None:
        warning = expiry_warning(config.zenoh.tls.files, now)
        if warning:
            remedy = "make a new one (`fieldcal keys`) and copy it to this gateway"
            yield Finding("certificate", "fault" if "expired" in warning else "advice", f"zenoh.tls.{warning}", remedy)
        else:
            yield Finding("certificate", "good", f"TLS: valid for more than {SOON.days} days")
    for channel in config.channels:
        for beside in channel.by_reference:
            if beside.reference is not None:
                yield _reference(beside.reference, beside.certificate, now)


def _reference(device: str, certificate: Certificate, now: datetime) -> Finding:
    if overdue := certificate.overdue(now):
        what, _, remedy = overdue.partition("; ")
        return Finding("certificate", "fault", f"reference {device}: {what}", remedy)
    if overdue := certificate.overdue(now + SOON):
        what, _, remedy = overdue.partition("; ")
        return Finding("certificate", "advice", f"reference {device}: in {SOON.days} days {what}", remedy)
    if not certificate.calibrated:
        return Finding(
            "certificate", "advice", f"reference {device}: the date of its certificate is not stated",
            "state calibrated and interval_years in its section certificate: its drift counts from this date",
        )  # fmt: skip
    return Finding("certificate", "good", f"reference {device}: calibrated {certificate.calibrated}")


def router_findings(config: Config) -> Iterator[Finding]:
    """Does a Zenoh router answer at the endpoints? Only whether a TCP connection is taken is tried."""
    if not config.zenoh.enabled:
        return
    for endpoint in config.zenoh.connect:
        protocol, _, address = endpoint.partition("/")
        host, _, port = address.partition("#")[0].partition("?")[0].rpartition(":")
        if protocol not in ("tcp", "tls") or not port.isdigit():
            continue
        try:
            socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()
        except OSError as error:
            yield Finding(
                "router", "advice", f"{protocol}/{host}:{port}: no router answers: {error.strerror or error}",
                "start one (`fieldcal router` or zenohd), or correct zenoh.connect; results wait in the store",
            )  # fmt: skip
        else:
            yield Finding("router", "good", f"{protocol}/{host}:{port} takes connections")


def broker_findings(config: Config, data_dir: Path) -> Iterator[Finding]:
    """Does the MQTT broker take the connection of this gateway, with its user, password and certificate?

    It is tried under another client_id, so that a running agent keeps its connection. Nothing is published.
    """
    if not config.mqtt.enabled:
        return
    gateway = config.gateway
    try:
        publisher = MqttPublisher(gateway.site, gateway.name, config.mqtt, lambda: History(data_dir / FILE_NAME))
        fault = publisher.attempt(f"fieldcal-doctor-{os.getpid()}")
    except (ConfigurationError, KeyFileError) as error:
        fault = str(error)
    if fault:
        remedy = "correct the section mqtt, or start the broker; results do not wait for it, the newest are sent later"
        yield Finding("MQTT broker", "advice", fault, remedy)
    else:
        yield Finding("MQTT broker", "good", f"{config.mqtt.host}:{config.mqtt.port} takes the connection")


def extra_findings() -> Iterator[Finding]:
    """Which optional parts are not installed."""
    missing = [part for part in extras() if not part.installed]
    if missing:
        listed = "; ".join(f"{part.name} ({part.purpose})" for part in missing)
        yield Finding("optional parts", "good", f"not installed: {listed}", "`fieldcal extras --install NAME` adds one")
    else:
        yield Finding("optional parts", "good", "all are installed")


def _user() -> str:
    with suppress(OSError, KeyError):
        import pwd

        return pwd.getpwuid(os.getuid()).pw_name
    return str(os.getuid())


def _time(days: float) -> str:
    return f"{days * 24:.3g} hours" if days < 2 else f"{days:.0f} days" if days < 730 else f"{days / 365.25:.0f} years"


def utc_now() -> datetime:
    """UTC of this machine."""
    return datetime.now(UTC)
