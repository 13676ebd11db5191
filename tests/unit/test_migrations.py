"""A state of an older version is brought up to date, and the estimation goes on from it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.config import recorded_config
from agent.config.knowledge import Certificate
from agent.core.driver_filters import DriverFilters
from agent.core.events import CalibrationUpdate, DeviceChange
from agent.core.kept import take_up
from agent.core.pipeline import Pipeline
from agent.core.snapshot import VERSION, pack, unpack
from agent.delivery.store import Store
from agent.recording.reading import RecordingReader
from benchmarks.online.node import Node, Timing, node
from benchmarks.online.runner import Run, visits
from calib.estimate.quantities import KINDS
from tests.replay.golden_files import FORMATS, RECORDING, STATE, config_of

FORMAT_1 = next(path for path in FORMATS if path.name == "format-1")


@pytest.fixture
def kept(tmp_path: Path) -> bytes:
    """What the released version 1 kept of the golden recording's sensor."""
    (tmp_path / STATE).write_bytes((FORMAT_1 / STATE).read_bytes())
    store = Store(tmp_path, 0)
    (memory,) = (memory for memory in store.states if memory.sensor == "mems")
    store.close()
    return memory.state


def raw(state: bytes) -> dict[str, Any]:
    """As it is stored; arrays are left as they are."""
    found: dict[str, Any] = msgspec.msgpack.decode(state)
    return found


def test_a_state_of_version_1_goes_on_whole(kept: bytes) -> None:
    assert raw(kept)["version"] == 1 < VERSION
    channel = recorded_config(config_of(FORMAT_1 / RECORDING)).channels[0]
    channel = channel.model_copy(update={"certificate": Certificate()})  # whose reference drifts, as by default now
    nominal = next(
        msgspec.json.decode(s.event.info_json)
        for s in RecordingReader(FORMAT_1 / RECORDING).steps()
        if isinstance(s.event, DeviceChange) and s.event.device == "mems"
    )
    taken = take_up(kept, DriverFilters(channel), nominal.get("sensitivity"))
    assert taken.reason == "restored from the previous run"
    state = unpack(kept)["estimation"]["recursion"]["state"]
    names = raw(kept)["state"]["estimation"]["recursion"]["state"]["names"]
    assert [name for name, *_ in state["quantities"]] == names
    restored = taken.estimation.snapshot()["recursion"]
    n = len(names)
    assert [name for name, *_ in restored["state"]["quantities"][n:]] == ["reference_drift"] * 2  # and its first value
    assert np.array_equal(restored["state"]["factor"][:n, :n], state["factor"])
    assert not restored["state"]["factor"][n:].any()  # no date of the certificate: the drift begins now
    assert np.array_equal(restored["state"]["mean"][:n], state["mean"])
    assert len(restored["recent"]) == len(raw(kept)["state"]["estimation"]["recursion"]["recent"]) > 0
    assert taken.estimation.recursion.windows == unpack(kept)["estimation"]["recursion"]["windows"] > 0


@pytest.mark.parametrize(
    ("name", "kind", "position"),
    [
        ("Sxy", "sensitivity", ""),
        ("Qz", "offset", ""),
        ("Qz_rate", "offset rate", ""),
        ("Qz_T2", "offset over temperature", ""),
        ("Sx_T1", "sensitivity over temperature", ""),
        ("lag", "lag", ""),
        ("lag_y", "lag of axis", ""),
        ("reference_y", "reference sensitivity", ""),
        ("gravity", "gravity", ""),
        ("gravity_x[beside]", "gravity direction by position", "beside"),
        ("alpha", "alpha", ""),
        ("alpha[theta 35 deg, alpha [0] deg]", "alpha by position", "theta 35 deg, alpha [0] deg"),
        ("transverse_a[direction (0, 0, 1)]_quadrature", "transverse motion", "direction (0, 0, 1)"),
        ("transverse_lateral_quadrature", "transverse motion", ""),
        ("offset_x[p]", "offset by position", "p"),
    ],
)
def test_a_name_of_version_1_becomes_a_kind(name: str, kind: str, position: str) -> None:
    owner = "KB12 0042" if KINDS[kind].of_reference else ""
    assert brought_up([name])["quantities"] == [[name, kind, position, owner, False]]


def brought_up(names: list[str]) -> dict[str, Any]:
    joint = {"names": names, "mean": np.zeros(len(names)), "factor": np.eye(len(names))}
    recursion = {"state": joint, "base": dict(joint), "recent": [], "bound": np.ones(len(names)), "windows": 3}
    recursion |= {"held": None, "prior_u": np.ones(12)}
    state = raw(pack({"estimation": {"recursion": recursion, "held": []}, "reference": "KB12 0042"}))
    old = msgspec.msgpack.encode({"version": 1, "state": state["state"]})
    found: dict[str, Any] = unpack(old)["estimation"]["recursion"]["state"]
    return found


def test_a_name_that_version_1_did_not_have_is_no_state_of_it() -> None:
    with pytest.raises(ValueError, match=r"version 1 and cannot be converted to version \d+: .*'gravitas'"):
        brought_up(["gravitas"])


def test_a_version_that_is_not_known_is_named() -> None:
    newer = msgspec.msgpack.encode({"version": VERSION + 1, "state": {}})
    with pytest.raises(ValueError, match=f"version {VERSION + 1}, but this program reads versions 1 to {VERSION} only"):
        unpack(newer)


def test_a_state_of_version_6_goes_on_and_sums_up_what_its_bands_leave_open_from_now_on() -> None:
    drawn = node(3, all_axes=True, timing=Timing(20.0, 60.0, 6))
    run = Run(drawn.config)
    updates = [update for k in range(4) for update in of_visit(run, drawn, k)]
    state = unpack(run.pipeline.snapshot())
    (channel,) = state["channels"].values()
    recursion = channel["estimation"]["recursion"]
    assert recursion["over"].pop("left_open")["thirds"]
    for summary in recursion["recent"]:
        assert "left_open" in summary["data"]["bands"]
        del summary["data"]["bands"]["left_open"]
    old = raw(pack(state)) | {"version": 6}
    run.pipeline = Pipeline.restore(drawn.config.model_dump_json(), msgspec.msgpack.encode(old))
    newer = of_visit(run, drawn, 4)
    (channel,) = unpack(run.pipeline.snapshot())["channels"].values()
    assert channel["estimation"]["recursion"]["over"]["left_open"]["thirds"]
    np.testing.assert_allclose(newer[-1].sensitivity, updates[-1].sensitivity, atol=2e-3)


def of_visit(run: Run, drawn: Node, number: int) -> list[CalibrationUpdate]:
    results = [r for event in visits(drawn.building, range(number, number + 1)) for r in run.feed(event)]
    return [r for r in results if isinstance(r, CalibrationUpdate)]
