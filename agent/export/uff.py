"""Signals as data sets 58 of the Universal File Format (time response), written as text by pyuff.

Sources: Universal Dataset Number 58 (SDRC, 30-Jun-1999; University of Cincinnati, SDRL) and 164 (units); ladisk/pyuff.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from agent.config.whole_files import new_file
from agent.export.samples import ExportedSamples, ExportError, RecordedContent
from agent.export.tables import columns, names_of
from calib.model import Array

MOST_SAMPLES = 2_000_000  # of a set: pyuff makes the text of a set in memory, 100 bytes a sample
MOST_PARTS = 1000  # a hole in the samples begins another set of each signal
TIME_RESPONSE, EVEN, TIME = 1, 1, 17
UNKNOWN, DISPLACEMENT, VELOCITY, ACCELERATION = 0, 8, 11, 12
KINDS = {"m": DISPLACEMENT, "m/s": VELOCITY, "m/s2": ACCELERATION, "g": ACCELERATION}  # data types by unit
LABELS = {DISPLACEMENT: "Displacement", VELOCITY: "Velocity", ACCELERATION: "Acceleration", UNKNOWN: "Indication"}
SI = {"type": 164, "units_code": 1, "units_description": "SI", "temp_mode": 1, "length": 1.0, "force": 1.0,
      "temp": 1.0, "temp_offset": 0.0}  # fmt: skip
ID_CHARACTERS, ENTITY_CHARACTERS, LABEL_CHARACTERS = 80, 10, 20


@dataclass(frozen=True, slots=True, eq=False)
class _EvenSamples:
    """Samples without a hole: `values` (n, k) in a file, the first at `begin_ns`, one each `step_s` s."""

    begin_ns: int
    step_s: float
    missing: int  # samples that are lost before it
    values: Array


def write_uff(path: Path, content: RecordedContent, blocks: Iterable[ExportedSamples]) -> int:
    """Write a set of each signal, in each part without a lost sample; gives the number of samples.

    The first set states SI units. The times of a set are equally spaced and count in s from the first sample of the
    file, whose UTC is in its ID lines. An acceleration that is not known for a whole part is left out there and counted
    in `content.left_out`. Raises ExportError without pyuff, and for more than MOST_SAMPLES or MOST_PARTS; OSError.
    """
    try:
        import pyuff
    except ImportError:
        raise ExportError(f"{path}: UFF needs pyuff; install it with: fieldcal extras --install uff") from None
    rows, first_ns = 0, None
    with new_file(path) as file, TemporaryDirectory(dir=path.parent) as held:
        one = Path(held) / "set.uff"

        def put(data_set: dict[str, Any]) -> None:
            pyuff.UFF(str(one)).write_sets(data_set, "overwrite")  # a file of its own: pyuff reads what it has written
            with one.open("rb") as written:
                shutil.copyfileobj(written, file)

        put(dict(SI))
        for part in _parts(path, content, blocks, Path(held) / "values"):
            first_ns = part.begin_ns if first_ns is None else first_ns
            for k in range(part.values.shape[1]):
                signal = np.ascontiguousarray(part.values[:, k])
                if np.isfinite(signal).all():  # pyuff would write zeros
                    put(_set(content, k, part, part.begin_ns - first_ns) | {"data": signal})
                elif k == content.axes:
                    content.left_out["S has no inverse"] += len(signal)
            rows += len(part.values)
    return rows


def _parts(
    path: Path, content: RecordedContent, blocks: Iterable[ExportedSamples], held: Path
) -> Iterator[_EvenSamples]:
    """The parts in order; each is gathered in the file `held`, so that one signal at a time is in memory."""
    gathered: list[ExportedSamples] = []  # first and newest block of a part
    count = parts = missing = 0
    file = held.open("wb")
    try:
        for block in blocks:
            following = gathered[-1].first_index + len(gathered[-1].values) if gathered else block.first_index
            if block.first_index != following:
                file.close()
                yield _part(content, gathered, count, missing, held)
                missing, count, parts, gathered = block.first_index - following, 0, parts + 1, []
                file = held.open("wb")
            count += len(block.values)
            gathered = [*gathered[:1], block]
            if count > MOST_SAMPLES or parts >= MOST_PARTS:
                raise ExportError(
                    f"{path}: a UFF file has at most {MOST_SAMPLES} samples without a hole, and {MOST_PARTS} "
                    "parts with holes between them; export fewer recordings at once, or to .parquet"
                )
            file.write(columns(content, block).astype("<f8").tobytes())
        file.close()
        if gathered:
            yield _part(content, gathered, count, missing, held)
    finally:
        file.close()


def _part(
    content: RecordedContent, gathered: list[ExportedSamples], count: int, missing: int, held: Path
) -> _EvenSamples:
    begin_ns, end_ns = int(gathered[0].t_utc_ns[0]), int(gathered[-1].t_utc_ns[-1])
    step_s = (end_ns - begin_ns) * 1e-9 / (count - 1) if count > 1 else 1.0 / gathered[0].rate_hz
    values = np.memmap(held, "<f8", "r", shape=(count, len(names_of(content))))
    return _EvenSamples(begin_ns, step_s, missing, values)


def _set(content: RecordedContent, k: int, part: _EvenSamples, since_ns: int) -> dict[str, Any]:
    """The head of the set of a column; `since_ns`: begin of the part after that of the file."""
    axis, corrected = k % content.axes, k >= content.axes
    unit = "m/s2" if corrected else content.unit
    kind, begin = KINDS.get(unit, UNKNOWN), part.begin_ns
    date = datetime.fromtimestamp(begin // 10**9, UTC)
    newest = content.calibrations[-1] if corrected else None
    made = f"a = inv(S) (V - Q), calibration {newest.made[1]} of {newest.made[0]}" if newest else "indication"
    ids = (
        f"{content.device} {names_of(content)[k]}", made, f"{date:%d-%b-%y %H:%M:%S}".upper(),
        f"first sample {date:%Y-%m-%dT%H:%M:%S}.{begin % 10**9:09d} UTC, rate {1.0 / part.step_s:.10g} Hz",
        f"{part.missing} samples are missing before" if part.missing else "NONE",
    )  # fmt: skip
    begin_s = since_ns * 1e-9
    return {
        "type": 58, "binary": 0, **{f"id{n}": _text(line, ID_CHARACTERS) for n, line in enumerate(ids, 1)},
        "func_type": TIME_RESPONSE, "func_id": k + 1, "rsp_ent_name": _text(content.device, ENTITY_CHARACTERS),
        "rsp_node": 1, "rsp_dir": axis + 1 if content.axes == 3 else 0, "ref_node": 0, "ref_dir": 0,
        "abscissa_spacing": EVEN, "x": np.array([begin_s, begin_s + part.step_s]),
        "abscissa_spec_data_type": TIME, "abscissa_axis_lab": "Time", "abscissa_axis_units_lab": "s",
        "ordinate_spec_data_type": kind, "ordinate_len_unit_exp": int(kind != UNKNOWN),
        "ordinate_axis_lab": LABELS[kind], "ordinate_axis_units_lab": _text(unit, LABEL_CHARACTERS),
        "orddenom_spec_data_type": UNKNOWN,
    }  # fmt: skip


def _text(text: str, characters: int) -> str:
    """A text of a field: ASCII that can be printed, and as many characters as the field has."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)[:characters]
