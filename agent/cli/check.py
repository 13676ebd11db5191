"""`fieldcal check`: reports all faults of a configuration together."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

import click

from agent.config import Config, ConfigError, load_config
from agent.config.tls import expiry_warning
from agent.setup.device_checks import answer_findings, loaded_options, place_findings, sharing_findings
from agent.setup.finding import Finding
from agent.setup.key_checks import signing_key_warnings
from agent.setup.known_filters import stated_filters
from agent.terminal.quantity import counted
from agent.terminal.text import say


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--json", "json_to", type=click.Choice(["-"]), help="One JSON object on standard output.")
def check(config: Path, json_to: str | None) -> int:
    """Report every fault in CONFIG, with its line, its setting and what to do. Exit status 2 if there is a fault.

    Of a good one, tell which filters of each device are divided out, and who states them, and ask the devices on I2C
    and SPI buses of this machine who they are. A device that does not answer is a warning; an adapter that refuses the
    transfers of the driver is a fault.

    JSON: `good`, `faults` and `warnings` (lists of texts), and of a good one `devices`, `channels`, `poses` and
    `positions` (their numbers), and `filters` (of each sensor and reference: `sensor` of the channel, `device`,
    `lines`, `stated_by`).
    """
    try:
        loaded = load_config(config)
        answers = _answers(config, loaded)
    except ConfigError as error:
        if json_to:
            click.echo(json.dumps({"good": False, "faults": error.faults, "warnings": []}))
        else:
            for fault in error.faults:
                say(fault, err=True)
        return 2
    warnings = [*_warnings(config, loaded), *(f"{a.says}; {a.remedy}" for a in answers if a.verdict != "good")]
    counts = {
        "devices": len(loaded.devices),
        "channels": len(loaded.channels),
        "poses": sum(len(channel.poses) for channel in loaded.channels),
        "positions": sum(len(channel.stops) for channel in loaded.channels),
    }
    filters = list(stated_filters(loaded))
    if json_to:
        more = {**counts, "filters": [asdict(one) for one in filters]}
        click.echo(json.dumps({"good": True, "faults": [], "warnings": warnings, **more}))
        return 0
    for warning in warnings:
        say(warning, err=True)
    told = [counted(count, name) for name, count in counts.items() if count or name in ("devices", "channels")]
    found = ", which the agent finds by gravity" if counts["positions"] else ""
    say(f"{config}: good; {', '.join(told)}{found}")
    for line in dict.fromkeys([one.told for one in filters] + [a.says for a in answers if a.verdict == "good"]):
        say(f"  {line}")
    return 0


def _answers(path: Path, config: Config) -> list[Finding]:
    """What answers on the buses of this machine. Raises ConfigError where an adapter refuses the transfers."""
    answers = list(answer_findings(config, loaded_options(config)))
    if faults := [f"{path}: {answer.says}" for answer in answers if answer.check == "adapter"]:
        raise ConfigError(faults)
    return answers


def _warnings(path: Path, config: Config) -> Iterator[str]:
    """What does not keep the agent from running: certificates that end, a misplaced key, options that are not good."""
    now = datetime.now(UTC)
    if config.zenoh.tls and (warning := expiry_warning(config.zenoh.tls.files, now)):
        yield f"{path}: zenoh.tls.{warning}"
    yield from (f"{path}: {warning}" for warning in signing_key_warnings(config))
    loaded = loaded_options(config)
    for i, options in enumerate(loaded.values()):
        yield from (f"{path}: devices.{i}.options: {advice}" for advice in options.advice)
    for finding in (*place_findings(config, loaded), *sharing_findings(config, loaded)):
        yield f"{path}: {finding.says}; {finding.remedy}"
    for i, channel in enumerate(config.channels):
        for section, beside in zip(("", "check_reference."), channel.by_reference, strict=False):
            if overdue := beside.certificate.overdue(now):
                yield f"{path}: channels.{i}.{section}certificate.{overdue}"
