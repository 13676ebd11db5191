"""The base class of all sections of a configuration, and types of names and vectors."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")
_ENDPOINT = re.compile(r"[^/]+/.+")


def _name(value: str) -> str:
    if not _NAME.fullmatch(value):
        raise ValueError(
            "a name has 1 to 63 letters (A-Z, a-z), digits, '_', '.' or '-', the first a letter or a digit"
        )
    return value


def _endpoint(value: str) -> str:
    if not _ENDPOINT.fullmatch(value):
        raise ValueError("an endpoint is a protocol, a slash and an address, as in tcp/192.0.2.1:7447")
    return value


Name = Annotated[str, AfterValidator(_name), Field(description="a chunk of a Zenoh key")]
Endpoint = Annotated[str, AfterValidator(_endpoint), Field(description="of a Zenoh router: tcp/192.0.2.1:7447")]
Vector = tuple[float, float, float]


class Section(BaseModel):
    """Base of all sections: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
