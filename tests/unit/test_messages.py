"""Events and results survive the wire bit for bit, and the wire is the one that viewers know."""

from __future__ import annotations

import contextlib
import importlib.util
import math
import struct
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.core.events import (
    RESULTS,
    CalibrationUpdate,
    Command,
    DeviceChange,
    Estimate,
    Gap,
    RunStart,
    Tick,
)
from agent.proto import fieldcal_pb2 as pb
from agent.recording.messages import MessageError, decode, encode, schema_data, schema_of, topic_of
from hw.block import BlockFlags, SampleBlock

REPOSITORY = Path(__file__).parents[2]
STRUCTS = [
    RunStart,
    DeviceChange,
    Gap,
    Command,
    Tick,
    *(kind for what, kind in RESULTS.items() if what not in ("calibration", "estimate")),
]
NAMES = ["Event", "RawBlock", *(what.capitalize() for what in RESULTS)]
INTEGER = st.integers(-(2**63), 2**63 - 1)
NUMBER = st.floats(width=64)
SPECIAL = [float("nan"), -0.0, float("inf"), -float("inf"), 5e-324, math.pi]


def bits(value: Any) -> Any:
    """A value in which floats are told apart by their bits, so that NaN equals NaN and 0.0 does not equal -0.0."""
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, dict):
        return {key: bits(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [bits(item) for item in value]
    return value


def struct_items(kind: type[msgspec.Struct]) -> st.SearchStrategy[Any]:
    strategies = {name: INTEGER if hint is int else st.from_type(hint) for name, hint in field_types(kind).items()}
    return st.builds(kind, **strategies)


def field_types(kind: type[msgspec.Struct]) -> dict[str, Any]:
    return {field.name: field.type for field in msgspec.structs.fields(kind)}


def through_the_wire(event_sequence: int, item: Any) -> Any:
    number, decoded = decode(schema_of(topic_of(item)), encode(event_sequence, item))
    assert number == event_sequence
    assert type(decoded) is type(item)
    return decoded


@pytest.mark.slow
@pytest.mark.parametrize("kind", STRUCTS)
@settings(max_examples=20)
@given(data=st.data())
def test_every_event_and_result_comes_back_as_it_was(kind: type[msgspec.Struct], data: st.DataObject) -> None:
    item = data.draw(struct_items(kind))
    number = getattr(item, "event_sequence", data.draw(INTEGER))
    assert bits(msgspec.structs.asdict(through_the_wire(number, item))) == bits(msgspec.structs.asdict(item))


@pytest.mark.slow
@given(numbers=st.lists(NUMBER | st.sampled_from(SPECIAL), min_size=28, max_size=28), cells=st.data())
def test_calibration_comes_back_as_it_was(numbers: list[float], cells: st.DataObject) -> None:
    covariance = cells.draw(st.lists(st.sampled_from(SPECIAL), min_size=144, max_size=144))
    update = CalibrationUpdate(
        run_id="r",
        sequence=3,
        sensor="s",
        t_utc_ns=4,
        sensitivity=[numbers[0:3], numbers[3:6], numbers[6:9]],
        offset=numbers[9:12],
        standard_uncertainty=numbers[12:24],
        covariance=[covariance[12 * row : 12 * row + 12] for row in range(12)],
        coverage_factor=numbers[24],
        determined=[k % 3 == 0 for k in range(12)],
        method="m",
        uncertainty_kind="k",
        windows=5,
        residual_sd=numbers[25:28],
        output_unit="count",
        identity="i",
        reference_temperature_degc=numbers[0],
        temperature_low_degc=numbers[1],
        temperature_high_degc=numbers[2],
        offset_temperature=[numbers[3:6], numbers[6:9]],
        u_offset_temperature=[numbers[4:7], numbers[7:10]],
        sensitivity_temperature=numbers[5:8],
        u_sensitivity_temperature=numbers[6:9],
        offset_rate=numbers[7:10],
        u_offset_rate=numbers[8:11],
    )
    assert bits(msgspec.to_builtins(through_the_wire(9, update))) == bits(msgspec.to_builtins(update))
    estimate = Estimate(run_id="r", sequence=4, sensor="s", t_utc_ns=5, reason="beyond", calibration=update)
    assert bits(msgspec.to_builtins(through_the_wire(9, estimate))) == bits(msgspec.to_builtins(estimate))


def test_calibration_scalars_have_the_papers_names() -> None:
    update = CalibrationUpdate(
        run_id="",
        sequence=0,
        sensor="",
        t_utc_ns=0,
        sensitivity=[[11.0, 12.0, 13.0], [21.0, 22.0, 23.0], [31.0, 32.0, 33.0]],
        offset=[1.0, 2.0, 3.0],
        standard_uncertainty=[float(k) for k in range(12)],
        covariance=[[0.0] * 12] * 12,
        coverage_factor=2.0,
        determined=[True] * 12,
        method="",
        uncertainty_kind="",
        windows=0,
        residual_sd=[4.0, 5.0, 6.0],
        output_unit="",
        identity="",
    )
    message = pb.Calibration.FromString(encode(0, update))
    assert (message.sxy, message.syx, message.szz, message.qx, message.qz) == (12.0, 21.0, 33.0, 1.0, 3.0)
    assert (message.u_sxx, message.u_sxy, message.u_qz, message.residual_sd_y) == (0.0, 1.0, 11.0, 5.0)


@given(
    n=st.integers(1, 70),
    axes=st.sampled_from([1, 3]),
    decimal=st.booleans(),
    transposed=st.booleans(),
    first_index=st.integers(0, 2**62),
    temperature=st.sampled_from([None, 0.0, -0.0]) | NUMBER,
    raw=st.sampled_from([None, 0]) | INTEGER,
    flags=st.integers(0, 15),
    seed=st.integers(0, 2**32),
)
def test_blocks_come_back_as_they_were(
    n: int,
    axes: int,
    decimal: bool,
    transposed: bool,
    first_index: int,
    temperature: float | None,
    raw: int | None,
    flags: int,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    indications = rng.integers(-(2**31), 2**31, (n, axes), dtype=np.int32)
    if decimal:  # any bits at all, NaN with payload among them
        indications = rng.integers(0, 2**64, (n, axes), dtype=np.uint64).view(np.float64)
    if transposed:
        indications = np.asfortranarray(indications)
    counts = np.array([n // 2, n], np.int32)
    arrivals = rng.integers(-(2**62), 2**62, 2)
    sent = SampleBlock(
        "d", "b", -5, first_index, 999.5, arrivals, counts, indications, BlockFlags(flags), raw, temperature
    )
    received = through_the_wire(2**40, sent)
    assert received.indications.dtype == indications.dtype
    assert received.indications.flags.c_contiguous
    assert received.indications.tobytes() == np.ascontiguousarray(indications).tobytes()
    assert received.burst_t_monotonic_ns.tolist() == arrivals.tolist()
    assert received.burst_count.tolist() == counts.tolist()
    names = ("device", "boot_id", "t_utc_ns", "first_index", "nominal_rate_hz", "flags", "temperature_raw")
    assert [getattr(received, name) for name in names] == [getattr(sent, name) for name in names]
    assert bits(received.temperature_degc) == bits(temperature)


@pytest.mark.parametrize("name", NAMES)
def test_a_schema_alone_decodes_its_messages(name: str) -> None:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema_data(f"fieldcal.v1.{name}")).file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"fieldcal.v1.{name}"))
    fields = {field.name: field.number for field in kind.DESCRIPTOR.fields}
    assert fields == {field.name: field.number for field in getattr(pb, name).DESCRIPTOR.fields}
    assert list(pool.FindFileByName("agent/proto/fieldcal.proto").message_types_by_name) == [name]


@given(
    name=st.sampled_from(NAMES),
    data=st.binary(max_size=200),
)
def test_any_bytes_decode_or_are_refused(name: str, data: bytes) -> None:
    with contextlib.suppress(MessageError):
        decode(f"fieldcal.v1.{name}", data)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Event", pb.Event(event_sequence=1)),
        ("Event", pb.Event(device_change=pb.Event.DeviceChange(state="asleep"))),
        ("Status", pb.Status(status="GOOD")),
        ("Calibration", pb.Calibration(covariance=[1.0] * 143)),
        ("Drift", pb.Status()),
    ],
)
def test_what_is_no_event_or_result_is_refused(name: str, message: Any) -> None:
    with pytest.raises(MessageError):
        decode(f"fieldcal.v1.{name}", message.SerializeToString())


def test_indications_of_another_type_are_refused() -> None:
    odd = SampleBlock("d", "b", 0, 0, 1.0, np.zeros(1, np.int64), np.ones(1, np.int32), np.ones((1, 3), np.int16))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="int16"):
        encode(0, odd)


def test_the_generated_code_is_that_of_the_proto_file(tmp_path: Path) -> None:
    if importlib.util.find_spec("grpc_tools") is None:
        pytest.skip("grpcio-tools is not installed")
    import subprocess

    protos = ["agent/proto/fieldcal.proto", "hw/sparkplug.proto"]
    target = [f"--python_out={tmp_path}", f"--pyi_out={tmp_path}", *protos]
    command = [sys.executable, "-m", "grpc_tools.protoc", "-I.", *target]
    subprocess.run(command, cwd=REPOSITORY, check=True, timeout=60)
    for proto in protos:
        for suffix in ("_pb2.py", "_pb2.pyi"):
            name = proto.removesuffix(".proto") + suffix
            assert (tmp_path / name).read_text() == (REPOSITORY / name).read_text(), f"generate it again, see {proto}"
