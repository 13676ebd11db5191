"""Corrects results that rest on a reference whose certificate was wrong or is replaced, without touching them.

What a result owes to the errors of its reference is stated in it (docs/shared-errors.md). The prior of these errors is
exchanged for that of the new certificate; no raw data are needed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from agent import __version__
from agent.calibrate.origin import source_file
from agent.config.files import read_file
from agent.config.whole_files import write_whole
from agent.core.events import CalibrationUpdate, SharedError
from agent.delivery.calibrations import calibrations
from agent.delivery.history import FILE_NAME, History
from agent.recording.scan import scan
from agent.recording.signed_text import sign, written
from agent.report.result import ResultError, parse, plain
from calib.estimate.reference_share import ReferenceShare
from calib.model import Array
from calib.recorded.certificate import ReferenceCertificate

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

PURPOSE = "fieldcal recall 1"
RECORDINGS = (".mcap", ".mcap.active")
MOST = 1_000_000  # calibrations of one sensor in one data directory
LARGEST_RESULT = 64 << 20  # bytes


class RecallError(Exception):
    """An input cannot be used. The message names the file, what is wrong, and the remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class IssuedResult:
    """A result: where it is, S and Q (12,) with covariance and k, and what it owes to its references.

    `name`: sensor, or file without its ending. `made`: run and sequence, or the SHA-256 of the file. `stated`: the
    serial number of the reference as a certificate states it, "" elsewhere.
    """

    source: str
    name: str
    made: tuple[str, int]
    values: Array
    covariance: Array
    coverage_factor: Array
    shared_errors: tuple[SharedError, ...]
    references: tuple[str, ...] = ()
    stated: str = ""

    def owed_to(self, serial_number: str) -> SharedError | None:
        """What it owes to the reference with this serial number; None where it states nothing of it."""
        for shared in self.shared_errors:
            if serial_number in (shared.serial_number or self.stated, *_words(shared.reference)):
                return shared if shared.unknowns and shared.has_its_shapes else None
        return None

    def rests_on(self, serial_number: str) -> bool:
        """Whether the reference with this serial number is one of its references."""
        named = (self.stated, *(w for reference in self.references for w in _words(reference)))
        return serial_number in named or self.owed_to(serial_number) is not None


def _words(reference: str) -> list[str]:
    """The words of the identity of a reference, one of which is its serial number."""
    return reference.replace(",", " ").split()


def results_in(path: Path) -> Iterator[IssuedResult]:
    """The calibrations in a data directory, in a recording, or in a JSON of `calibrate` or `certificate`.

    Raises RecallError, StoreError and OSError.
    """
    if path.is_dir():
        with History(path / FILE_NAME) as history:
            sensors = sorted({name for name, what in history.channels() if what == "calibration"})
            updates = [r.result for sensor in sensors for r in calibrations(history, sensor, limit=MOST)]
    elif path.name.endswith(RECORDINGS):
        updates = list(scan(path).results)
    else:
        yield _of_json(path)
        return
    for update in updates:
        if isinstance(update, CalibrationUpdate):
            yield IssuedResult(
                str(path), update.sensor, update.made, np.append(np.ravel(update.sensitivity), update.offset),
                np.array(update.covariance), np.full(12, update.coverage_factor), tuple(update.shared_errors),
                tuple(update.references),
            )  # fmt: skip


def _of_json(path: Path) -> IssuedResult:
    try:
        told: dict[str, Any] = msgspec.json.decode(read_file(path, LARGEST_RESULT), type=dict[str, Any])
        certificate, stated = told.get("certificate"), ""
        if isinstance(certificate, dict):
            told, stated = (
                {"status": "valid", **certificate["result"]},
                certificate["stated"]["reference"]["serial_number"],
            )
        result = parse(told, path.stem)
        shared = msgspec.convert(told.get("shared_errors") or [], list[SharedError])
    except (ResultError, msgspec.DecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise RecallError(
            f"{path}: neither a JSON of `fieldcal calibrate` or `fieldcal certificate`, nor a recording, nor a data "
            f"directory: {error}"
        ) from None
    return IssuedResult(
        str(path), path.stem, (source_file(path).sha256, 0), result.values, result.covariance,
        result.coverage_factor, tuple(shared), stated=str(stated),
    )  # fmt: skip


def corrected(found: IssuedResult, shared: SharedError, new: ReferenceCertificate) -> tuple[Array, Array]:
    """S and Q (12,) and their covariance (12, 12) by the new certificate. Raises RecallError."""
    share = ReferenceShare(
        shared.reference, np.array(shared.sensitivity), tuple(shared.unknowns), tuple(shared.kinds),
        np.array(shared.stated), np.array(shared.u_stated), np.array(shared.value),
        np.array(shared.own_derivative).T, np.array(shared.derivative).T,
    )  # fmt: skip
    try:
        return share.corrected(
            found.values, found.covariance, *share.restated(new.sensitivity, new.u_relative, new.corner_hz)
        )
    except (ValueError, np.linalg.LinAlgError):
        raise RecallError(
            f"{found.source}, {found.name}: {new.path} states {len(new.sensitivity)} sensitivities, which do not fit "
            f"the {len(shared.unknowns)} unknowns of the reference"
        ) from None


def recalled(results: Sequence[IssuedResult], serial_number: str, new: ReferenceCertificate) -> list[dict[str, Any]]:
    """The corrected results, each an object for its file; those that cannot be corrected have `corrected` null.

    A calibration that is in several inputs, or that came into force again, is corrected once.
    """
    found, seen = [], set()
    for result in results:
        if result.made in seen or not result.rests_on(serial_number):
            continue
        seen.add(result.made)
        found.append(_object(result, result.owed_to(serial_number), serial_number, new))
    return found


def _object(
    result: IssuedResult, shared: SharedError | None, serial_number: str, new: ReferenceCertificate
) -> dict[str, Any]:
    before = _numbers(result)
    after, change = None, None
    if shared is not None:
        values, covariance = corrected(result, shared, new)
        after = _numbers(replace(result, values=values, covariance=covariance))
        change = float(np.nanmax(np.abs(values - result.values) / np.sqrt(np.diag(result.covariance))))
    return {
        "source": result.source,
        "name": result.name,
        "run_id": result.made[0] if result.made[1] else None,
        "sequence": result.made[1] or None,
        "sha256": None if result.made[1] else result.made[0],
        "reference": {
            "serial_number": serial_number,
            "identity": None if shared is None else shared.reference,
            "certificate_sha256": None if shared is None else shared.certificate_sha256,
            "sensitivity": None if shared is None else shared.sensitivity,
        },
        "new_certificate": {
            "path": new.path,
            "sha256": new.sha256,
            "sensitivity": new.sensitivity,
            "u_sensitivity_pct": 100.0 * new.u_relative,
        },
        "before": before,
        "corrected": after,
        "largest_change_in_u": change,
        "reason": ""
        if shared is not None
        else "the result does not state what it owes to the reference: calibrate again",
        "version": __version__,
    }


def _numbers(result: IssuedResult) -> dict[str, Any]:
    u = np.sqrt(np.diag(result.covariance))
    return {
        **_parts(result.values),
        "standard_uncertainty": _parts(u),
        "expanded_uncertainty": _parts(result.coverage_factor * u) | {"coverage_factor": result.coverage_factor},
        "covariance": result.covariance,
    }


def _parts(values: Array) -> dict[str, Any]:
    return {"sensitivity": values[:9].reshape(3, 3), "offset": values[9:]}


def write(objects: Sequence[dict[str, Any]], directory: Path, key: Ed25519PrivateKey | None) -> dict[str, Any]:
    """Write one file for each corrected result, and recall.json, which lists them. Returns the content of the latter.

    Each file is {"recall": ..., "signature": ...}; the signature is over a text with the SHA-256 of the bytes of the
    first member, null without a key. Raises OSError, and RecallError where the directory is not empty.
    """
    directory.mkdir(parents=True, exist_ok=True)
    if any(directory.iterdir()):
        raise RecallError(f"{directory}: the directory is not empty; give a new one")
    listed = []
    for k, one in enumerate(objects, start=1):
        name = f"recall-{k:04d}.json" if one["corrected"] is not None else None
        entry = {
            member: one[member] for member in ("source", "name", "run_id", "sequence", "sha256", "largest_change_in_u")
        }
        listed.append({"file": name, **entry, "reason": one["reason"]})
        if name is not None:
            write_whole(directory / name, _signed(one, name, key))
    summary = {"results": listed, "corrected": sum(e["file"] is not None for e in listed), "version": __version__}
    write_whole(directory / "recall.json", _signed(summary, "recall.json", key))
    return summary


def _signed(content: dict[str, Any], name: str, key: Ed25519PrivateKey | None) -> bytes:
    body = msgspec.json.encode(plain(content))
    text = written(PURPOSE, {"file": name, "recall": hashlib.sha256(body).hexdigest()})
    signature = b"null" if key is None else sign(key, text).json
    return b'{"recall":' + body + b',\n"signature":' + signature + b"}\n"
