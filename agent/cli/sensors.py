"""`fieldcal sensors`: the drivers and their options, with units and defaults."""

from __future__ import annotations

import json
from typing import Any

import click

from agent.setup.drivers import Driver, describe, unit_of
from agent.terminal.text import say
from hw.sensor import driver_names


@click.command()
@click.argument("names", nargs=-1, metavar="[DRIVER]...")
@click.option("--json", "json_to", type=click.Choice(["-"]), help="One JSON object on standard output.")
def sensors(names: tuple[str, ...], json_to: str | None) -> int:
    """List drivers with their options; without DRIVER all of them. Exit status 2 if a DRIVER does not exist."""
    known = driver_names()
    strangers = [name for name in names if name not in known]
    for name in strangers:
        say(f"fieldcal sensors: no driver {name!r}; available drivers: {', '.join(known)}", err=True)
    if strangers:
        return 2
    drivers = [describe(name) for name in names or known]
    if json_to:
        click.echo(json.dumps({"drivers": [as_object(driver) for driver in drivers]}))
        return 0
    for i, driver in enumerate(drivers):
        if i:
            click.echo()
        for line in as_lines(driver):
            say(line)
    return 0


def as_object(driver: Driver) -> dict[str, Any]:
    """Description for JSON; `units` is by option."""
    units = {option: unit_of(option) for option in driver.options.get("properties", {}) if unit_of(option)}
    found: dict[str, Any] = {"name": driver.name, "built_in": driver.built_in, "description": driver.description}
    if driver.fault:
        return found | {"fault": driver.fault}
    return found | {"options": driver.options, "units": units}


def as_lines(driver: Driver) -> list[str]:
    """Lines for people: name and description, then one row per option.

    A row has name, unit, default or `required`, values, description.
    """
    head = f"{driver.name}: {driver.fault or driver.description}" + ("" if driver.built_in else " (plug-in)")
    required = driver.options.get("required", [])
    rows = [
        (
            option,
            unit_of(option),
            "required" if option in required else _shown(schema.get("default")),
            _values(schema, driver.options.get("$defs", {})),
            schema.get("description", ""),
        )
        for option, schema in driver.options.get("properties", {}).items()
    ]
    widths = [max((len(row[i]) for row in rows), default=0) for i in range(4)]
    return [head, *("  " + "  ".join(_padded(row, widths)).rstrip() for row in rows)]


def _padded(row: tuple[str, ...], widths: list[int]) -> list[str]:
    return [*(cell.ljust(width) for cell, width in zip(row[:4], widths, strict=True)), row[4]]


def _shown(value: Any) -> str:
    return "-" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _values(schema: dict[str, Any], definitions: dict[str, Any]) -> str:
    """Values that an option accepts: a list of values, or a type; for a table its keys."""
    if "$ref" in schema:
        return "{" + ", ".join(definitions[schema["$ref"].rpartition("/")[2]]["properties"]) + "}"
    if "enum" in schema:
        return " ".join(str(value) for value in schema["enum"])
    if "anyOf" in schema:
        return " or ".join(_values(kind, definitions) for kind in schema["anyOf"] if kind.get("type") != "null")
    if schema.get("type") == "array":
        return f"list of {_values(schema.get('items', {}), definitions)}"
    return str(schema.get("type", "any"))
