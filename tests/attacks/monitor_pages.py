"""What a test asks of the fleet page."""

from __future__ import annotations

from typing import Any

from tests.unit.monitor_site import Served

KINDS = ("calibration", "window", "status", "drift", "estimate", "clock", "invented")


def bus(served: Served) -> dict[str, Any]:
    told: dict[str, Any] = served.ask("/api/fleet").json["bus"]
    return told


def shown(served: Served) -> dict[str, str]:
    """The status of each sensor."""
    return {row["sensor"]: row["status"] for row in served.ask("/api/fleet").json["sensors"]}


def pages(sensor: str) -> list[str]:
    """All that the page asks for about a sensor."""
    place = f"site=site&gateway=gw&sensor={sensor}"
    names = ("fleet", "events", f"spread?{place}", f"hours?{place}", f"advice?{place}", f"bench?{place}")

    return [
        *(f"/api/{name}" for name in names),
        *(f"/api/history?{place}&what={what}" for what in KINDS),
        *(f"/sensor.csv?{place}&what={what}" for what in KINDS),
        *(f"/{name}.csv" for name in ("fleet", "events", "gateways")),
        f"/hours.csv?{place}",
        f"/advice.csv?{place}",
    ]
