"""`fieldcal doctor`: what is wrong with this gateway, and what to do about it."""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from agent.bench.plan_line import shortcomings
from agent.config import Config, ConfigError, load_config
from agent.config.faults import path_text
from agent.delivery.history import FILE_NAME, History, StoreError
from agent.setup import device_checks, key_checks, machine_checks
from agent.setup.finding import Finding
from agent.setup.running import agent_runs
from agent.terminal.quantity import counted
from agent.terminal.text import say
from hw.sensor import Options

NEWEST = 8  # results `clock` of a sensor; each minute has one for each of its devices
WORDS = {"good": "good  ", "advice": "advice", "fault": "FAULT "}


@click.command()
@click.argument("config", required=False, type=click.Path(path_type=Path))
@click.option("--data-dir", type=click.Path(path_type=Path), default=Path("data"), show_default=True,
              help="Where the agent keeps recordings and results.")  # fmt: skip
@click.option("--measure", "measure_s", type=click.FloatRange(1, 600), metavar="S",
              help="Read the devices for S seconds, and compare with their rates. Stop the agent first.")  # fmt: skip
@click.option("--json", "json_to", type=click.Choice(["-"]), help="One JSON object on standard output.")
def doctor(config: Path | None, data_dir: Path, measure_s: float | None, json_to: str | None) -> int:
    """Check this gateway: clock, devices, bus clocks, rates, disk, certificates, signing key, router, MQTT broker,
    optional parts.

    Each line is good, advice (it works, with a disadvantage) or FAULT (it does not work, or soon will not), with a
    remedy. Without CONFIG only the machine is checked. Run it as the agent's user: rights are those of the caller.

    Exit status 3 if there is a FAULT.
    """
    findings = list(_findings(config, data_dir, measure_s))
    count = Counter(finding.verdict for finding in findings)
    if json_to:
        click.echo(json.dumps({"ok": not count["fault"], "findings": [asdict(finding) for finding in findings]}))
    else:
        for finding in findings:
            say(f"{WORDS[finding.verdict]}  {finding.check}: {finding.says}")
            if finding.remedy:
                say(f"        remedy: {finding.remedy}")
        say(f"{counted(count['fault'], 'faults')}, {counted(count['advice'], 'pieces')} of advice")
    return 3 if count["fault"] else 0


def _findings(path: Path | None, data_dir: Path, measure_s: float | None) -> Iterator[Finding]:
    now = machine_checks.utc_now()
    config: Config | None = None
    options: dict[str, Options] = {}
    if path is not None:
        try:
            config = load_config(path)
        except ConfigError as error:
            for fault in error.faults:
                yield Finding("configuration", "fault", fault, "correct the file; `fieldcal check` names every fault")
        else:
            yield Finding("configuration", "good", f"{path} has no fault")
            options = device_checks.loaded_options(config)
    yield from machine_checks.clock_findings(data_dir, now)
    yield from device_checks.option_findings(options)
    yield from device_checks.access_findings(options)
    yield from device_checks.bus_findings(options)
    if config is not None:
        yield from device_checks.answer_findings(config, options)
        for place, what in shortcomings(config)[0]:
            yield Finding("configuration", "fault", f"{path_text(place)}: {what}", "`fieldcal check` names its line")
        yield from device_checks.sharing_findings(config, options)
        yield from _throughput(config, options, data_dir, measure_s)
    yield from machine_checks.disk_findings(config, options, data_dir)
    if config is not None:
        yield from machine_checks.certificate_findings(config, now)
        yield from key_checks.signing_key_findings(config, data_dir)
        yield from machine_checks.router_findings(config)
        yield from machine_checks.broker_findings(config, data_dir)
    yield from machine_checks.extra_findings()


def _throughput(
    config: Config, options: dict[str, Options], data_dir: Path, measure_s: float | None
) -> Iterator[Finding]:
    """The rates of the devices: measured now, or as the running agent has them."""
    if agent_runs(data_dir):
        yield from _measured_rates(config, data_dir)
    elif measure_s is not None:
        yield from device_checks.measured_findings(config, options, measure_s)
    else:
        yield Finding("throughput", "good", "not measured", "`--measure 5` reads the devices for 5 s")


def _measured_rates(config: Config, data_dir: Path) -> Iterator[Finding]:
    """The rates that the running agent has measured, from its newest results `clock`."""
    told: dict[str, dict[str, Any]] = {}
    try:
        with History(data_dir / FILE_NAME) as history:
            for channel in config.channels:
                for record in history.newest(channel.sensor, "clock", limit=NEWEST):
                    if record.fields["rate_hz"] is not None:  # null: not known in this minute
                        told.setdefault(record.fields["device"], record.fields)
    except (StoreError, sqlite3.Error) as error:
        yield Finding("throughput", "fault", f"the store cannot be read: {error}", "look at the log of the agent")
        return
    if not told:
        yield Finding("throughput", "good", "the agent runs; it tells the rates after its first minute")
    for device, fields in told.items():
        yield device_checks.rate_finding(device, float(fields["rate_hz"]), float(fields["nominal_rate_hz"]))
