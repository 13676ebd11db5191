"""What a Raspberry Shake sends to a UDP port of this computer: channels and rate, from some seconds of datagrams."""

from __future__ import annotations

import contextlib
import select
import socket
import time
from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from agent.setup.listening import LISTEN_S, nominal_hz
from hw import shake_datagram
from hw.sensor import DeviceError
from hw.shake_udp import LONGEST_BYTES, QUANTITIES, SILENT_S, ShakeUdpOptions, receiver

AXES = "ENZ"  # x, y, z: east, north, up


@dataclass(frozen=True, slots=True)
class HeardShake:
    """The channels that came, of any instrument; the rate (Hz) as counted and as it is probably meant."""

    came: tuple[str, ...]
    counted_hz: float
    nominal_hz: float

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels of the one instrument with three axes, or the only channel; () where that is not clear."""
        usable = [channel for channel in self.came if channel[:2] in QUANTITIES]
        whole = [axes for kind in QUANTITIES if set(axes := tuple(kind + axis for axis in AXES)) <= set(usable)]
        if whole:
            return whole[0] if len(whole) == 1 else ()
        return tuple(usable) if len(usable) == 1 else ()


def hear_shake(options: ShakeUdpOptions) -> HeardShake | str:
    """Listen at the port of these options, whatever their channels are. Where no Shake is heard: why."""
    where = f"UDP port {options.port} of {options.listen}"
    try:
        with receiver(options.listen, options.port, where) as port:
            sent, others = _collect(port, options.source)
    except DeviceError as error:
        return str(error)
    except OSError as error:
        return f"{where}: {error.strerror}"
    senders = {sender for sender, _ in sent}
    if len(senders) > 1:
        return f"{where}: datagrams of {', '.join(sorted(senders))} came; state source"
    steps = [step for starts in sent.values() for step in _rates_hz(starts)]
    if not steps:
        besides = f"; what came from {', '.join(sorted(others))} is not used" if others else ""
        return (
            f"{where}: no datagrams of a Raspberry Shake came within {SILENT_S:g} s{besides}; state this computer and "
            "this port on the Shake's page and open the port in the firewall, or state the option channels"
        )
    counted_hz = float(np.median(steps))
    return HeardShake(tuple(sorted(channel for _, channel in sent)), counted_hz, nominal_hz(counted_hz))


def _collect(port: socket.socket, source: str) -> tuple[dict[tuple[str, str], list[tuple[int, int]]], Collection[str]]:
    """Start (UTC, ns) and number of samples of each datagram, by sender and channel; and who sent something else."""
    sent: dict[tuple[str, str], list[tuple[int, int]]] = {}
    others: set[str] = set()
    end_s = time.monotonic() + SILENT_S
    while (left_s := end_s - time.monotonic()) > 0 and select.select([port], [], [], left_s)[0]:
        with contextlib.suppress(BlockingIOError, shake_datagram.DatagramError):
            data, (sender, *_) = port.recvfrom(LONGEST_BYTES)
            others.add(sender)
            if source not in ("", sender):
                continue
            datagram = shake_datagram.decode(data)
            if not sent:
                end_s = time.monotonic() + LISTEN_S
            sent.setdefault((sender, datagram.channel), []).append((datagram.start_ns, len(datagram.samples)))
    return sent, others


def _rates_hz(starts: list[tuple[int, int]]) -> list[float]:
    """By each datagram and the next one of its channel. One that is lost between them makes one of these too low."""
    return [n * 1e9 / (after_ns - start_ns) for (start_ns, n), (after_ns, _) in pairwise(starts) if after_ns > start_ns]
