"""Supervises a run: keeps the agent's status up to date and reports it to systemd, Zenoh, Prometheus and the log."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

import msgspec

from agent import __version__
from agent.config import Config
from agent.core.events import DriftReport, Event, Result, Tick, WindowReport
from agent.supervision.health import GatewayStatus, Health, State
from agent.supervision.logs import log_event, tell
from agent.supervision.notify import SystemdNotifier
from agent.supervision.plant import Plant
from hw.block import SampleBlock

_log = logging.getLogger(__name__)


class Supervisor:
    """Supervises one run. The main loop calls `on_event` after the pipeline has processed an event, and `closing` once.

    Only blocks that have passed through the pipeline feed systemd's watchdog. So it restarts the agent where the main
    loop stops, where all readers hang in their drivers, and where no device sends anything. READY is sent when every
    device was opened or has failed with a reason: an absent device is tried again for ever, and the others are used
    meanwhile.
    """

    def __init__(self, config: Config, run_id: str, origin_ns: int, plant: Plant, notifier: SystemdNotifier) -> None:
        self._settings = config.supervision
        self._health = Health(config, __version__, run_id, origin_ns)
        self._plant = plant
        self._notifier = notifier
        self._ready = False
        self._told: tuple[State, list[str]] | None = None
        self._report_at_ns = 0
        self._newest: GatewayStatus | None = None
        self._faults: list[str] = []
        tell("run", f"run {run_id} begins", run_id=run_id, version=__version__, gateway=config.gateway.name)
        if self._settings.metrics.enabled:
            self._serve_metrics()

    def remember(self, reports: Sequence[DriftReport]) -> None:
        """Take verdicts of the drift test of earlier runs, oldest first. Call it before the first event."""
        self._health.remember(reports)

    def on_event(self, event: Event, results: Sequence[Result]) -> None:
        """Take an event that the pipeline has processed, with its results."""
        self._health.update(event, results)
        log_event(event, results)
        for result in results:
            if isinstance(result, WindowReport) and result.fault:
                _log.error("a fault of the program cost %s a window, please report it: %s", result.sensor, result.fault)
        if isinstance(event, SampleBlock):
            self._notifier.feed()
        elif isinstance(event, Tick):
            self._look(event)
        if not self._ready and self._health.started:
            self._ready = self._notifier.ready()

    def closing(self) -> None:
        """Report that the run ends. Call it before devices and files are closed."""
        self._notifier.stopping()
        self._report("stopping", [], time.monotonic_ns(), time.time_ns())
        self._notifier.close()

    def _look(self, tick: Tick) -> None:
        state, reasons = self._health.state(
            tick.t_monotonic_ns, self._plant.situation(), [*self._faults, *self._plant.outbox.faults]
        )
        if (state, reasons) != self._told or tick.t_monotonic_ns >= self._report_at_ns:
            self._report(state, reasons, tick.t_monotonic_ns, tick.t_utc_ns)

    def _report(self, state: State, reasons: list[str], now_ns: int, utc_ns: int) -> None:
        self._report_at_ns = now_ns + int(self._settings.status_s * 1e9)
        status = self._health.status(now_ns, utc_ns, self._plant.situation(), state, reasons)
        self._newest = status
        self._notifier.status(status.line)
        for publisher in (self._plant.publisher, self._plant.mqtt):
            if publisher is not None:
                publisher.tell_status(msgspec.json.encode(status))
        if (state, reasons) != self._told:
            self._told = (state, reasons)
            tell("state", status.line, state == "degraded", state=state, reasons=reasons)

    def _serve_metrics(self) -> None:
        from agent.supervision.metrics import serve_metrics

        metrics = self._settings.metrics
        try:
            address = serve_metrics(metrics.host, metrics.port, lambda: self._newest)
        except OSError as error:
            fault = f"metrics cannot be served at {metrics.host}:{metrics.port}: {error.strerror or error}"
            self._faults.append(fault)
            _log.warning("%s", fault)
        else:
            tell("metrics", f"metrics at {address}", address=address)
