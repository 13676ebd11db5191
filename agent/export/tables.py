"""Tables of samples: CSV, Parquet. Each is written piece by piece, so memory does not grow with the length."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.config.whole_files import new_file
from agent.export.samples import ExportedSamples, ExportError, RecordedContent
from agent.terminal.text import no_formula, one_line
from calib.model import Array

QUANTITIES = {"m/s2": "a", "m/s": "v", "m": "d"}  # name of the column of a uniaxial device, by its unit


def names_of(content: RecordedContent) -> list[str]:
    """Columns without the time: indications as `fieldcal calibrate` names them, then accelerations in m/s2."""
    if content.axes == 3:
        return ["vx", "vy", "vz", *(["ax", "ay", "az"] if content.calibrations or content.smoothed else [])]
    return [QUANTITIES.get(content.unit, f"indication_{content.unit}")]


def write_csv(path: Path, content: RecordedContent, blocks: Iterable[ExportedSamples]) -> int:
    """Write `time_s` (UTC since 1970, all nine digits) and the columns; `nan` is a value that is not there.

    Samples that are corrected by S and Q smoothed over the past have a last column, `calibration`, and lines with # at
    the head that say by what.
    """
    rows, head = 0, [no_formula(f"# {name}: {text}") + "\n" for name, text in _about(content).items()]
    names = ["time_s", *names_of(content), *(["calibration"] if content.smoothed else [])]
    with new_file(path) as file:
        file.writelines(map(str.encode, [*head, ",".join(map(cell, names)) + "\n"]))
        for block in blocks:
            times = (f"{t // 10**9}.{t % 10**9:09d}" for t in block.t_utc_ns.tolist())
            values = columns(content, block).tolist()
            end = f",{block.calibration}\n" if content.smoothed else "\n"
            lines = (f"{t},{','.join(map(repr, row))}{end}" for t, row in zip(times, values, strict=True))
            file.writelines(map(str.encode, lines))
            rows += len(values)
    return rows


def _about(content: RecordedContent) -> dict[str, str]:
    """What a table says of itself: of corrected samples, and of a sensor that its site suspects."""
    if content.smoothed is None:
        return _suspected(content)
    told = {name: one_line(text) for name, text in content.smoothed.head.items()}
    runs = dict.fromkeys(update.made[0] for update in content.calibrations)
    runs_told = one_line(", ".join(runs))
    return {"device": one_line(content.device), **told, "runs of the calibrations": runs_told, **_suspected(content)}


def _suspected(content: RecordedContent) -> dict[str, str]:
    if content.suspicion is None:
        return {}
    told = {"suspected": one_line(content.suspicion.text)}
    if content.calibrations:
        newest = content.calibrations[-1]
        U = newest.coverage_factor * np.array(newest.standard_uncertainty)[[0, 4, 8]]
        told["U of Sxx, Syy, Szz, %"] = ", ".join(
            f"{100.0 * U[i] / abs(newest.sensitivity[i][i]):.2g}" for i in range(3) if newest.sensitivity[i][i]
        )
    return told


def cell(text: str) -> str:
    """A text as a cell of CSV that no spreadsheet takes for a formula."""
    text = no_formula(text)
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\r\n') else text


def write_parquet(path: Path, content: RecordedContent, blocks: Iterable[ExportedSamples]) -> int:
    """Write `time` (a date of UTC in ns) and the columns as float64. Raises ExportError without pyarrow."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise ExportError(f"{path}: Parquet needs pyarrow; install it with: fieldcal extras --install files") from None
    names = names_of(content)
    time = pa.timestamp("ns", tz="UTC")
    about = {"device": content.device, "unit": content.unit, "ax, ay, az": "m/s2", **_about(content)}
    numbered = [("calibration", pa.int64())] if content.smoothed else []
    fields = [("time", time), *((name, pa.float64()) for name in names), *numbered]
    schema = pa.schema(fields, metadata=about)
    rows = 0
    with new_file(path) as file, parquet.ParquetWriter(file, schema) as writer:
        for t_utc_ns, values, numbers in _gathered(content, blocks):
            arrays = [pa.array(t_utc_ns, time), *(pa.array(column) for column in values.T)]
            arrays += [pa.array(numbers)] if content.smoothed else []
            writer.write_table(pa.table(arrays, schema=schema))
            rows += len(values)
    return rows


def columns(content: RecordedContent, block: ExportedSamples) -> Array:
    """The columns (n, k) in the order of `names_of`."""
    if content.axes != 3 or not (content.calibrations or content.smoothed):
        return block.values
    none = np.full((len(block.values), 3), np.nan)
    return np.hstack([block.values, none if block.acceleration is None else block.acceleration])


def _gathered(
    content: RecordedContent, blocks: Iterable[ExportedSamples], rows: int = 1 << 16
) -> Iterator[tuple[NDArray[np.int64], Array, NDArray[np.int64]]]:
    """Blocks put together to pieces of about so many rows: a file with a part for each block would be slow to read."""
    held: list[tuple[NDArray[np.int64], Array, NDArray[np.int64]]] = []
    for block in blocks:
        held.append((block.t_utc_ns, columns(content, block), np.full(len(block.values), block.calibration)))
        if sum(len(times) for times, _, _ in held) >= rows:
            yield _joined(held)
            held = []
    if held:
        yield _joined(held)


def _joined(
    held: Sequence[tuple[NDArray[np.int64], Array, NDArray[np.int64]]],
) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
    times, values, numbers = zip(*held, strict=True)
    return np.concatenate(times), np.concatenate(values), np.concatenate(numbers)
