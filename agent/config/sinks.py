"""Settings of the recording, the store of results, the network and the MQTT broker."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, ByteSize, Field, model_validator

from agent.config.section import Endpoint, Section
from agent.config.tls import TlsFiles

_HOST = re.compile(r"[^\s/\x00]{1,255}")
HOST_ALONE = "give the name or address alone, as in broker.example.org; the port is a setting of its own"
_SECRET = re.compile("key|password|secret|token", re.IGNORECASE)  # searched in the part of an endpoint after '#'


def _topic(value: str) -> str:
    if set(value) & set("+#") or not value.isprintable() or value.startswith("$") or not all(value.split("/")):
        raise ValueError(
            "a topic is one or more names with / between them, without +, # and control characters, and not $ at the "
            "front, as in fieldcal/v1"
        )
    return value


def _host(value: str) -> str:
    if not _HOST.fullmatch(value):
        raise ValueError(HOST_ALONE)
    return value


Topic = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_topic)]


class Recording(Section):
    """How raw data and events are recorded, and how long recordings are kept."""

    rotate_s: Annotated[float, Field(ge=1, le=86400)] = 3600.0
    rotate_bytes: Annotated[ByteSize, Field(ge=1 << 20)] = ByteSize(256 * 1024 * 1024)
    # A power cut loses at most this much of the recording. 2 s takes 11 % more disk than no flush.
    flush_s: Annotated[float, Field(gt=0, le=5)] = 2.0
    keep_days: Annotated[
        float | None, Field(gt=0, description="older recordings are deleted; without it they are kept for ever")
    ] = None
    keep_bytes: Annotated[
        ByteSize | None, Field(ge=1 << 20, description="size of all recordings; without it there is no limit")
    ] = None
    # A full disk stops more than the recording. This leaves space for two files of `rotate_bytes`.
    least_free_bytes: Annotated[
        ByteSize,
        Field(ge=0, description="free disk space to keep; the oldest recordings are deleted for it; 0: none is"),
    ] = ByteSize(512 * 1024 * 1024)
    # A week is enough to notice the status of a gateway whose disk somebody else has filled, and to come there.
    keep_at_least_days: Annotated[
        float, Field(ge=0, description="younger recordings are not deleted for `least_free_bytes`")
    ] = 7.0
    signing_key: Annotated[
        Path | None, Field(description="file of an Ed25519 private key (PEM), which signs each closed file")
    ] = None
    earlier_keys: Annotated[
        tuple[Path, ...],
        Field(description="files of public keys (PEM) that signed before; what they signed in the data still counts"),
    ] = ()


class Results(Section):
    """How long results are kept in the store.

    The newest result of each kind and each device's newest calibration are always kept.
    """

    # Two years, so that a season can be compared with the same season a year before. A result has 0.2 to 2 kB; one per
    # minute gives 1 GB in two years.
    keep_days: Annotated[float | None, Field(gt=0)] = 730.0
    keep_bytes: Annotated[ByteSize | None, Field(ge=1 << 20)] = ByteSize(2 * 1024 * 1024 * 1024)
    waiting_days: Annotated[float | None, Field(gt=0, description="days that unpublished results are kept")] = 365.0


class Tls(Section):
    """Paths of the PEM files for endpoints tls/..., as `fieldcal keys` makes them. The paths are not secret."""

    ca: str
    certificate: str
    key: str

    @property
    def files(self) -> TlsFiles:
        """The paths as TlsFiles, which a Zenoh session takes."""
        return TlsFiles(self.ca, self.certificate, self.key)


class Zenoh(Section):
    """How results are published."""

    enabled: bool = True
    connect: tuple[Endpoint, ...] = ("tcp/127.0.0.1:7447",)
    tls: Tls | None = None

    @model_validator(mode="after")
    def _tls_for_tls(self) -> Zenoh:
        if self.tls is None and any(endpoint.startswith("tls/") for endpoint in self.connect):
            raise ValueError("connect: an endpoint tls/... needs the section zenoh.tls with ca, certificate and key")
        return self

    @model_validator(mode="after")
    def _no_secret(self) -> Zenoh:
        for endpoint in self.connect:
            place, _, said = endpoint.partition("#")
            if _SECRET.search(said):  # the message leaves it out: faults are printed and logged
                raise ValueError(
                    f"connect: {place}#... contains a key or password, which every recording would store with the "
                    "configuration; give files in zenoh.tls instead"
                )
        return self


class MqttTls(Section):
    """Paths of the PEM files for TLS with a broker; the paths are not secret. The system's authorities are not used."""

    ca: Annotated[Path, Field(description="certificates of which one must have signed the broker's")]
    certificate: Annotated[Path | None, Field(description="of this gateway, if the broker asks for one")] = None
    key: Annotated[Path | None, Field(description="its private key")] = None

    @model_validator(mode="after")
    def _both(self) -> MqttTls:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together; give both or none")
        return self


class Mqtt(Section):
    """How the newest results are published to an MQTT broker (MQTT 5); needs the extra `mqtt`."""

    enabled: bool = False
    host: Annotated[str, AfterValidator(_host), Field(description="name or address of the broker")] = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535, description="8883 is usual with TLS")] = 1883
    topic: Annotated[Topic, Field(description="topics are <topic>/<site>/<gateway>/<sensor>/<what>")] = "fieldcal/v1"
    client_id: Annotated[
        str | None, Field(min_length=1, max_length=200, description="by default fieldcal-<site>-<gateway>")
    ] = None
    username: Annotated[str | None, Field(min_length=1, max_length=1000)] = None
    password_file: Annotated[Path | None, Field(description="its first line is the password; mode 0600")] = None
    tls: MqttTls | None = None
    home_assistant: Annotated[
        Topic | None,
        Field(description="prefix of Home Assistant's discovery, as homeassistant; none: it is off"),
    ] = None

    @model_validator(mode="after")
    def _fits(self) -> Mqtt:
        if self.password_file is not None and self.username is None:
            raise ValueError("password_file: a password needs a username; add it")
        return self
