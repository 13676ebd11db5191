"""The name of the gateway, and the devices that it reads."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from agent.config.section import Name, Section


class Gateway(Section):
    """The names of the site and of this gateway. They are the first chunks of every Zenoh key."""

    site: Name = "site"
    name: Name = "gateway"


class Device(Section):
    """One device and its driver. The driver checks its own options."""

    name: Name
    driver: str
    options: dict[str, Any] = Field(default_factory=dict)
