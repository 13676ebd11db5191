"""A data directory holds the recordings of one gateway, so that an audit can tell whether any of them is missing."""

from __future__ import annotations

from pathlib import Path

from agent.recording.files import recordings
from agent.recording.reading import first_event


class OtherGatewayError(Exception):
    """The data directory holds the recordings of another gateway. The message names both gateways."""


def check_owner(directory: Path, gateway: str) -> None:
    """Check that the newest recording that can be read is one of `gateway` (`<site>/<name>`).

    Raises OtherGatewayError, or OSError where the directory cannot be read.
    """
    starts = (first_event(path) for _, path in reversed(recordings(directory)))
    newest = next((start for start in starts if start is not None), None)
    if newest is not None and (owner := f"{newest.site}/{newest.gateway}") != gateway:
        raise OtherGatewayError(
            f"{directory}: holds the recordings of the gateway {owner}, and this configuration is of {gateway}; use "
            "another data directory, or the name in [gateway] that it had before"
        )
