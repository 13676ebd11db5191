"""Rules for options that need or exclude each other."""

from __future__ import annotations

import click


def check_rules(*rules: tuple[object, str]) -> None:
    """Raise click.UsageError with the message of the first rule that is broken. A rule: whether it is, its message."""
    for broken, message in rules:
        if broken:
            raise click.UsageError(message)
