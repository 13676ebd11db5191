"""`fieldcal check`: reports all faults of a configuration together."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from agent.bench.plan_line import ChannelPlan, shortcomings
from agent.config import Config, ConfigError
from agent.config.broker import broker_warning
from agent.config.faults import path_text
from agent.config.reading import config_error, parse_config, read_toml
from agent.config.tls import expiry_warning
from agent.setup.contradictions import small_uncertainties
from agent.setup.device_checks import answer_findings, loaded_options, missing_ports, sharing_findings
from agent.setup.finding import Finding
from agent.setup.key_checks import signing_key_warnings
from agent.setup.known_filters import StatedFilters, stated_filters
from agent.terminal.quantity import counted
from agent.terminal.text import say


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--json", "json_to", type=click.Choice(["-"]), help="One JSON object on standard output.")
def check(config: Path, json_to: str | None) -> int:
    """Report every fault in CONFIG, with its line, its setting and what to do. Exit status 2 if there is a fault.

    Statements that contradict each other or the devices are faults, and so are positions that do not determine the
    parameters which the first calibration needs. Of a good one, tell to what U the positions determine them, which
    filters of each device are divided out, and who states them, and ask the devices on I2C and SPI buses of this
    machine who they are. A device that does not answer is a warning; an adapter that refuses the transfers of the
    driver is a fault.

    A file without a fault is not called good where no position is stated, which only `fieldcal bench` and `fieldcal
    visit` do not need, or where an uncertainty is so small that a fraction in the place of % may be meant.

    JSON: `good`, `faults` and `warnings` (lists of texts), and of a good one `devices`, `channels`, `poses` and
    `positions` (their numbers), `filters` (of each sensor and reference: `sensor` of the channel, `device`,
    `lines`, `stated_by`), and `plans` (of each channel with positions: `sensor`, how many parameters are `determined`,
    how many are `needed`, which are `missing`, and U in `expanded_u_main_pct`, `expanded_u_transverse_pct`,
    `expanded_u_offset_mps2`), and `watched` (names of the sensors without a reference and positions).
    """
    try:
        raw, text = read_toml(config)
        loaded = parse_config(raw, str(config), text)
        faults, plans = shortcomings(loaded)
        if faults:
            raise config_error(faults, str(config), text)
        answers = _answers(config, loaded)
    except ConfigError as error:
        if json_to:
            click.echo(json.dumps({"good": False, "faults": error.faults, "warnings": []}))
        else:
            for fault in error.faults:
                say(fault, err=True)
        return 2
    warnings = [*_warnings(config, loaded), *(f"{a.says}; {a.remedy}" for a in answers if a.verdict != "good")]
    unplaced = [told for one in plans for told in one.unplaced]
    doubts = [f"{config}: {path_text(place)}: {what}" for place, what in (*unplaced, *small_uncertainties(loaded))]
    warnings += doubts
    filters = list(stated_filters(loaded))
    if json_to:
        more = _as_object(loaded, filters, plans)
        click.echo(json.dumps({"good": not doubts, "faults": [], "warnings": warnings, **more}))
        return 0
    for warning in warnings:
        say(warning, err=True)
    verdict = "no fault, but what is told of it must be right before `fieldcal run` can calibrate" if doubts else "good"
    say(f"{config}: {verdict}; {_summary(loaded)}")
    for line in _details(plans, filters, answers):
        say(f"  {line}")
    return 0


def _details(
    plans: Sequence[ChannelPlan], filters: Sequence[StatedFilters], answers: Sequence[Finding]
) -> Iterable[str]:
    """Each line once: what positions determine, which filters are divided out, and what answers."""
    answered = [a.says for a in answers if a.verdict == "good"]
    planned = [one.line for one in plans if one.line]
    return dict.fromkeys([*planned, *(one.line for one in filters), *answered])


def _counts(config: Config) -> dict[str, int]:
    return {
        "devices": len(config.devices),
        "channels": len(config.channels),
        "poses": sum(len(channel.poses) for channel in config.channels),
        "positions": sum(len(channel.stops) for channel in config.channels),
    }


def _as_object(config: Config, filters: Sequence[StatedFilters], plans: Sequence[ChannelPlan]) -> dict[str, Any]:
    """What the JSON object tells of a good configuration."""
    return {
        **_counts(config),
        "filters": [asdict(one) for one in filters],
        "plans": [one.json for one in plans if one.plan is not None],
        "watched": [one.sensor for one in plans if one.watched],
    }


def _summary(config: Config) -> str:
    """What a configuration has, in words."""
    counts = _counts(config)
    told = [counted(count, name) for name, count in counts.items() if count or name in ("devices", "channels")]
    return f"{', '.join(told)}{', which the agent finds by gravity' if counts['positions'] else ''}"


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
    if warning := broker_warning(config.mqtt):
        yield f"{path}: mqtt: {warning}"
    yield from (f"{path}: {warning}" for warning in signing_key_warnings(config))
    loaded = loaded_options(config)
    for i, options in enumerate(loaded.values()):
        yield from (f"{path}: devices.{i}.options: {advice}" for advice in options.advice)
    for finding in (*sharing_findings(config, loaded), *missing_ports(loaded)):
        yield f"{path}: {finding.says}; {finding.remedy}"
    for i, channel in enumerate(config.channels):
        for section, beside in zip(("", "check_reference."), channel.by_reference, strict=False):
            if overdue := beside.certificate.overdue(now):
                yield f"{path}: channels.{i}.{section}certificate.{overdue}"
