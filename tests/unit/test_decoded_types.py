"""Types that msgspec decodes are resolved during an import: two threads that did it later could end the process."""

from __future__ import annotations

import subprocess
import sys

import pytest

# A type is half resolved while msgspec runs Python to resolve it: for another type in it, a pattern, the hash of a
# Literal. What Python runs for the annotations of the type itself comes before other threads see it.
FIND = """
import sys
import msgspec
import agent.acquisition.service, agent.commanding.network, agent.monitor.following, agent.monitor.site_watching

def kinds(base):
    for kind in base.__subclasses__():
        yield kind
        yield from kinds(kind)

def called(frame, event, _):
    global depth
    if event == "call":
        depth += 1
        if depth == 1:
            ran.append(frame.f_code.co_name)
    elif event == "return":
        depth -= 1

# The outer types come first: a type in one that is resolved would say nothing of it.
for kind in sorted(set(kinds(msgspec.Struct)), key=lambda kind: (len(kind.__struct_fields__), kind.__name__))[::-1]:
    ran, depth = [], 0
    sys.setprofile(called)
    msgspec.json.Decoder(kind)
    sys.setprofile(None)
    if len(ran) > 1:
        print(f"{kind.__module__}.{kind.__name__}")
"""
# Those of agent.supervision.
ENCODED_ONLY = {"health.GatewayStatus", "health.SensorHealth", "health.Situation", "devices.DeviceHealth"}
BY_ONE_THREAD = {  # that reads a recording; and what an audit tells
    "events.DeviceChange",
    "events.Gap",
    "events.SelfTestRun",
    "events.Command",
    "replaying.ReplayedFile",
}


@pytest.mark.slow
def test_types_that_threads_decode_are_resolved_by_an_import() -> None:
    found = subprocess.run([sys.executable, "-c", FIND], capture_output=True, text=True, check=True, timeout=60)
    names = {name.split(".", 2)[2] for name in found.stdout.split() if name.startswith("agent.")}
    assert names - ENCODED_ONLY == BY_ONE_THREAD
