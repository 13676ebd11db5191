"""The corrected stream of one sensor, for the live waveform of the page."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import AsyncIterator, Sequence

import anyio
import zenoh
from google.protobuf.message import DecodeError
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from agent.config.tls import TlsFiles
from agent.core.events import Acceleration
from agent.delivery.keys import CHUNK, gateway_key
from agent.delivery.session import session_config
from agent.recording.acceleration import decode_acceleration

STREAMS_MAX = 4  # pages that look at a stream at the same time
SAMPLES_MAX = 1000  # of a block; a plot has no more points
LARGEST_BLOCK = 1 << 20  # bytes; half a second at 4 kHz and three axes has 50 kB
LOOK_S = 0.1
ALIVE_S = 10.0  # s without a block after which a comment keeps the connection


class Live:
    """Streams of blocks, each with a Zenoh session of its own that ends with the page, or when `stopping` is set."""

    def __init__(self, endpoints: Sequence[str], tls: TlsFiles | None, stopping: threading.Event) -> None:
        self._stopping = stopping
        self._config = session_config("client", connect=endpoints, tls=tls)
        self._streams = 0

    async def stream(self, request: Request) -> Response:
        """Server-sent events: blocks as JSON with `t_utc_ns`, `rate_hz`, `acceleration` and `calibration_sequence`."""
        names = [request.query_params.get(name, "") for name in ("site", "gateway", "sensor")]
        if not all(map(CHUNK.fullmatch, names)):
            raise HTTPException(400, "not a sensor")
        if self._streams >= STREAMS_MAX:
            raise HTTPException(503, "too many pages show a live waveform")
        key = f"{gateway_key(*names[:2])}/{names[2]}/acceleration"
        return StreamingResponse(self._blocks(key), 200, None, "text/event-stream")

    async def _blocks(self, key: str) -> AsyncIterator[str]:
        if self._streams >= STREAMS_MAX:
            return  # many came at the same moment; a page asks again
        self._streams += 1
        try:
            with await anyio.to_thread.run_sync(zenoh.open, self._config) as session:
                subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(2))
                silent_s = 0.0
                while not self._stopping.is_set():
                    sample = subscriber.try_recv()
                    if sample is not None and (told := _told(sample.payload.to_bytes())):
                        silent_s = 0.0
                        yield f"data: {told}\n\n"
                    elif silent_s >= ALIVE_S:
                        silent_s = 0.0
                        yield ": no block\n\n"
                    silent_s += LOOK_S
                    await asyncio.sleep(LOOK_S)
        except zenoh.ZError:
            return  # no router; the page asks again
        finally:
            self._streams -= 1


def _told(data: bytes) -> str:
    """A block as JSON; "" for what is no block."""
    try:
        block = decode_acceleration(data)[1] if len(data) <= LARGEST_BLOCK else None
        return _json(block) if block is not None else ""
    except (DecodeError, ValueError):
        return ""


def _json(block: Acceleration) -> str:
    told = {
        "t_utc_ns": block.t_utc_ns,
        "rate_hz": block.rate_hz,
        "acceleration": block.acceleration[-SAMPLES_MAX:].round(6).tolist(),
        "calibration_sequence": block.calibration_sequence,
    }
    return json.dumps(told, allow_nan=False)
