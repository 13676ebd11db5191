"""Converts states that an older version of the program wrote, one version at a time.

A function `from_version_<n>` gets what `unpack` found in a state of version n (of a whole pipeline, or what is kept of
one device) and changes it to what version n + 1 writes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from calib.estimate.deviations import Deviations, LeftOpen
from calib.estimate.quantities import (
    ALPHA,
    ALPHA_BY_POSITION,
    DIRECTION,
    DIRECTION_BY_POSITION,
    GRAVITY,
    GRAVITY_DIRECTION,
    KINDS,
    LAG,
    LAG_OF_AXIS,
    MAIN_TEMPERATURE,
    OFFSET,
    OFFSET_BY_POSITION,
    OFFSET_RATE,
    OFFSET_TEMPERATURE,
    RATES,
    REFERENCE,
    ROTATION,
    SENSITIVITY,
    SENSITIVITY_TEMPERATURE,
    THETA,
    THETA_BY_POSITION,
    TRANSVERSE,
    Kind,
    Quantity,
    offset_temperature,
)
from calib.excitation.placing import SHORTEST_S
from calib.excitation.standing import USUAL
from calib.model import PARAMETERS


def _of_axes(name: str, kind: Kind) -> dict[str, Kind]:
    return {f"{name}_{axis}": kind for axis in "xyz"}


# Version 1 had names only. These are all names that an agent wrote, without the position in brackets that some have.
_VERSION_1: Mapping[str, Kind] = {
    **dict.fromkeys(PARAMETERS[:9], SENSITIVITY),
    **dict.fromkeys(PARAMETERS[9:], OFFSET),
    **dict.fromkeys(RATES, OFFSET_RATE),
    **dict.fromkeys(MAIN_TEMPERATURE, SENSITIVITY_TEMPERATURE),
    **dict.fromkeys((*offset_temperature(1), *offset_temperature(2)), OFFSET_TEMPERATURE),
    "theta": THETA,
    "alpha": ALPHA,
    "gravity": GRAVITY,
    "lag": LAG,
    "reference": REFERENCE,
    **_of_axes("direction", DIRECTION),
    **_of_axes("rotation", ROTATION),
    **_of_axes("reference", REFERENCE),
    **_of_axes("lag", LAG_OF_AXIS),
    **{f"transverse_{way}": TRANSVERSE for way in ("lateral", "vertical")},
    **{f"transverse_{way}_quadrature": TRANSVERSE for way in ("lateral", "vertical")},
}
_VERSION_1_BY_POSITION: Mapping[str, Kind] = {
    "theta": THETA_BY_POSITION,
    "alpha": ALPHA_BY_POSITION,
    "transverse_a": TRANSVERSE,
    "transverse_b": TRANSVERSE,
    **_of_axes("direction", DIRECTION_BY_POSITION),
    **_of_axes("gravity", GRAVITY_DIRECTION),
    **_of_axes("offset", OFFSET_BY_POSITION),
}


def from_version_1(state: dict[str, Any]) -> None:
    """Give each unknown its kind. Raises KeyError for a name that version 1 did not have.

    The summary of a window told which of its blocks is which window, a summary has one; noise is now by window. A
    stream had one clock, now each run between two restarts of a device has its own.
    """
    for channel in state.get("channels", {}).values():
        for stream in channel["streams"].values():
            run = {"clock": stream.pop("clock"), "blocks": stream.pop("blocks")}
            stream["runs"] = [run] if run["clock"] else []
    for estimation in _estimations(state):
        recursion = estimation["recursion"]
        for joint in (recursion["state"], recursion["base"]):
            joint["quantities"] = [_quantity_of_version_1(name) for name in joint.pop("names")]
        for summary in (*recursion["recent"], *estimation["held"]):
            for gone in ("block_window", "mean_omega2"):
                del summary["data"][gone]
            summary["data"]["type_a"]["noise"] = summary["data"]["type_a"]["noise"][None]


def _estimations(state: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The estimations of all channels of a pipeline, or the one of a device whose state was kept."""
    for holder in [state, *state.get("channels", {}).values()]:
        if holder.get("estimation"):
            yield holder["estimation"]


def _quantity_of_version_1(name: str) -> list[str]:
    """[name, kind, position] of a name such as "lag", "alpha[0]" or "transverse_a[0]_quadrature"."""
    stem, bracket, rest = name.partition("[")
    if not bracket:
        return [name, _VERSION_1[name].name, ""]
    return [name, _VERSION_1_BY_POSITION[stem].name, rest.rpartition("]")[0]]


def from_version_2(state: dict[str, Any]) -> None:
    """Give the unknowns of the reference its identity, and each unknown its prior.

    Version 2 kept the standard uncertainty of each prior and no mean: the estimate stands for the mean, and the
    configuration of this run for what was stated. The reference whose errors the state had is the one in the state.
    Positions were found with the usual smoothing alone, and runs of samples had no number.
    """
    for holder in [state, *state.get("channels", {}).values()]:
        if holder.get("estimation"):
            _own(holder["estimation"], holder.get("reference") or "")
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


def _own(estimation: dict[str, Any], reference: str) -> None:
    estimation |= {"proposed": [], "explain_s": None, "witnesses": []}
    estimation["lag_watches"] = [{"line": None, "unexplained": 0, "beyond": ""}]
    recursion = estimation["recursion"]
    bound = recursion.pop("bound")
    for joint in (recursion["state"], recursion["base"]):
        kinds = [KINDS[kind] for _, kind, _ in joint["quantities"]]
        joint["quantities"] = [
            [*quantity, reference if kind.of_reference else "", False]
            for quantity, kind in zip(joint["quantities"], kinds, strict=True)
        ]
        joint["stated_u"] = np.sqrt(bound) / np.where([kind.of_nuisance for kind in kinds], 2.0, 1.0)
        joint["stated_mean"] = np.full(len(kinds), np.nan)  # as stated now
        joint["walked"] = np.zeros(len(kinds))
        joint["doubt"] = 1.0
    for summary in (*recursion["recent"], *estimation["held"]):
        summary["reference"] = reference
    recursion["mounted"], recursion["sensitivity"] = [reference], [None]
    recursion["references"] = {reference: None} if recursion["windows"] else {}
    recursion["certified_day"] = None
    recursion.setdefault("fixed", True)
    recursion["stated"] = [{"mean": None, "u": recursion.pop("prior_u"), "priors": None}]
    if recursion["held"] is not None:
        by = recursion["held"]["by"]
        keys = {quantity[0]: Quantity(*_with_kind(quantity)).key for quantity in recursion["state"]["quantities"]}
        recursion["held"]["by"] = {keys[name]: moves for name, moves in by.items()}


def _with_kind(quantity: list[Any]) -> tuple[str, Kind, str, str]:
    name, kind, position, owner, _ = quantity
    return name, KINDS[kind], position, owner


def from_version_3(state: dict[str, Any]) -> None:
    """Version 3 knew no response over frequency: windows had no bands, and S was that of the whole motion. Its noise
    contained what a filter makes of white noise."""
    for estimation in _estimations(state):
        recursions = [estimation["recursion"], *(proposal["recursion"] for proposal in estimation["proposed"])]
        for recursion in recursions:
            recursion["over"] = {"motion_hz": None, "deviations": asdict(Deviations()), "first_hz": 0.0}
            if recursion["held"] is not None:
                recursion["held"]["steady"] = {}
            for newest in recursion["recent"][-1:]:
                for ratio in ("slopes", "means"):
                    recursion["noise"][ratio] *= newest["independent"]
        recent = (summary for recursion in recursions for summary in recursion["recent"])
        for summary in (*recent, *estimation["held"], *estimation["witnesses"]):
            summary |= {"response": [], "motion_hz": None}
            summary["data"]["bands"] = None
            for of in ("slopes", "means"):
                summary["data"]["type_a"][of] = summary["data"]["type_a"][of] * summary["independent"]


def from_version_4(state: dict[str, Any]) -> None:
    """Version 4 knew no attenuation at one frequency: motion of one frequency was taken to show both alike."""
    for estimation in _estimations(state):
        for holder in (estimation, *estimation["proposed"]):
            holder["recursion"]["over"]["late_s"] = None


def from_version_5(state: dict[str, Any]) -> None:
    """Version 5 knew no filters that drivers state, and kept a sensor by its identity alone."""
    for holder in [state, *state.get("channels", {}).values()]:
        holder |= {"filters": {}, "device": ""}


def from_version_6(state: dict[str, Any]) -> None:
    """Version 6 did not sum up what bands leave open; it counts from now on."""
    for estimation in _estimations(state):
        recursions = [estimation["recursion"], *(proposal["recursion"] for proposal in estimation["proposed"])]
        for recursion in recursions:
            recursion["over"]["left_open"] = asdict(LeftOpen())
        recent = (summary for recursion in recursions for summary in recursion["recent"])
        for summary in (*recent, *estimation["held"], *estimation["witnesses"]):
            if (bands := summary["data"]["bands"]) is not None:
                bands["left_open"] = asdict(LeftOpen())


MIGRATIONS: Mapping[int, Callable[[dict[str, Any]], None]] = {
    1: from_version_1,
    2: from_version_2,
    3: from_version_3,
    4: from_version_4,
    5: from_version_5,
    6: from_version_6,
}
