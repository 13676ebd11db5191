"""Forgeries without signatures, for an auditor who has neither key nor head."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from agent.proto import fieldcal_pb2 as pb
from benchmarks.attacks.fields import engine_names
from benchmarks.attacks.site import Attack, Site, files
from benchmarks.mutations import bare
from tests.replay.forgery import Unpacked

DAY_NS = 86_400_000_000_000


def unsigned(change: Attack) -> Attack:
    """The forger takes away everything signed, and makes the chain right."""

    def attack(data: Path, site: Site, place: int) -> None:
        change(data, site, place)
        bare(data)

    return attack


def in_all(data: Path, engine: str, change: Callable[[str, Any], object]) -> None:
    """Name an engine in all first events and results, and change results."""
    for path in files(data):
        found = Unpacked.of(path)
        for index, (topic, schema, *rest, content) in enumerate(found.messages):
            what = schema.rpartition(".")[2]
            message = getattr(pb, what).FromString(content)
            if what == "RawBlock" or (what == "Event" and not message.HasField("run_start")):
                continue
            (message.run_start if what == "Event" else message).engine = engine
            change(what, message)
            found.messages[index] = (topic, schema, *rest, message.SerializeToString(deterministic=True))
        found.write(path)


def forged_results(data: Path, _: Site, place: int) -> None:
    """S 3 % off with U a hundred times as large in all calibrations, by an engine that is known, unknown, or none."""

    def change(what: str, message: Any) -> None:
        for name in ("sxx", "syy", "szz") if what == "Calibration" else ():
            setattr(message, name, getattr(message, name) * 1.03)
            setattr(message, f"u_{name}", getattr(message, f"u_{name}") * 100)

    in_all(data, engine_names()[place], change)


def forged_field(data: Path, _: Site, place: int) -> None:
    """One field of all results of a kind, by an engine that is known."""
    what, name, forged = (
        ("Calibration", "sxx", lambda s: s * 1.0005),
        ("Calibration", "u_sxx", lambda u: u * 1.2),
        ("Calibration", "qx", lambda q: q + 0.01),
        ("Calibration", "t_utc_ns", lambda t: t + DAY_NS),
        ("Calibration", "windows", lambda n: n + 5),
        ("Calibration", "output_unit", lambda _: "mV"),
        ("Calibration", "identity", lambda _: "ADXL355 1"),
        ("Window", "used", lambda used: not used),
        ("Window", "t_utc_ns", lambda t: t + DAY_NS),
        ("Status", "status", lambda _: "DRIFT"),
    )[place]  # fmt: skip

    def change(of: str, message: Any) -> None:
        if of == what:
            setattr(message, name, forged(getattr(message, name)))

    in_all(data, engine_names()[0], change)
