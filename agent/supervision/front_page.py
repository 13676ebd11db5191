"""What a browser shows at the address of the metrics: the newest status in a few lines, and where the metrics are."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime

from agent.supervision.health import GatewayStatus
from agent.terminal.text import page_text

HEADERS = (
    ("Content-Type", "text/html; charset=utf-8"),
    ("Content-Security-Policy", "default-src 'none'"),
    ("Cache-Control", "no-store"),
)


def front_page(status: GatewayStatus | None) -> bytes:
    """The page; `status` is None before the first report."""
    title = "fieldcal" if status is None else f"fieldcal {status.site}/{status.gateway}"
    body = "<p>No status yet.</p>" if status is None else _status(status)
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{page_text(title)}</title></head>'
        f'<body><h1>{page_text(title)}</h1>{body}<p><a href="/metrics">Metrics for Prometheus</a></p></body></html>\n'
    ).encode()


def _status(status: GatewayStatus) -> str:
    when = datetime.fromtimestamp(status.t_utc_ns * 1e-9, UTC).isoformat(" ", "seconds")
    reasons = "".join(f"<li>{page_text(reason)}</li>" for reason in status.reasons)
    devices = _table(
        ("device", "state", "rate in Hz", "samples", "missing"),
        (
            (name, d.state, "" if d.rate_hz is None else f"{d.rate_hz:.2f}", d.samples, d.missing)
            for name, d in status.devices.items()
        ),
    )
    sensors = _table(
        ("sensor", "calibration", "windows used", "windows not used", "reason"),
        ((name, s.status, s.windows_used, s.windows_refused, s.reason) for name, s in status.sensors.items()),
    )
    return (
        f"<p><b>{page_text(status.state)}</b>, {when}, version {page_text(status.version)}</p><ul>{reasons}</ul>"
        f"{devices}{sensors}"
    )


def _table(head: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    lines = ["".join(f"<th>{page_text(str(cell))}</th>" for cell in head)]
    lines += ["".join(f"<td>{page_text(str(cell))}</td>" for cell in row) for row in rows]
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"
