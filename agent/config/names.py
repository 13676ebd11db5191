"""Names in a configuration that must agree between its sections."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from agent.config.lines import Path

SHOWN_NAMES = 10
Told = tuple[Path, str]
"""Where something is told, and what."""


def name_faults(raw: Mapping[str, Any]) -> Iterator[Told]:
    """Names that are used twice, or that nothing has: where, and what is wrong. What is no name is passed over."""
    devices, sensors = list(_each(raw, "devices", "name")), list(_each(raw, "channels", "sensor"))
    references = list(_each(raw, "channels", "reference"))
    yield from _twice(devices, "more than one device has the name {!r}; give each a name of its own")
    yield from _twice(sensors, "{!r} has more than one channel; leave one of them")
    checks = list(_check_references(raw))
    yield from _nowhere([*sensors, *references, *checks], [name for _, name in devices], "no device is called {!r}")
    own = {path[:2]: name for path, name in sensors}
    first = {path[:2]: name for path, name in references}
    for path, name in [*references, *checks]:
        if own.get(path[:2]) == name:
            yield path, "a sensor cannot be its own reference; name another device, or leave it out"
    for path, name in checks:
        if first.get(path[:2]) == name:
            yield path, "the first reference cannot check itself; name another device, or remove check_reference"
    commands = raw.get("commands")
    keys = commands if isinstance(commands, Mapping) else {}
    yield from _twice(_within("commands", _each(keys, "keys", "id")), "the id {!r} is used more than once")
    rights = [told for told in _within("commands", _each(keys, "keys", "sensors")) if told[1] != "*"]
    yield from _nowhere(rights, [name for _, name in sensors], "{!r} has no channel")


def _each(raw: Mapping[str, Any], section: str, field: str) -> Iterator[Told]:
    """The text, or each text of the list, that the entries of a list of tables have in a field."""
    entries = raw.get(section)
    for i, entry in enumerate(entries if isinstance(entries, list | tuple) else []):
        found = entry.get(field) if isinstance(entry, Mapping) else None
        if isinstance(found, str):
            yield (section, i, field), found
        elif isinstance(found, list | tuple):
            yield from (((section, i, field, k), name) for k, name in enumerate(found) if isinstance(name, str))


def _check_references(raw: Mapping[str, Any]) -> Iterator[Told]:
    """The devices of the second references."""
    entries = raw.get("channels")
    for i, entry in enumerate(entries if isinstance(entries, list | tuple) else []):
        check = entry.get("check_reference") if isinstance(entry, Mapping) else None
        name = check.get("device") if isinstance(check, Mapping) else None
        if isinstance(name, str):
            yield ("channels", i, "check_reference", "device"), name


def _within(section: str, told: Iterator[Told]) -> Iterator[Told]:
    return (((section, *path), name) for path, name in told)


def _twice(told: Iterator[Told] | list[Told], words: str) -> Iterator[Told]:
    seen: set[str] = set()
    for path, name in told:
        if name in seen:
            yield path, words.format(name)
        seen.add(name)


def _nowhere(told: list[Told], known: list[str], words: str) -> Iterator[Told]:
    names = dict.fromkeys(known)  # once each, in order
    there = ", ".join(list(names)[:SHOWN_NAMES]) or "none"
    yield from ((path, f"{words.format(name)}; there is {there}") for path, name in told if name not in names)
