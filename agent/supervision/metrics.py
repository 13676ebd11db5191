"""The gateway's status for Prometheus, at `/metrics`. prometheus_client is loaded only where metrics are enabled."""

from __future__ import annotations

import math
import socket
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, cast, get_args

from agent.supervision.devices import ClockQuality, DeviceHealth
from agent.supervision.front_page import HEADERS, front_page
from agent.supervision.health import GatewayStatus, InForce, State

if TYPE_CHECKING:
    from prometheus_client.metrics_core import Metric

AXES = ("x", "y", "z")
VERDICTS = ("stable", "drifting", "stepped")
CALIBRATION_STATES = ("UNCALIBRATED", "COLLECTING", "VALID", "HELD", "RECALIBRATING", "INVALID")

Number = float | int | bool | None
Values = Iterable[tuple[tuple[str, ...], Number]]  # (values of the labels, value)
# name without prefix: (help text, whether it is a counter, where the value comes from)
DEVICE_METRICS: dict[str, tuple[str, bool, Callable[[DeviceHealth], Number]]] = {
    "up": ("Whether the device is open", False, lambda d: d.state == "open"),
    "samples": ("Samples that went through the pipeline", True, lambda d: d.samples),
    "blocks": ("Blocks that went through the pipeline", True, lambda d: d.blocks),
    "gaps": ("Number of gaps in the samples", True, lambda d: d.gaps),
    "missing_samples": ("Samples known to be missing in the gaps", True, lambda d: d.missing),
    "overruns": ("Blocks before which the device lost samples", True, lambda d: d.overruns),
    "saturated_blocks": ("Blocks with an indication at the end of the range", True, lambda d: d.saturated),
    "losses": ("Number of times that the device was lost", True, lambda d: d.losses),
    "sample_rate_hertz": ("Sample rate over the last blocks", False, lambda d: d.rate_hz),
    "nominal_sample_rate_hertz": ("Rate that the device was set to", False, lambda d: d.nominal_rate_hz),
    "lag_seconds": ("Age of the newest sample", False, lambda d: d.lag_s),
    "temperature_celsius": ("Temperature that the device measures in itself", False, lambda d: d.temperature_degc),
}
CLOCK_METRICS: dict[str, tuple[str, Callable[[ClockQuality], float]]] = {
    "rate_hertz": ("The device's rate by the gateway's clock", lambda c: c.rate_hz),
    "rate_standard_uncertainty_hertz": ("Standard uncertainty of that rate", lambda c: c.u_rate_hz),
    "residual_seconds": ("Standard deviation of arrivals about the clock model", lambda c: c.residual_sd_s),
}
GATEWAY_METRICS: dict[str, tuple[str, bool, Callable[[GatewayStatus], Number]]] = {
    "uptime_seconds": ("Time since the run began", False, lambda s: s.uptime_s),
    "status_timestamp_seconds": ("UTC of the status that these figures are from", False, lambda s: s.t_utc_ns * 1e-9),
    "recording_active": ("Whether raw data are being recorded", False, lambda s: s.recording.active),
    "recording_file_bytes": ("Size of the file being written", False, lambda s: s.recording.size_bytes),
    "disk_free_bytes": ("Free bytes on the disk of the data directory", False, lambda s: s.disk_free_bytes),
    "publication_connected": ("Whether a Zenoh router is connected", False, lambda s: s.publication.connected),
    "reopened_sessions": ("Zenoh sessions that the router did not hear", True, lambda s: s.publication.reopened),
    "unpublished_results": ("Stored results that are not published yet", False, lambda s: s.publication.unpublished),
    "mqtt_connected": ("Whether the MQTT broker is connected", False, lambda s: s.mqtt.connected if s.mqtt else None),
    "mqtt_superseded": ("Values replaced before MQTT sent them", True, lambda s: s.mqtt.superseded if s.mqtt else None),
    "mqtt_refused": ("Values that the MQTT broker did not take", True, lambda s: s.mqtt.refused if s.mqtt else None),
    "threads": ("Threads of the agent", False, lambda s: s.process.threads if s.process else None),
}


class StatusCollector:
    """Converts the newest status to metrics at each scrape. `newest` is called in the server's thread."""

    def __init__(self, newest: Callable[[], GatewayStatus | None]) -> None:
        self._newest = newest

    def collect(self) -> Iterator[Metric]:
        """All metrics; none before the first status."""
        status = self._newest()
        if status is None:
            return
        yield from self._gateway(status)
        yield from self._devices(status)
        yield from self._sensors(status)

    def _gateway(self, status: GatewayStatus) -> Iterator[Metric]:
        from prometheus_client.metrics_core import GaugeMetricFamily, InfoMetricFamily

        who = {"site": status.site, "gateway": status.gateway, "version": status.version}
        yield InfoMetricFamily("fieldcal_gateway", "Site, name and version of the gateway", value=who)
        yield _states("fieldcal_state", "State of the gateway", [], [((), status.state)], get_args(State))
        for name, (text, grows, value) in GATEWAY_METRICS.items():
            yield _family(f"fieldcal_{name}", text, grows, [], [((), value(status))])
        waiting = GaugeMetricFamily("fieldcal_queue_events", "Events that wait between two threads", labels=["queue"])
        capacity = GaugeMetricFamily("fieldcal_queue_capacity_events", "Events that the queue holds", labels=["queue"])
        for name, queue in status.queues.items():
            waiting.add_metric([name], queue.waiting)
            capacity.add_metric([name], queue.capacity)
        yield from (waiting, capacity)

    def _devices(self, status: GatewayStatus) -> Iterator[Metric]:
        for name, (text, grows, value) in DEVICE_METRICS.items():
            values = [((device,), value(health)) for device, health in status.devices.items()]
            yield _family(f"fieldcal_device_{name}", text, grows, ["device"], values)
        clocks = [((device,), health.clock) for device, health in status.devices.items() if health.clock]
        for name, (text, figure) in CLOCK_METRICS.items():
            yield _family(
                f"fieldcal_device_clock_{name}", text, False, ["device"], [(of, figure(c)) for of, c in clocks]
            )
        dropped = [((d, unit), n) for d, health in status.devices.items() for unit, n in health.dropped.items()]
        yield _family("fieldcal_device_dropped", "Data read but not usable", True, ["device", "unit"], dropped)

    def _sensors(self, status: GatewayStatus) -> Iterator[Metric]:
        statuses = [((name,), sensor.status) for name, sensor in status.sensors.items()]
        yield _states(
            "fieldcal_calibration_state", "Status of a sensor's calibration", ["sensor"], statuses, CALIBRATION_STATES
        )
        windows = [((n, "used"), s.windows_used) for n, s in status.sensors.items()]
        windows += [((n, "refused"), s.windows_refused) for n, s in status.sensors.items()]
        yield _family("fieldcal_windows", "Windows of known excitation", True, ["sensor", "verdict"], windows)
        calibrations = [((name,), sensor.calibrations) for name, sensor in status.sensors.items()]
        yield _family("fieldcal_calibrations", "Calibrations that came into force", True, ["sensor"], calibrations)
        judged = [
            ((n, parameter), verdict) for n, s in status.sensors.items() for parameter, verdict in s.drifts.items()
        ]
        yield _states("fieldcal_drift_state", "Verdict of the drift test", ["sensor", "parameter"], judged, VERDICTS)
        yield from self._in_force({n: s.in_force for n, s in status.sensors.items() if s.in_force is not None})

    def _in_force(self, sensors: Mapping[str, InForce]) -> Iterator[Metric]:
        """S, Q and U of the calibrations in force, and when they were made."""
        made = [((name,), c.made_utc_ns * 1e-9) for name, c in sensors.items()]
        text = "UTC at which the calibration in force was made; a restart does not change it"
        yield _family("fieldcal_calibration_timestamp_seconds", text, False, ["sensor"], made)
        factors = [((name,), c.coverage_factor) for name, c in sensors.items()]
        yield _family("fieldcal_calibration_coverage_factor", "k of the U in force", False, ["sensor"], factors)
        cells = [
            ((name, output, direction), c.output_unit, c.sensitivity[i][k], c.expanded_uncertainty[3 * i + k])
            for name, c in sensors.items() for i, output in enumerate(AXES) for k, direction in enumerate(AXES)
        ]  # fmt: skip
        yield from _with_u("sensitivity", "S, output unit per m/s2", ["sensor", "output", "direction"], cells)
        rows = [
            ((name, output), c.output_unit, c.offset[i], c.expanded_uncertainty[9 + i])
            for name, c in sensors.items() for i, output in enumerate(AXES)
        ]  # fmt: skip
        yield from _with_u("offset", "Q, output unit", ["sensor", "output"], rows)


def serve_metrics(host: str, port: int, newest: Callable[[], GatewayStatus | None]) -> str:
    """Serve the metrics and a front page over HTTP, in threads that end with the process; returns the address of the
    metrics. Raises OSError."""
    import socketserver
    from threading import Thread
    from wsgiref import simple_server

    from prometheus_client import CollectorRegistry, ProcessCollector, make_wsgi_app

    class Server(socketserver.ThreadingMixIn, simple_server.WSGIServer):
        daemon_threads = True
        address_family = socket.getaddrinfo(host, port)[0][0]

    class Handler(simple_server.WSGIRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            """A scrape every few seconds is no news."""

    registry = CollectorRegistry()
    registry.register(StatusCollector(newest))
    ProcessCollector(registry=registry)
    metrics = make_wsgi_app(registry)

    def answer(environ: Any, start_response: Any) -> Iterable[bytes]:
        if environ.get("PATH_INFO", "/") != "/":
            return cast(Iterable[bytes], metrics(environ, start_response))
        start_response("200 OK", list(HEADERS))  # the server adds the length to the list
        return [front_page(newest())]

    server = simple_server.make_server(host, port, answer, Server, Handler)
    Thread(target=server.serve_forever, name="metrics", daemon=True).start()
    return f"http://{host}:{server.server_port}/metrics"


def _family(name: str, text: str, grows: bool, labels: list[str], values: Values) -> Metric:
    """A counter or gauge. Unknown values are left out, as Prometheus recommends."""
    from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily

    family = (CounterMetricFamily if grows else GaugeMetricFamily)(name, text, labels=labels)
    for of, value in values:
        if value is not None:
            family.add_metric(list(of), float(value))
    return family


def _with_u(
    name: str, text: str, labels: list[str], cells: Iterable[tuple[tuple[str, ...], str, float, float]]
) -> Iterator[Metric]:
    """A quantity and its expanded uncertainty, each cell with its unit; those that are not known are left out."""
    known = [((*of, unit), value, u) for of, unit, value, u in cells if math.isfinite(value) and math.isfinite(u)]
    name = f"fieldcal_calibration_{name}"
    yield _family(name, text, False, [*labels, "unit"], [(of, value) for of, value, _ in known])
    uncertainties = [(of, u) for of, _, u in known]
    yield _family(f"{name}_expanded_uncertainty", f"U of {text}", False, [*labels, "unit"], uncertainties)


def _states(
    name: str, text: str, labels: list[str], now: Iterable[tuple[tuple[str, ...], str]], known: tuple[str, ...]
) -> Metric:
    """1 for the state that holds, 0 for the others."""
    values = (((*of, s), s == state) for of, state in now for s in known)
    return _family(name, text, False, [*labels, "state"], values)
