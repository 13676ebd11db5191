"""A result as it is stored and published."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import msgspec

from agent.core.events import RESULTS, CalibrationUpdate, Result
from agent.delivery.schema import RESULT_COLUMNS, StoreError, checked, row_crc

# Reads the rows for `StoredResult.of_joined`; conditions may follow.
JOINED = f"SELECT {RESULT_COLUMNS}, crc, data, signed_crc FROM results LEFT JOIN signed USING (sequence)"

# msgspec 0.22 resolves the fields of a type when it is first decoded, and shows the type to other threads before that
# is done: one that decodes it at the same moment ends the process by SIGSEGV. So it is done here, during the import.
for _kind in RESULTS.values():
    msgspec.json.Decoder(_kind)


@dataclass(frozen=True, slots=True)
class StoredResult:
    """A result as it is stored and published.

    `payload`: its JSON with two added fields: `recorded`, which is false where the result and its raw data are in no
    recording, and `epoch`, which names the numbering that `sequence` belongs to. `sensor`: empty for a result of the
    gateway itself. `sequence`: rises over all runs of a gateway, with gaps. `signed`: the result as its gateway signed
    it (agent.recording.result_signing), without `recorded`; empty where the gateway has no key.
    """

    sequence: int
    run_id: str
    sensor: str
    what: str
    payload: bytes
    t_utc_ns: int
    recorded: bool
    recording: str  # name of the recording's file; "" where the result is in none
    identity: str = ""  # for a calibration, the identity of the device
    signed: bytes = b""

    @staticmethod
    def of(result: Result, *, recorded: bool, recording: str, epoch: str = "", signed: bytes = b"") -> StoredResult:
        """Make the record of a result."""
        identity = result.identity if isinstance(result, CalibrationUpdate) else ""
        return StoredResult(
            result.sequence,
            result.run_id,
            result.sensor,
            result.what,
            payload_of(result, recorded=recorded, epoch=epoch),
            result.t_utc_ns,
            recorded,
            recording,
            identity,
            signed,
        )

    @staticmethod
    def of_row(row: tuple[Any, ...], signed: bytes = b"") -> StoredResult:
        """Make the record from a row: RESULT_COLUMNS and their CRC. Raises DamagedRow."""
        sequence, run_id, sensor, what, payload, t_utc_ns, recorded, recording, identity = checked(row)
        return StoredResult(
            sequence, run_id, sensor, what, payload, t_utc_ns, bool(recorded), recording, identity, signed
        )

    @staticmethod
    def of_joined(row: tuple[Any, ...]) -> StoredResult:
        """Make the record from a row of JOINED. Raises DamagedRow."""
        *columns, data, signed_crc = row
        signed = bytes(checked((row[0], data, signed_crc))[1]) if data is not None else b""
        return StoredResult.of_row(tuple(columns), signed)

    @property
    def row(self) -> tuple[Any, ...]:
        """The columns of RESULT_COLUMNS and their CRC."""
        columns: tuple[Any, ...] = (self.sequence, self.run_id, self.sensor, self.what, self.payload, self.t_utc_ns)
        columns += (int(self.recorded), self.recording, self.identity)
        return (*columns, row_crc(*columns))

    @property
    def is_withdrawal(self) -> bool:
        """Whether this status (UNCALIBRATED) ends the time in force of the sensor's calibration."""
        return self.what == "status" and self.fields.get("status") == "UNCALIBRATED"

    @property
    def fields(self) -> dict[str, Any]:
        """The payload, decoded from JSON. Raises StoreError where it is not JSON."""
        try:
            return msgspec.json.decode(self.payload, type=dict[str, Any])
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise StoreError(f"result {self.sequence} cannot be read: {error}") from None

    @property
    def result(self) -> Result:
        """The result, decoded; null becomes NaN. Raises StoreError where this version cannot decode the payload."""
        try:
            return msgspec.convert(_null_to_nan(self.fields), RESULTS[self.what])
        except (KeyError, msgspec.ValidationError) as error:
            raise StoreError(f"result {self.sequence}, a {self.what}, cannot be read: {error}") from None


def payload_of(result: Result, *, recorded: bool, epoch: str) -> bytes:
    """The JSON of a result, as it is stored and published. A number that is not finite becomes null."""
    fields = {**msgspec.structs.asdict(result), "recorded": recorded} | ({"epoch": epoch} if epoch else {})
    return msgspec.json.encode(fields)


def result_of(what: str, fields: dict[str, Any]) -> Result | None:
    """The result whose fields these are; None where this version knows no such kind. Raises msgspec.ValidationError."""
    return msgspec.convert(_null_to_nan(fields), RESULTS[what]) if what in RESULTS else None


def _null_to_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _null_to_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_null_to_nan(item) for item in value]
    return math.nan if value is None else value
