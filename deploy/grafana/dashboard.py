"""Writes the Grafana dashboard fieldcal.json: `python deploy/grafana/dashboard.py` (needs grafana-foundation-sdk)."""

from __future__ import annotations

from pathlib import Path

from grafana_foundation_sdk.builders import common, dashboard, prometheus, stat, statetimeline, timeseries
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.models import dashboard as model

FILE = Path(__file__).with_name("fieldcal.json")
SOURCE = model.DataSourceRef(type_val="prometheus", uid="${datasource}")
CHOSEN = 'instance=~"$gateway",sensor=~"$sensor"'
Panel = timeseries.Panel | stat.Panel | statetimeline.Panel


def query(expression: str, legend: str) -> prometheus.Dataquery:
    """A query in PromQL."""
    return prometheus.Dataquery().expr(expression).legend_format(legend)


def lines(title: str, text: str, unit: str, *queries: prometheus.Dataquery) -> timeseries.Panel:
    """A panel with lines over time."""
    panel = timeseries.Panel().title(title).description(text).unit(unit).datasource(SOURCE).height(8).span(12)
    panel.legend(common.VizLegendOptions().show_legend(True))
    for each in queries:
        panel.with_target(each)
    return panel


def timeline(title: str, states: prometheus.Dataquery) -> statetimeline.Panel:
    """A panel with states over time."""
    return statetimeline.Panel().title(title).datasource(SOURCE).height(8).span(12).row_height(0.9).with_target(states)


def number(title: str, unit: str, expression: str) -> stat.Panel:
    """A panel with the newest value."""
    newest = common.ReduceDataOptions().calcs(["lastNotNull"])
    panel = stat.Panel().title(title).unit(unit).datasource(SOURCE).height(4).span(6).reduce_options(newest)
    return panel.with_target(query(expression, ""))


def built() -> model.Dashboard:
    """The dashboard."""
    of = "{{instance}} {{sensor}}"
    state = "max by (instance, sensor, state) (fieldcal_calibration_state{%s} == 1)"
    panels: list[Panel] = [
        number("Gateways without news", "short",
               'count(up{job="fieldcal"} == 0 or time() - fieldcal_status_timestamp_seconds > 60) or vector(0)'),
        number("Parameters that drift", "short",
               'sum(fieldcal_drift_state{state=~"drifting|stepped"}) or vector(0)'),
        number("Sensors with a valid calibration", "short", 'sum(fieldcal_calibration_state{state="VALID"})'),
        number("Oldest calibration", "s", "max(time() - fieldcal_calibration_timestamp_seconds)"),
        lines("Main sensitivities", "Output unit per m/s²", "short", *(
            query(f'fieldcal_calibration_sensitivity{{{CHOSEN},output="{a}",direction="{a}"}}', f"{of} S{a}{a}")
            for a in "xyz"
        )),
        lines("U of the main sensitivities", "Expanded uncertainty over the sensitivity", "percentunit", *(
            query(
                f'fieldcal_calibration_sensitivity_expanded_uncertainty{{{CHOSEN},output="{a}",direction="{a}"}}'
                " / ignoring(job) fieldcal_calibration_sensitivity", f"{of} U(S{a}{a})",
            )
            for a in "xyz"
        )),
        lines("Offset Q", "Output unit", "short",
              query(f"fieldcal_calibration_offset{{{CHOSEN}}}", f"{of} Q{{{{output}}}}")),
        lines("U of the offset", "Output unit", "short",
              query(f"fieldcal_calibration_offset_expanded_uncertainty{{{CHOSEN}}}", f"{of} U(Q{{{{output}}}})")),
        lines("Age of the calibration", "Since the calibration in force was made", "s",
              query(f"time() - fieldcal_calibration_timestamp_seconds{{{CHOSEN}}}", of)),
        timeline("Status of the calibration",
            query(state % CHOSEN, f"{of} {{{{state}}}}")
        ),
        timeline("Verdict of the drift test",
            query(f"fieldcal_drift_state{{{CHOSEN},state!=\"stable\"}}", f"{of} {{{{parameter}}}} {{{{state}}}}")
        ),
        lines("Windows refused", "In an hour", "short",
              query(f'increase(fieldcal_windows_total{{{CHOSEN},verdict="refused"}}[1h])', of)),
    ]  # fmt: skip
    board = dashboard.Dashboard("fieldcal").uid("fieldcal").tags(["fieldcal"]).refresh("30s").time("now-7d", "now")
    board.with_variable(dashboard.DatasourceVariable("datasource").label("Prometheus").type("prometheus"))
    for name, metric, label in (("gateway", "fieldcal_uptime_seconds", "instance"),
                                ("sensor", "fieldcal_calibration_state", "sensor")):  # fmt: skip
        board.with_variable(
            dashboard.QueryVariable(name).datasource(SOURCE).query(f"label_values({metric}, {label})")
            .multi(True).include_all(True)
        )  # fmt: skip
    for panel in panels:
        board.with_panel(panel)
    return board.build()


if __name__ == "__main__":
    FILE.write_text(JSONEncoder(sort_keys=True, indent=2).encode(built()) + "\n", "utf-8")
