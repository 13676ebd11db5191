"""What the commands have in common that lead a person: `fieldcal bench` and `fieldcal visit`."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.config.reading import ConfigError
from agent.terminal.text import for_drawing, say

if TYPE_CHECKING:
    from agent.bench.capture import Capture
    from agent.config import Channel

OPEN_S = 20.0  # for the devices to be opened and to send their first block


def wait_for_devices(capture: Capture, devices: list[str]) -> dict[str, Any]:
    """What the sensor's driver read of it, when all devices send. Raises ValueError where one does not."""
    end = time.monotonic() + OPEN_S
    while time.monotonic() < end:
        for line in capture.messages():
            say(line, err=True)
        if all(capture.newest_s(device) is not None for device in devices):
            return dict(capture.info(devices[0]) or {})
        time.sleep(0.1)
    silent = [device for device in devices if capture.newest_s(device) is None]
    raise ValueError(f"no samples of {', '.join(silent)} within {OPEN_S:g} s; `fieldcal probe` shows what answers")


def with_filters(channel: Channel, capture: Capture) -> Channel:
    """The channel with the filters that the drivers of the opened devices state, where it states none."""
    from agent.core.driver_filters import DriverFilters

    filters = DriverFilters(channel)
    for device in (channel.sensor, channel.reference):
        if device is not None and (fault := filters.hear(device, capture.info(device) or {})):
            say(fault, err=True)
    return filters.channel


def calibrate_options(arguments: list[str]) -> dict[str, Any]:
    """The options of `fieldcal calibrate` by these arguments."""
    from agent.cli.calibrate import calibrate

    with calibrate.make_context("calibrate", list(arguments)) as context:
        return dict(context.params)


def check_stated(path: Path) -> None:
    """Raises ConfigError before the session rather than after it."""
    from agent.certificate.statements import CertificateStatements
    from agent.config.reading import load_model

    load_model(path, CertificateStatements)


def make_result(options: dict[str, Any], output: Path, stated: Path | None) -> int:
    """Make the result from the files as `fieldcal calibrate` does, and the certificate."""
    from agent.cli.calibrate import calibrate
    from agent.cli.certificate import CertificateOptions, make

    assert calibrate.callback is not None
    status = int(calibrate.callback(**options))
    if status or stated is None:
        return status
    return make((output / "result.json",), output / "certificate", CertificateOptions(stated=stated))


def say_fault(error: Exception, command: str, directory: Path, option: str) -> None:
    """Say what is wrong with the input. `directory`: of the results, which the `option` names; it must be new."""
    if isinstance(error, ConfigError):
        for fault in error.faults:
            say(fault, err=True)
    elif isinstance(error, FileExistsError):
        say(f"fieldcal {command}: {directory} exists; name a new directory with {option}", err=True)
    elif isinstance(error, OSError):
        say(f"fieldcal {command}: {error.filename or directory}: {error.strerror}", err=True)
    else:
        say(f"fieldcal {command}: {error}", err=True)


def ask(prompt: str, *, err: bool = False) -> str | None:
    """An answer from standard input, None at its end. The prompt is on standard output, or on standard error."""
    stream = sys.stderr if err else sys.stdout
    stream.write(prompt)
    stream.flush()
    line = sys.stdin.readline()
    if not sys.stdin.isatty():
        stream.write("\n")
    return line.strip() if line else None


def progress(line: str) -> None:
    """Show how a stay goes on, on a terminal only."""
    if sys.stdout.isatty():
        stream = for_drawing(sys.stdout)
        stream.write(f"\r{line:<100}\r")
        stream.flush()
