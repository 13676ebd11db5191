"""What the agent tells of itself, and to whom."""

from __future__ import annotations

from typing import Annotated

from pydantic import ByteSize, Field

from agent.config.section import Section


class Metrics(Section):
    """An endpoint for Prometheus. It has no password: let nobody but the scraper reach it."""

    enabled: bool = False
    host: Annotated[str, Field(min_length=1, description="address to listen at; loopback unless you know better")] = (
        "127.0.0.1"
    )
    port: Annotated[int, Field(ge=0, le=65535, description="0: any free one, told in the log")] = 9478


class Supervision(Section):
    """The gateway's own status."""

    status_s: Annotated[float, Field(ge=1, le=3600, description="between two reports; a change is told at once")] = 10.0
    # An hour of two devices at 1 kHz is 25 MB: there is time to come.
    least_disk_free: Annotated[ByteSize, Field(description="below it the gateway is degraded")] = ByteSize(250_000_000)
    metrics: Metrics = Metrics()
