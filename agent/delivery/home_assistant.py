"""What lets Home Assistant find a gateway and its sensors on an MQTT broker: the messages of its MQTT discovery.

One retained message an entity, at `<prefix>/<component>/<id>/config`. Source: home-assistant/home-assistant.io,
source/_integrations/mqtt.markdown, sensor.mqtt.markdown and binary_sensor.mqtt.markdown. There is no device class for a
sensitivity or an offset of any unit, so these have a unit alone.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

from agent import __version__
from agent.delivery.record import StoredResult
from calib.model import PARAMETERS

STATUSES = ["UNCALIBRATED", "COLLECTING", "VALID", "HELD", "RECALIBRATING", "INVALID"]
VERDICTS = ["stable", "drifting", "stepped"]
ORIGIN = {"name": "fieldcal", "sw": __version__}
UNKNOWN = "'None'"  # Home Assistant takes this state for unknown
MADE = "((value_json.made_utc_ns or value_json.t_utc_ns) / 1e9) | timestamp_custom('%Y-%m-%dT%H:%M:%S+00:00', false)"


def entities_of_gateway(prefix: str, topic: str, site: str, gateway: str) -> dict[str, bytes]:
    """Messages by topic: whether the gateway has a problem. `topic`: of the gateway."""
    device = {"identifiers": [f"fieldcal/{site}/{gateway}"], "name": f"{site} {gateway}", "manufacturer": "fieldcal"}
    problem = {"state_topic": f"{topic}/status", "device_class": "problem",
               "value_template": "{{ 'ON' if value_json.state == 'degraded' else 'OFF' }}"}  # fmt: skip
    return dict([_entity(prefix, topic, device, "binary_sensor", "problem", problem)])


def entities_of_sensor(prefix: str, topic: str, site: str, gateway: str, calibration: StoredResult) -> dict[str, bytes]:
    """Messages by topic: status, date, S, Q and U of the calibration in force, and the drift verdict on each parameter.

    `topic`: of the gateway. The units are those of the calibration. Raises StoreError where it cannot be read.
    """
    sensor, unit = calibration.sensor, str(calibration.fields.get("output_unit", ""))
    device = {"identifiers": [f"fieldcal/{site}/{gateway}/{sensor}"], "name": f"{site} {gateway} {sensor}",
              "manufacturer": "fieldcal", "via_device": f"fieldcal/{site}/{gateway}"}  # fmt: skip
    place = f"{topic}/{sensor}"
    found: dict[str, dict[str, Any]] = {
        "status": {"state_topic": f"{place}/status", "device_class": "enum", "options": STATUSES,
                   "value_template": "{{ value_json.status }}"},
        "calibrated": {"state_topic": f"{place}/calibration", "device_class": "timestamp",
                       "value_template": _nullable(MADE, "value_json.t_utc_ns")},
    }  # fmt: skip
    for k, parameter in enumerate(PARAMETERS):
        value = f"sensitivity[{k // 3}][{k % 3}]" if k < 9 else f"offset[{k - 9}]"
        of_s = "" if unit == "m/s2" else f"{unit}/(m/s²)"
        shown = {"state_topic": f"{place}/calibration", "state_class": "measurement"}
        shown |= {"unit_of_measurement": of_s if k < 9 else unit} if (of_s if k < 9 else unit) else {}
        found[parameter] = shown | {"value_template": _nullable(f"value_json.{value}")}
        expanded = f"value_json.coverage_factor * value_json.standard_uncertainty[{k}]"
        found[f"U({parameter})"] = shown | {
            "value_template": _nullable(expanded, f"value_json.standard_uncertainty[{k}]"),
            "entity_category": "diagnostic",
        }  # fmt: skip
        found[f"drift of {parameter}"] = {
            "state_topic": f"{place}/drift/{parameter}", "device_class": "enum", "options": VERDICTS,
            "value_template": "{{ value_json.verdict }}", "entity_category": "diagnostic",
        }  # fmt: skip
    return dict(_entity(prefix, topic, device, "sensor", name, config) for name, config in found.items())


def _nullable(value: str, test: str = "") -> str:
    """A template of a value that may be null, or of a calibration that was withdrawn."""
    return f"{{{{ {value} if value_json is defined and {test or value} is not none else {UNKNOWN} }}}}"


def _entity(
    prefix: str, topic: str, device: dict[str, Any], component: str, name: str, config: dict[str, Any]
) -> tuple[str, bytes]:
    """Topic and message of one entity. The names of gateways may hold a point, which an id in a topic may not."""
    unique = f"{device['identifiers'][0]}/{name}"
    shared = {"name": name, "unique_id": unique, "device": device, "origin": ORIGIN,
              "availability_topic": f"{topic}/alive", "qos": 1}  # fmt: skip
    place = f"{prefix}/{component}/fieldcal-{hashlib.sha256(unique.encode()).hexdigest()[:16]}/config"
    return place, json.dumps(shared | config).encode()
