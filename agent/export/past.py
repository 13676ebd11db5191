"""The past of sensors as a table, as CSV and as JSON: S, Q and U of each epoch, and what changed at once."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.config.whole_files import new_file
from agent.core.events import CalibrationUpdate, RunStart, StatusChange
from agent.core.kept import update_of
from agent.core.memory import Memory
from agent.core.past import KnownPast, PastError, dates_of, past_of
from agent.core.snapshot import unpack
from agent.delivery.calibrations import first_in_force
from agent.delivery.history import History
from agent.export.at_the_end import memories_at_the_end
from agent.export.samples import followed, steps_of
from agent.export.smoothing import date_of, smoothing
from agent.export.tables import cell
from calib.model import PARAMETERS, Array
from calib.output_unit import shown_in
from calib.rounding import aligned, plus_minus, rounded
from calib.state.dating import PROBABILITY, Date
from calib.state.past import StatedChange

DATED = ("change", "u_change_days", "change_after", "change_before")  # columns of CSV
SHOWN = ("Sxx", "Syy", "Szz", "Qx", "Qy", "Qz")
Made = tuple[str, int] | None  # run and number of the result by which a calibration came into force first
InForce = tuple[tuple[str, int], str] | None  # the same, with the identity of the device


@dataclass(frozen=True, slots=True)
class SensorPast:
    """The past of a sensor with one device. `known` is None where it has none, for the reason `why`. `in_force` (K,):
    the calibration in force at each epoch; None where none was, or where its result is no longer kept. `dates`: those
    of its changes."""

    sensor: str
    identity: str
    known: KnownPast | None
    in_force: Sequence[Made] = ()
    dates: Sequence[Date] = ()
    why: str = ""


def pasts(history: History) -> list[SensorPast]:
    """The pasts of all devices in a store. Raises StoreError."""

    def in_force_at(sensor: str, times_utc_ns: Sequence[int]) -> list[InForce]:
        records = history.in_force_at(sensor, times_utc_ns)
        return [None if record is None else (first_in_force(record), record.identity) for record in records]

    return [_past(memory, in_force_at) for memory in history.memories()]


def pasts_of(recordings: Sequence[Path], faults: list[str]) -> list[SensorPast]:
    """The pasts of all devices in recordings of one gateway, by their windows; why one ends early is added to `faults`.

    Raises ExportError.
    """
    came = _came(recordings, faults)

    def in_force_at(sensor: str, times_utc_ns: Sequence[int]) -> list[InForce]:
        own = came.get(sensor, [])
        starts = [t_utc_ns for t_utc_ns, _, _ in own]
        return [own[k - 1][2] if (k := bisect_right(starts, t)) else None for t in times_utc_ns]

    return [_past(memory, in_force_at) for memory in memories_at_the_end(recordings)]


def _came(recordings: Sequence[Path], faults: list[str]) -> dict[str, list[tuple[int, int, InForce]]]:
    """By sensor, when each calibration of recordings came into force, or none was, in order; with the results' numbers.

    The one that was in force before the first recording is known from its snapshot.
    """
    came: dict[str, set[tuple[int, int, InForce]]] = {}
    for path in recordings:
        with followed(path):
            for step in steps_of(path, faults):
                event, results = step.event, step.results
                if isinstance(event, RunStart):
                    held = [update_of(own["in_force"]) for own in unpack(event.snapshot)["channels"].values()]
                    results = [*(update for update in held if update is not None), *results]
                for result in results:
                    if isinstance(result, CalibrationUpdate):
                        own = came.setdefault(result.sensor, set())
                        own.add((result.t_utc_ns, result.sequence, (result.made, result.identity)))
                    elif isinstance(result, StatusChange) and result.status == "UNCALIBRATED":
                        came.setdefault(result.sensor, set()).add((result.t_utc_ns, result.sequence, None))
    return {sensor: sorted(own, key=lambda one: one[:2]) for sensor, own in came.items()}


def _past(memory: Memory, in_force_at: Callable[[str, Sequence[int]], list[InForce]]) -> SensorPast:
    try:
        known = past_of(memory)
        dates = dates_of(known)
    except PastError as error:
        return SensorPast(memory.sensor, memory.identity, None, why=str(error))
    times = [known.utc_ns(day) for day in known.past.days.tolist()]
    found = zip(in_force_at(memory.sensor, times), known.past.windows, strict=True)
    in_force = [
        own[0] if own is not None and (windows or own[1] == memory.identity) else None for own, windows in found
    ]
    return SensorPast(memory.sensor, memory.identity, known, in_force, dates)


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
        "reference_frequency_hz": known.reference_frequency_hz,
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
                "date": _date_object(known, date),
            }
            for change, date in zip(past.changes, one.dates, strict=True)
        ],
    }


def _date_object(known: KnownPast, date: Date) -> dict[str, Any]:
    return {
        "t_utc_ns": known.utc_ns(date.day),
        "standard_uncertainty_days": date.standard_uncertainty,
        "interval_utc_ns": [known.utc_ns(day) for day in date.interval],
        "probability": PROBABILITY,
        "told_by": "windows" if date.by_windows else "statement",
    }


def write_csv(path: Path, found: Sequence[SensorPast]) -> int:
    """Write a row for each epoch, with the smoothing of each device in the head; the epoch at a change has its date.
    Returns the number of rows.

    Raises OSError, also where the file exists.
    """
    rows, u_names = 0, [f"u_{name}" for name in PARAMETERS]
    names = ["sensor", "identity", "time", "windows", *PARAMETERS, *u_names, "calibration", "run", *DATED]
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
    dates = {change.day: date for change, date in zip(past.changes, one.dates, strict=True)}
    for day, windows, law, own in zip(past.days.tolist(), past.windows, past.laws, one.in_force, strict=True):
        u = np.sqrt(law.covariance.diagonal()[:12]).tolist()
        numbers = [repr(value) for value in (*law.mean[:12].tolist(), *u)]
        run, number = own or ("", 0)
        named = [cell(one.sensor), cell(one.identity), date_of(one.known.utc_ns(day)), str(windows)]
        yield [*named, *numbers, str(number), cell(run), *_date_cells(one.known, dates.get(day))]


def _date_cells(known: KnownPast, date: Date | None) -> list[str]:
    if date is None:
        return [""] * len(DATED)
    days = date.day, *date.interval
    dated, *interval = (date_of(known.utc_ns(day)) for day in days)
    return [dated, repr(date.standard_uncertainty), *interval]


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
    for change, date in zip(past.changes, one.dates, strict=True):
        yield f"{date_of(known.utc_ns(change.day))}  {_words(change, shown.factors, k)}; {_when(known, date)}"


def _words(change: StatedChange, factors: Array, k: float) -> str:
    """What may have changed at once on a day, and by how much S and Q did."""
    values, U = (factors * change.found).tolist(), (factors * k * change.standard_uncertainty).tolist()
    told = zip(PARAMETERS, values, U, strict=True)
    moved = [f"{name} {plus_minus(value, expanded)}" for name, value, expanded in told if name in change.stated]
    others = [key for key in change.stated if key not in PARAMETERS]
    said = [f"changed by {', '.join(moved)}"] if moved else []
    return "; ".join([*said, *([f"may have changed: {', '.join(others)}"] if others else [])])


def _when(known: KnownPast, date: Date) -> str:
    """When a change came, for people."""
    first, last = (date_of(known.utc_ns(day)) for day in date.interval)
    u = rounded(date.standard_uncertainty)
    told = "" if date.by_windows else ", between the windows before and after the statement"
    return f"it came {date_of(known.utc_ns(date.day))} with u = {u} d, from {first} to {last} (95 %){told}"
