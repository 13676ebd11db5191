"""What all sections of a configuration share: the base, and the names and vectors in them."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,62}$", description="a chunk of a Zenoh key")]
Endpoint = Annotated[str, Field(pattern=r"^[^/]+/.+$", description="of a Zenoh router: tcp/192.0.2.1:7447")]
Vector = tuple[float, float, float]


class Section(BaseModel):
    """Base of all sections: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
