"""Settings of the gateway's status and of its metrics."""

from __future__ import annotations

from typing import Annotated

from pydantic import ByteSize, Field

from agent.config.section import Section


class Metrics(Section):
    """An HTTP endpoint for Prometheus. It has no password: make sure that only the Prometheus server can reach it."""

    enabled: bool = False
    host: Annotated[str, Field(min_length=1, description="address to listen at; by default this machine only")] = (
        "127.0.0.1"
    )
    port: Annotated[int, Field(ge=0, le=65535, description="0: any free port, which the log names")] = 9478


class Supervision(Section):
    """Settings of the gateway's status."""

    status_s: Annotated[
        float, Field(ge=1, le=3600, description="seconds between two reports; a change is reported at once")
    ] = 10.0
    # A tri-axial sensor and a reference at 1 kHz record 27 MB an hour (docs/performance.md): nine hours are left.
    least_disk_free: Annotated[ByteSize, Field(description="with less free disk space the status is degraded")] = (
        ByteSize(250_000_000)
    )
    metrics: Metrics = Metrics()
