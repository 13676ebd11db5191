"""JSON that means the same to every reader: no key twice in an object, no NaN, no infinity, no bottomless nesting."""

from __future__ import annotations

import json
from typing import Any, NoReturn


def strict(text: bytes | str) -> Any:
    """What a JSON text says. Raises ValueError for what two readers could read in two ways."""
    try:
        return json.loads(text, object_pairs_hook=_once_each, parse_constant=_refused)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _once_each(pairs: list[tuple[str, object]]) -> dict[str, object]:
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice!r} is there twice")
    return dict(pairs)


def _refused(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number of JSON; write null where nothing is known")
