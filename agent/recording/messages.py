"""Events and results as protobuf messages (agent/proto/fieldcal.proto), bit for bit both ways.

A message is known by its schema name; the topic is where it stands in a recording. Floats keep every bit (NaN, -0.0,
infinities).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np
from google.protobuf import descriptor_pb2
from google.protobuf.message import DecodeError, Message

from agent.core.events import (
    RESULTS,
    Acceleration,
    CalibrationUpdate,
    Command,
    DeviceChange,
    Estimate,
    Event,
    Gap,
    Output,
    Pruned,
    Result,
    RunStart,
    SelfTestRun,
    SharedError,
    Tick,
)
from agent.proto import fieldcal_pb2 as pb
from agent.recording.acceleration import decode_acceleration, encode_acceleration
from agent.recording.raw_block import decode_block, encode_block
from calib.model import PARAMETERS
from hw.block import SampleBlock

PACKAGE = "fieldcal.v1"
EVENTS_TOPIC = "/events"

_EVENT_FIELDS: dict[type[Any], str] = {
    RunStart: "run_start",
    DeviceChange: "device_change",
    Gap: "gap",
    SelfTestRun: "self_test_run",
    Command: "command",
    Pruned: "pruned",
    Tick: "tick",
}
_EVENT_KINDS = {field: kind for kind, field in _EVENT_FIELDS.items()}
_S_AND_Q = [name.lower() for name in PARAMETERS]
_U = [f"u_{name}" for name in _S_AND_Q]
_ROWS_OF_THREE = ["offset_temperature", "u_offset_temperature", "sensitivity_per_k", "u_sensitivity_per_k"]
_BY_AXIS = ["sensitivity_temperature", "u_sensitivity_temperature", "offset_rate", "u_offset_rate"]
_LISTED = ["determined", "references", "valid_band_hz", "degrees_of_freedom", *_BY_AXIS]
_BY_UNKNOWN = ["derivative", "own_derivative"]
_LISTS = ["sensitivity", "unknowns", "kinds", "stated", "u_stated", "value"]
_RESIDUALS = ["residual_sd_x", "residual_sd_y", "residual_sd_z"]


class MessageError(ValueError):
    """A message that is no event or result of this format; the text names the field and its value."""


def topic_of(item: Event | Output) -> str:
    """Topic on which an event or result is recorded."""
    if isinstance(item, SampleBlock):
        return f"/{item.device}/raw"
    if isinstance(item, Acceleration):
        return f"/{item.sensor}/acceleration"
    if isinstance(item, Result):
        return f"/{item.sensor}/{item.what}"
    return EVENTS_TOPIC


def is_result_topic(topic: str) -> bool:
    """Whether results are recorded on a topic."""
    return topic.rsplit("/", 1)[-1] in RESULTS


def recorded_ones(outputs: Sequence[Output]) -> list[Output]:
    """What of a step goes into the recording: all results, and the corrected stream where the configuration says so."""
    return [item for item in outputs if not isinstance(item, Acceleration) or item.recorded]


def schema_of(topic: str) -> str:
    """Full name of the message that is recorded on a topic of this program."""
    names = {"events": "Event", "raw": "RawBlock", "acceleration": "Acceleration"}
    names |= {what: what.capitalize() for what in RESULTS}
    return f"{PACKAGE}.{names[topic.rsplit('/', 1)[1]]}"


def schema_data(schema_name: str) -> bytes:
    """FileDescriptorSet (serialised) that holds this one message, as MCAP wants it for encoding `protobuf`."""
    file = descriptor_pb2.FileDescriptorProto()
    pb.DESCRIPTOR.CopyToProto(file)
    kept = [message for message in file.message_type if f"{PACKAGE}.{message.name}" == schema_name]
    del file.message_type[:]
    file.message_type.extend(kept)
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(deterministic=True)


def encode(event_sequence: int, item: Event | Output) -> bytes:
    """Wire bytes of an event, or of a result caused by the event with this sequence number.

    Raises ValueError where the item does not fit the format (shapes, text that is no Unicode).
    """
    if isinstance(item, SampleBlock):
        return encode_block(event_sequence, item)
    if isinstance(item, Acceleration):
        return encode_acceleration(event_sequence, item)
    if isinstance(item, Result):
        message = _MESSAGES.get(type(item), _message)(event_sequence, item)
    else:
        message = pb.Event(event_sequence=event_sequence, **{_EVENT_FIELDS[type(item)]: _event_values(item)})
    return message.SerializeToString(deterministic=True)


def decode(schema_name: str, data: bytes) -> tuple[int, Event | Output]:
    """(event_sequence, event or result) of wire bytes. Raises MessageError, nothing else, whatever the bytes are."""
    decoder = _DECODERS.get(schema_name)
    if decoder is None:
        raise MessageError(f"schema {schema_name!r} is none of {', '.join(_DECODERS)}")
    try:
        return decoder(data)
    except MessageError:
        raise
    except (DecodeError, msgspec.ValidationError, ValueError) as error:
        raise MessageError(f"{schema_name}: {error}") from None


def _event_values(event: Any) -> dict[str, Any]:
    values = msgspec.structs.asdict(event)
    if isinstance(event, RunStart):
        del values["event_sequence"]
    return values


def _decode_event(data: bytes) -> tuple[int, Event]:
    message = pb.Event.FromString(data)
    field = message.WhichOneof("event")
    if field is None:
        raise MessageError("event: empty, or of a kind unknown to this version")
    values = _values(getattr(message, field))
    if field == "run_start":
        values["event_sequence"] = message.event_sequence
    return message.event_sequence, msgspec.convert(values, _EVENT_KINDS[field], builtin_types=(bytes,))


def _values(message: Message) -> dict[str, Any]:
    """Fields of a message as Python values, maps by key, numbers in lists; what is optional and absent is left out."""
    values: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        if field.has_presence and not message.HasField(field.name):
            continue
        value = getattr(message, field.name)
        is_map = field.message_type is not None and field.message_type.GetOptions().map_entry
        if is_map:
            value = dict(sorted(value.items()))
        elif field.is_repeated and field.message_type is None:
            value = list(value)
        values[field.name] = value
    return values


def _message(event_sequence: int, result: Result) -> Message:
    kind: Callable[..., Message] = getattr(pb, result.what.capitalize())
    return kind(event_sequence=event_sequence, **msgspec.structs.asdict(result))


def _decoder(kind: type[Result]) -> Callable[[bytes], tuple[int, Event | Output]]:
    message_type: Callable[[], Message] = getattr(pb, kind.what.capitalize())

    def decode_result(data: bytes) -> tuple[int, Event | Output]:
        message = message_type()
        message.ParseFromString(data)
        values = _values(message)
        return values.pop("event_sequence"), msgspec.convert(values, kind)

    return decode_result


def _calibration_message(event_sequence: int, update: CalibrationUpdate) -> pb.Calibration:
    values = msgspec.structs.asdict(update)
    s_and_q = [*np.asarray(values.pop("sensitivity")).reshape(9).tolist(), *values.pop("offset")]
    covariance = np.asarray(values.pop("covariance"), dtype=np.float64).reshape(12, 12)
    values |= zip(_S_AND_Q, s_and_q, strict=True)
    values |= zip(_U, values.pop("standard_uncertainty"), strict=True)
    values |= zip(_RESIDUALS, values.pop("residual_sd"), strict=True)
    values |= {name: np.ravel(values[name]) for name in _ROWS_OF_THREE}
    values["sensitivity_at_0hz"] = pb.Calibration.Steady(**_flat(values["sensitivity_at_0hz"]))
    values["response"] = [pb.Calibration.Band(**_flat(band)) for band in values["response"]]
    values["shared_errors"] = [_shared_message(error) for error in values["shared_errors"]]
    values["budget"] = [
        pb.Calibration.Source(name=name, standard_uncertainty=u) for name, u in values["budget"].items()
    ]
    return pb.Calibration(event_sequence=event_sequence, covariance=covariance.ravel(), **values)


def _decode_calibration(data: bytes) -> tuple[int, Result]:
    values = _values(pb.Calibration.FromString(data))
    s_and_q = [values.pop(name) for name in _S_AND_Q]
    values["sensitivity"] = [s_and_q[0:3], s_and_q[3:6], s_and_q[6:9]]
    values["offset"] = s_and_q[9:]
    values["standard_uncertainty"] = [values.pop(name) for name in _U]
    values["residual_sd"] = [values.pop(name) for name in _RESIDUALS]
    values["covariance"] = np.array(values["covariance"]).reshape(12, 12).tolist()
    values |= {name: np.reshape(values[name], (-1, 3)).tolist() for name in _ROWS_OF_THREE}
    values |= {name: list(values[name]) for name in _LISTED}
    values["budget"] = {source.name: list(source.standard_uncertainty) for source in values["budget"]}
    values["response"] = [_square(band) for band in values["response"]]
    values["shared_errors"] = [_shared_values(error) for error in values["shared_errors"]]
    if "sensitivity_at_0hz" in values:
        values["sensitivity_at_0hz"] = _square(values["sensitivity_at_0hz"])
    return values.pop("event_sequence"), msgspec.convert(values, CalibrationUpdate)


def _flat(part: msgspec.Struct) -> dict[str, Any]:
    """The fields of a part of a calibration, matrices row by row."""
    fields = msgspec.structs.asdict(part)
    return {name: np.ravel(value) if isinstance(value, list) else value for name, value in fields.items()}


def _square(part: Message) -> dict[str, Any]:
    """The fields of a part of a calibration as Python values, matrices 3 x 3."""
    return {
        name: value if isinstance(value, float) else np.reshape(value, (-1, 3)).tolist()
        for name, value in _values(part).items()
    }


def _shared_message(error: SharedError) -> pb.Calibration.SharedError:
    values = msgspec.structs.asdict(error)
    return pb.Calibration.SharedError(**values | {name: np.ravel(values[name]) for name in _BY_UNKNOWN})


def _shared_values(error: Message) -> dict[str, Any]:
    values = {name: list(value) if name in _LISTS else value for name, value in _values(error).items()}
    n = len(values["unknowns"])
    return values | {name: np.reshape(values[name], (n, -1 if n else 0)).tolist() for name in _BY_UNKNOWN}


def _estimate_message(event_sequence: int, estimate: Estimate) -> pb.Estimate:
    values = msgspec.structs.asdict(estimate)
    inside = _calibration_message(event_sequence, values.pop("calibration"))
    return pb.Estimate(
        event_sequence=event_sequence, calibration=inside.SerializeToString(deterministic=True), **values
    )


def _decode_estimate(data: bytes) -> tuple[int, Result]:
    values = _values(pb.Estimate.FromString(data))
    _, values["calibration"] = _decode_calibration(values["calibration"])
    return values.pop("event_sequence"), msgspec.convert(values, Estimate)


# What is not encoded field by field: a calibration is flat in its message, so that a viewer can draw each number.
_MESSAGES: dict[type[Result], Callable[[int, Any], Message]] = {
    CalibrationUpdate: _calibration_message,
    Estimate: _estimate_message,
}
_DECODERS: dict[str, Callable[[bytes], tuple[int, Event | Output]]] = {
    f"{PACKAGE}.Event": _decode_event,
    f"{PACKAGE}.RawBlock": decode_block,
    f"{PACKAGE}.Acceleration": decode_acceleration,
    **{f"{PACKAGE}.{what.capitalize()}": _decoder(kind) for what, kind in RESULTS.items()},
    f"{PACKAGE}.Calibration": _decode_calibration,
    f"{PACKAGE}.Estimate": _decode_estimate,
}
