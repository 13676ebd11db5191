"""Computes again with the numerical kernels with which a recording was made."""

from __future__ import annotations

from pathlib import Path

import click


def compute_as_in(recording: Path) -> None:
    """Restart this process with the kernels of a recording's first run, where that is needed and possible.

    Only the process of the command itself is restarted. Another one (a test, a notebook) has another command line, with
    which it would begin anew.
    """
    from agent.recording.fingerprint import compute_as
    from agent.recording.reading import first_event

    own_process = click.get_current_context().find_root().obj
    start = first_event(recording) if own_process else None
    if start is not None:
        compute_as(start.fingerprint)
