"""Statements of a certificate without an editor: from options ENTRY=VALUE, and from questions on a terminal."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from agent.certificate.statements import CertificateStatements, Dates
from agent.config.reading import ConfigError, check_model, read_toml
from agent.setup.asking import Interview
from agent.setup.toml import toml_value

OPTION = "--state"
WITHOUT_FILE = (
    "--stated certificate.toml is missing: the file with what only people know; copy examples/certificate.toml, which "
    f"is complete, and change it, or state each entry with {OPTION}:"
)


def gather_statements(
    path: Path | None, entries: Sequence[str], asking: Interview
) -> tuple[CertificateStatements, str]:
    """The statements of the file `path`, if there is one; `entries` such as "customer.name=Bridge Operator" add to it
    or replace what it says; on a terminal what is missing then is asked.

    Returns the statements, and the text of a file that states the same; "" if `path` states all. Raises ConfigError
    with all faults.
    """
    raw, text = ({}, "") if path is None else read_toml(path)
    if path is not None and not entries:
        return check_model(raw, CertificateStatements, str(path), text), ""
    for entry in entries:
        name, equals, value = entry.partition("=")
        if not equals or not all(name.split(".")):
            raise ConfigError([f"{OPTION} {entry}: write ENTRY=VALUE, as in customer.city=Pescara"])
        _put(raw, name.strip().split("."), _value(value.strip()))
    for place, model in list(_missing(CertificateStatements, raw, ())):
        name = ".".join(place)
        default = f"{datetime.now(UTC):%Y-%m-%d}" if model is Dates and asking.interactive else None
        told = asking.value(f"{OPTION} {name}=...", None, f"{name} (docs/certificate.md)", default)
        _put(raw, place, told.value)
    if asking.faults:
        raise ConfigError(asking.faults if path or entries else [WITHOUT_FILE, *asking.faults])
    return check_model(raw, CertificateStatements, OPTION if path is None else f"{path} with {OPTION}"), _text(raw)


def _missing(
    model: type[BaseModel], raw: Mapping[str, Any], above: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], type[BaseModel]]]:
    """Entries without a default that are not stated, each with its section; sections that are left out may be."""
    for name, field in model.model_fields.items():
        section, held = field.annotation, raw.get(name)
        if isinstance(section, type) and issubclass(section, BaseModel):
            if field.is_required() or isinstance(held, Mapping):
                yield from _missing(section, held if isinstance(held, Mapping) else {}, (*above, name))
        elif field.is_required() and name not in raw:
            yield (*above, name), model


def _put(raw: dict[str, Any], place: Sequence[str], value: Any) -> None:
    for part in place[:-1]:
        raw = raw.setdefault(part, {})
        if not isinstance(raw, dict):
            raise ConfigError([f"{OPTION} {'.'.join(place)}: {part} is no section"])
    raw[place[-1]] = value


def _value(text: str) -> Any:
    """A list or a text in quotes as TOML writes it; anything else is a text, which the model reads as it needs."""
    if text[:1] in ("[", '"'):
        try:
            return tomllib.loads(f"value = {text}")["value"]
        except ValueError:
            return text
    return text


def _text(raw: Mapping[str, Any]) -> str:
    """The statements as TOML; dates are written as texts."""
    plain = {name: value for name, value in raw.items() if not isinstance(value, Mapping)}
    lines = [f"{name} = {_written(value)}" for name, value in plain.items()]
    for name in raw.keys() - plain.keys():
        lines += ["", f"[{name}]", *(f"{key} = {_written(value)}" for key, value in raw[name].items())]
    return "\n".join(lines).lstrip("\n") + "\n"


def _written(value: Any) -> str:
    return toml_value(value if isinstance(value, bool | int | float | str | list) else str(value))
