"""Snapshots of versions before 9: until 7 a recursion held S and Q, records of version 8 hold less.

The calibration in force is left of an estimation, from which the estimate begins as after a rollback. Samples, clocks,
positions, devices and the numbering of the results go on. From version 9 on a snapshot holds records and statements,
which a changed estimator solves anew.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from calib.excitation.placing import SHORTEST_S
from calib.excitation.standing import USUAL


def brought_up(version: int, state: dict[str, Any]) -> None:
    """Change what a pipeline of this version wrote, or what it kept of a device, to what version 9 writes.

    Raises KeyError or TypeError where a part is missing.
    """
    for older in range(version, 9):
        if older in CHANGES:
            CHANGES[older](state)
    for holder in [state, *state.get("channels", {}).values()]:
        held = holder.get("estimation")
        if held and held.get("state", True) is not None:
            day = held["recursion"]["day"] if version < 8 else held["state"]["now"]["day"]
            holder["estimation"] = {
                "state": None, "day": day, "gate": held["gate"], "in_force": held["in_force"],
            }  # fmt: skip


def _from_version_1(state: dict[str, Any]) -> None:
    """A stream had one clock; later each run between two restarts of a device has its own."""
    for channel in state.get("channels", {}).values():
        for stream in channel["streams"].values():
            run = {"clock": stream.pop("clock"), "blocks": stream.pop("blocks")}
            stream["runs"] = [run] if run["clock"] else []


def _from_version_2(state: dict[str, Any]) -> None:
    """Positions were found with the usual smoothing alone, runs of samples had no number, and there was one
    reference."""
    for channel in state.get("channels", {}).values():
        channel["run_numbers"], channel["piece_number"] = {}, 0
        channel["references"], channel["not_certified"] = [channel.pop("reference")], [channel["not_certified"]]
        for stream in channel["streams"].values():
            for run in stream["runs"]:
                run["number"] = 0
        if "standing" in channel["places"]:
            channel["places"]["standing"]["longest"] = USUAL
            for stretch in channel["places"]["stretches"]:
                stretch["smoothing_s"] = SHORTEST_S


def _from_version_5(state: dict[str, Any]) -> None:
    """Drivers stated no filters, and a sensor was kept by its identity alone."""
    for holder in [state, *state.get("channels", {}).values()]:
        holder |= {"filters": {}, "device": ""}


def _from_version_8(state: dict[str, Any]) -> None:
    """Nobody watched the blocks as they came."""
    for channel in state.get("channels", {}).values():
        channel["raw"] = {"outputs": {}, "faults": {}, "told_s": {}, "seen": {}}


CHANGES: Mapping[int, Callable[[dict[str, Any]], None]] = {
    1: _from_version_1,
    2: _from_version_2,
    5: _from_version_5,
    8: _from_version_8,
}
