"""A snapshot from which the estimation begins anew, with the priors of another configuration."""

from __future__ import annotations

from agent.config import Config
from agent.core.driver_filters import DriverFilters
from agent.core.estimation import Estimation
from agent.core.references import References
from agent.core.snapshot import pack, unpack


def anew(config: Config, snapshot: bytes) -> bytes:
    """The snapshot without what was learnt of S and Q: each channel begins with the priors that `config` states.

    Samples, clocks, positions, devices and the numbering of the results stay. What was learnt under other settings
    cannot stay: S that a reference with another sensitivity gave is another S.
    Raises ValueError where the bytes are no snapshot, KeyError where they are one of other channels.
    """
    state = unpack(snapshot)
    for channel in config.channels:
        held = state["channels"][channel.sensor]
        if held["estimation"] is not None:
            filters, references = DriverFilters(channel), References(channel)
            filters.load(held["filters"])
            references.load(held)
            estimation = Estimation(filters.channel, held["nominal"])
            references.meet(estimation)
            held["estimation"] = estimation.snapshot()
            held["status"] = "INVALID" if held["status"] == "INVALID" else estimation.gate.status
        held |= {"in_force": None, "kept": {}, "first_day": 0.0, "refused": 0}
    return pack(state)
