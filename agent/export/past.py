"""The past of sensors as a table, as CSV and as JSON: S, Q and U of each epoch, and what changed at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.core.past import KnownPast, PastError, past_of
from agent.delivery.calibrations import made
from agent.delivery.history import History
from agent.export.samples import new_file
from agent.export.smoothing import date_of, smoothing
from agent.export.tables import cell
from calib.estimate.past import Change
from calib.model import PARAMETERS, Array
from calib.recorded.output_unit import shown_in
from calib.rounding import aligned, plus_minus

SHOWN = ("Sxx", "Syy", "Szz", "Qx", "Qy", "Qz")
Made = tuple[str, int] | None  # run and number of the result by which a calibration came into force first


@dataclass(frozen=True, slots=True)
class SensorPast:
    """The past of a sensor with one device. `known` is None where it has none, for the reason `why`. `in_force` (K,):
    the calibration in force at each epoch; None where none was, or where its result is no longer kept."""

    sensor: str
    identity: str
    known: KnownPast | None
    in_force: Sequence[Made] = ()
    why: str = ""


def pasts(history: History) -> list[SensorPast]:
    """The pasts of all devices in a store. Raises StoreError."""
    found = []
    for memory in history.memories():
        try:
            known = past_of(memory)
        except PastError as error:
            found.append(SensorPast(memory.sensor, memory.identity, None, why=str(error)))
            continue
        times = [known.utc_ns(day) for day in known.past.days.tolist()]
        records = history.in_force_at(memory.sensor, times)
        in_force = [
            made(record) if record is not None and (windows or record.identity == memory.identity) else None
            for record, windows in zip(records, known.past.windows, strict=True)
        ]
        found.append(SensorPast(memory.sensor, memory.identity, known, in_force))
    return found


def as_object(found: Sequence[SensorPast]) -> list[dict[str, Any]]:
    """All of it, for JSON. Covariances are of S row by row, then Q."""
    return [
        {"sensor": one.sensor, "identity": one.identity, **({"none": one.why} if one.known is None else _whole(one))}
        for one in found
    ]


def _whole(one: SensorPast) -> dict[str, Any]:
    assert one.known is not None
    known, past = one.known, one.known.past
    return {
        "smoothing": smoothing(known),
        "state_sha256": known.sha256,
        "windows": known.windows,
        "last_window_utc_ns": known.last_window_utc_ns,
        "output_unit": known.unit,
        "coverage_factor": past.coverage_factor,
        "epochs": [
            {
                "t_utc_ns": known.utc_ns(day),
                "windows": windows,
                "sensitivity": law.mean[:9].reshape(3, 3).tolist(),
                "offset": law.mean[9:12].tolist(),
                "standard_uncertainty": np.sqrt(law.covariance.diagonal()[:12]).tolist(),
                "covariance": law.covariance[:12, :12].tolist(),
                "determined": law.determined.tolist(),
                "calibration": None if own is None else {"run_id": own[0], "sequence": own[1]},
            }
            for day, windows, law, own in zip(past.days.tolist(), past.windows, past.laws, one.in_force, strict=True)
        ],
        "changes": [
            {
                "t_utc_ns": known.utc_ns(change.day),
                "stated_u": dict(change.stated),
                "found": dict(zip(PARAMETERS, change.found.tolist(), strict=True)),
                "standard_uncertainty": dict(zip(PARAMETERS, change.standard_uncertainty.tolist(), strict=True)),
            }
            for change in past.changes
        ],
    }


def write_csv(path: Path, found: Sequence[SensorPast]) -> int:
    """Write a row for each epoch, with the smoothing of each device in the head. Returns the number of rows.

    Raises OSError, also where the file exists.
    """
    rows, u_names = 0, [f"u_{name}" for name in PARAMETERS]
    names = ["sensor", "identity", "time", "windows", *PARAMETERS, *u_names, "calibration", "run"]
    with new_file(path) as file:
        for one in found:
            if one.known is not None:
                file.write(f"# smoothing of {cell(one.identity)}: {smoothing(one.known)}\n".encode())
        file.write((",".join(names) + "\n").encode())
        for one in found:
            for cells in _cells(one):
                file.write((",".join(cells) + "\n").encode())
                rows += 1
    return rows


def _cells(one: SensorPast) -> Iterator[list[str]]:
    if one.known is None:
        return
    past = one.known.past
    for day, windows, law, own in zip(past.days.tolist(), past.windows, past.laws, one.in_force, strict=True):
        u = np.sqrt(law.covariance.diagonal()[:12]).tolist()
        numbers = [repr(value) for value in (*law.mean[:12].tolist(), *u)]
        run, number = own or ("", 0)
        named = [cell(one.sensor), cell(one.identity), date_of(one.known.utc_ns(day)), str(windows)]
        yield [*named, *numbers, str(number), cell(run)]


def lines(one: SensorPast) -> Iterator[str]:
    """The past of a sensor as text: a line for each epoch, then what changed at once."""
    if one.known is None:
        yield f"{one.sensor}: no past of {one.identity}: {one.why}"
        return
    known, past = one.known, one.known.past
    shown, k = shown_in(known.unit), past.coverage_factor
    yield f"{one.sensor}: {smoothing(known)}"
    yield f"{shown.words}, U with k = {k:.3g}; each epoch by all windows before and after it"
    chosen = [PARAMETERS.index(name) for name in SHOWN]
    rows = [["time (UTC)", "windows", *SHOWN, "calibration"]]
    for day, windows, law, own in zip(past.days.tolist(), past.windows, past.laws, one.in_force, strict=True):
        values = (shown.factors * law.mean[:12])[chosen].tolist()
        U = (shown.factors * k * np.sqrt(law.covariance.diagonal()[:12]))[chosen].tolist()
        told = zip(values, U, law.determined[chosen].tolist(), strict=True)
        cells = [plus_minus(value, expanded) if known_ else "not known" for value, expanded, known_ in told]
        rows.append([date_of(known.utc_ns(day)), str(windows), *cells, "-" if own is None else str(own[1])])
    yield from aligned(rows)
    for change in past.changes:
        yield f"{date_of(known.utc_ns(change.day))}  {_words(change, shown.factors, k)}"


def _words(change: Change, factors: Array, k: float) -> str:
    """What may have changed at once on a day, and by how much S and Q did."""
    values, U = (factors * change.found).tolist(), (factors * k * change.standard_uncertainty).tolist()
    told = zip(PARAMETERS, values, U, strict=True)
    moved = [f"{name} {plus_minus(value, expanded)}" for name, value, expanded in told if name in change.stated]
    others = [key for key in change.stated if key not in PARAMETERS]
    said = [f"changed by {', '.join(moved)}"] if moved else []
    return "; ".join([*said, *([f"may have changed: {', '.join(others)}"] if others else [])])
