"""How large a configuration may be: checked before its values are, since each fault in it takes memory and time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from agent.config.lines import Path
from agent.config.names import Told

LONGEST_LIST = 86_400  # one pose each second of a day; each fault in a list needs 2 kB and 25 us
LONGEST_OTHERS = 40_000  # values of a configuration without its poses; a hundred channels with all defaults have 12,000


def size_faults(raw: Any) -> list[Told]:
    """Where a configuration is too large, and why. `raw`: the nest of tables, lists and values that was read."""
    if longest := list(_long_lists(raw, ())):
        return longest
    count = _values(raw)
    if count > LONGEST_OTHERS:
        return [((), f"has {count} values besides poses, at most {LONGEST_OTHERS} are allowed; shorten it")]
    return []


def _long_lists(value: Any, path: Path) -> Iterator[Told]:
    if isinstance(value, list) and len(value) > LONGEST_LIST:
        yield path, f"has {len(value)} entries, at most {LONGEST_LIST} are allowed; shorten it"
    elif isinstance(value, dict | list):
        for name, item in value.items() if isinstance(value, dict) else enumerate(value):
            if isinstance(item, dict | list):
                yield from _long_lists(item, (*path, name))


def _values(value: Any) -> int:
    """How many values there are, without those of lists named `poses`, which are checked up to the first fault."""
    if isinstance(value, dict):
        return 1 + sum(1 if name == "poses" else _values(item) for name, item in value.items())
    return 1 + sum(_values(item) for item in value) if isinstance(value, list) else 1
