"""Where the values of a new configuration come from: an option, a question on a terminal, a default."""

from __future__ import annotations

import sys
import tomllib
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import click

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class SourcedValue(Generic[T]):
    """A value and where it comes from."""

    value: T
    source: str


@dataclass(slots=True)
class Interview:
    """Decides each value, in this order: option, question, default. What is missing is collected in `faults`.

    `interactive`: whether questions may be asked.
    """

    interactive: bool = field(default_factory=lambda: sys.stdin.isatty() and sys.stdout.isatty())
    faults: list[str] = field(default_factory=list)

    def value(
        self,
        option: str,
        given: Any,
        question: str,
        default: Any = None,
        *,
        kind: Any = None,
    ) -> SourcedValue[Any]:
        """One value. `option` states it on the command line; `kind` is what click's prompt takes as type.

        Without a terminal a value that has no default is a fault, and the value is None.
        """
        if given is not None and given != ():
            return SourcedValue(given, f"option {option}")
        if self.interactive:
            answer = click.prompt(question, default=default, type=kind)
            return SourcedValue(answer, "default" if answer == default else "answered")
        if default is None:
            self.faults.append(f"{option} is missing: {question}")
            return SourcedValue(None, "missing")
        return SourcedValue(default, "default")


def driver_options(pairs: tuple[str, ...], option: str) -> dict[str, Any]:
    """Options of a driver from texts NAME=VALUE; a value is read as TOML, or else it is a text.

    Raises click.BadParameter.
    """
    found: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name.strip():
            raise click.BadParameter(f"{pair!r} is not NAME=VALUE, as in rate_hz=1000", param_hint=option)
        try:
            found[name.strip()] = tomllib.loads(f"value = {text}")["value"]
        except ValueError:
            found[name.strip()] = text.strip()
    return found
