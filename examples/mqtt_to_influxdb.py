"""Writes the results at an MQTT broker into InfluxDB: `python mqtt_to_influxdb.py BROKER PORT URL`.

URL is that of InfluxDB 1 (http://127.0.0.1:8086/write?db=fieldcal&precision=ns). Needs paho-mqtt alone. Each result is
a point of the measurement <what>, with the tags of its topic; all numbers are floats, since a field keeps the type of
its first value. Source: InfluxDB 1.x, line protocol reference.
"""

from __future__ import annotations

import json
import math
import re
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import paho.mqtt.client as paho

TOPIC = "fieldcal/v1"
TAGS = ("site", "gateway", "sensor", "what", "of")
LEFT_OUT = ("covariance", "response", "shared_errors", "budget")  # too many numbers for a plot
LARGEST_TEXT = 1000


def line_of(topic: str, value: bytes) -> str | None:
    """The line of a result; None for what is no result, such as `alive`."""
    names = topic.removeprefix(f"{TOPIC}/").split("/")
    try:
        result = json.loads(value)
        t_utc_ns = int(result["t_utc_ns"])
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    if not 4 <= len(names) <= 5 or not all(names) or abs(t_utc_ns) >= 2**63:
        return None
    tags = dict(zip(TAGS, map(_name, names), strict=False))
    measurement = tags.pop("what")
    fields = {key: found for key, found in _fields("", result) if not key.startswith(LEFT_OUT)}
    if not fields:
        return None
    own = "".join(f",{key}={tag}" for key, tag in sorted(tags.items()))
    return f"{measurement}{own} {','.join(f'{key}={found}' for key, found in fields.items())} {t_utc_ns}"


def _name(text: str) -> str:
    """A tag or a key: what would end it, or a line, is replaced."""
    return re.sub(r"[^\w.:-]", "_", text)


def _fields(key: str, value: Any) -> Iterator[tuple[str, str]]:
    """The fields of a value, those of lists and objects with their places in the names."""
    if isinstance(value, dict | list):
        for name, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _fields(f"{key}_{_name(str(name))}".lstrip("_"), item)
    elif isinstance(value, bool):
        yield key, str(value).lower()
    elif isinstance(value, int | float) and abs(value) < 1e300 and not math.isnan(value):
        yield key, repr(float(value))
    elif isinstance(value, str):
        text = value[:LARGEST_TEXT].replace("\\", "/").replace('"', "'").replace("\n", " ")
        yield key, f'"{text}"'


def main(broker: str, port: str, url: str) -> None:
    """Subscribe, and post each result, until the program is ended."""

    def write(_client: Any, _data: Any, message: Any) -> None:
        try:
            if (line := line_of(message.topic, message.payload)) is not None:
                urllib.request.urlopen(urllib.request.Request(url, line.encode()), timeout=10).close()
        except (OSError, UnicodeDecodeError, urllib.error.HTTPError) as error:
            print(f"not written: {error}", file=sys.stderr, flush=True)

    client = paho.Client(paho.CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
    client.on_message = write
    client.on_connect = lambda client, *_: client.subscribe(f"{TOPIC}/#", 1)
    client.connect(broker, int(port))
    client.loop_forever()


if __name__ == "__main__":
    main(*sys.argv[1:])
