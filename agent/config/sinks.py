"""Where data and results go: the recording, the store and the network."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

from pydantic import ByteSize, Field, model_validator

from agent.config.section import Endpoint, Section
from agent.config.tls import TlsFiles

_SECRET = re.compile("key|password|secret|token", re.IGNORECASE)  # in what stands behind an endpoint's '#'


class Recording(Section):
    """Where and how raw data are kept."""

    rotate_s: Annotated[float, Field(ge=1, le=86400)] = 3600.0
    rotate_bytes: Annotated[ByteSize, Field(ge=1 << 20)] = ByteSize(256 * 1024 * 1024)
    # At most this much is lost to a power cut; facts: 2 s costs 11 % more disk than no flush.
    flush_s: Annotated[float, Field(gt=0, le=5)] = 2.0
    keep_days: Annotated[float | None, Field(gt=0, description="older recordings are deleted; none: for ever")] = None
    keep_bytes: Annotated[ByteSize | None, Field(ge=1 << 20, description="of all recordings; none: no limit")] = None
    # A full disk stops more than the recording. Two files of `rotate_bytes` at a day's notice, on any card in use.
    least_free_bytes: Annotated[ByteSize, Field(ge=0, description="the oldest recordings make room")] = ByteSize(
        512 * 1024 * 1024
    )
    signing_key: Annotated[Path | None, Field(description="Ed25519, PEM; closed files are signed")] = None


class Results(Section):
    """How long results stay in the store; the newest of each kind, and each device's newest calibration, always do."""

    # Two years: a season to compare the last one with. A result is 0.2 to 2 kB, one a minute is 1 GB in that time.
    keep_days: Annotated[float | None, Field(gt=0)] = 730.0
    keep_bytes: Annotated[ByteSize | None, Field(ge=1 << 20)] = ByteSize(2 * 1024 * 1024 * 1024)
    waiting_days: Annotated[float | None, Field(gt=0, description="of what no router has taken")] = 365.0


class Tls(Section):
    """Certificates for endpoints tls/..: PEM files, made by `fieldcal keys`. Paths only, no secret."""

    ca: str
    certificate: str
    key: str

    @property
    def files(self) -> TlsFiles:
        """The same, for a session."""
        return TlsFiles(self.ca, self.certificate, self.key)


class Zenoh(Section):
    """How results leave."""

    enabled: bool = True
    connect: tuple[Endpoint, ...] = ("tcp/127.0.0.1:7447",)
    tls: Tls | None = None

    @model_validator(mode="after")
    def _tls_for_tls(self) -> Zenoh:
        if self.tls is None and any(endpoint.startswith("tls/") for endpoint in self.connect):
            raise ValueError("connect: an endpoint tls/.. needs the section zenoh.tls")
        return self

    @model_validator(mode="after")
    def _no_secret(self) -> Zenoh:
        for endpoint in self.connect:
            place, _, said = endpoint.partition("#")
            if _SECRET.search(said):  # not shown: faults are printed and logged
                raise ValueError(
                    f"connect: {place}#... names a key or password; every recording holds the configuration, so give "
                    "files in zenoh.tls"
                )
        return self
