"""The corrected stream of one sensor, for the live view: its newest block, its last minute, its spectrum."""

from __future__ import annotations

import asyncio
import json
import threading
import time
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
from agent.delivery.session import closed_in_time, session_config
from agent.monitor.spectrum import LastMinute, usable
from agent.recording.acceleration import decode_acceleration

STREAMS_MAX = 4  # pages that look at a stream at the same time
SAMPLES_MAX = 1000  # of a block; a plot has no more points
LARGEST_BLOCK = 1 << 20  # bytes; half a second at 4 kHz and three axes has 50 kB
LOOK_S = 0.1
MINUTE_EVERY_S = 2.0  # s between two messages with the last minute and its spectrum, of some 100 kB
LONGEST_S = 900.0  # s after which a stream ends; a person who still looks asks again
ALIVE_S = 10.0  # s without a block after which a comment keeps the connection


class Live:
    """Streams of blocks, each with a Zenoh session of its own that ends with the page, or when `stopping` is set.

    `streams`: how many there are now.
    """

    def __init__(self, endpoints: Sequence[str], tls: TlsFiles | None, stopping: threading.Event) -> None:
        self._stopping = stopping
        self._config = session_config("client", connect=endpoints, tls=tls)
        self.streams = 0

    async def stream(self, request: Request) -> Response:
        """Server-sent events: blocks as JSON with `t_utc_ns`, `rate_hz`, `acceleration` and `calibration_sequence`.

        With `minute=1` also events `minute`, each MINUTE_EVERY_S, as agent.monitor.spectrum.LastMinute tells them. The
        event `end` comes after LONGEST_S.
        """
        names = [request.query_params.get(name, "") for name in ("site", "gateway", "sensor")]
        if not all(map(CHUNK.fullmatch, names)):
            raise HTTPException(400, "not a sensor")
        if self.streams >= STREAMS_MAX:
            raise HTTPException(503, "too many pages show a live waveform")
        key = f"{gateway_key(*names[:2])}/{names[2]}/acceleration"
        return StreamingResponse(
            self._blocks(key, request.query_params.get("minute") == "1"), 200, None, "text/event-stream"
        )

    async def _blocks(self, key: str, with_minute: bool) -> AsyncIterator[str]:
        if self.streams >= STREAMS_MAX:
            return  # many came at the same moment; a page asks again
        self.streams += 1
        try:
            session = await anyio.to_thread.run_sync(zenoh.open, self._config)
            with closed_in_time(session, within_s=0.0):  # all other pages would wait for it
                subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(2))
                begun_s = heard_s = told_s = time.monotonic()
                minute, fresh = LastMinute(), False
                while not self._stopping.is_set():
                    sample, now_s = subscriber.try_recv(), time.monotonic()
                    if now_s - begun_s > LONGEST_S:
                        yield "event: end\ndata: 0\n\n"
                        return
                    if sample is not None and (block := _block(sample.payload.to_bytes())) is not None:
                        heard_s = now_s
                        yield f"data: {_json(block)}\n\n"
                        minute.add(block)
                        fresh = with_minute
                    elif now_s - heard_s >= ALIVE_S:
                        heard_s = now_s
                        yield ": no block\n\n"
                    if fresh and now_s - told_s >= MINUTE_EVERY_S:
                        fresh, told_s = False, now_s
                        told = await anyio.to_thread.run_sync(minute.as_object)
                        yield f"event: minute\ndata: {json.dumps(told, allow_nan=False)}\n\n"
                    await asyncio.sleep(LOOK_S)
        except zenoh.ZError:
            return  # no router; the page asks again
        finally:
            self.streams -= 1


def _block(data: bytes) -> Acceleration | None:
    """A block with numbers that can be computed with; None for all else."""
    try:
        block = decode_acceleration(data)[1] if len(data) <= LARGEST_BLOCK else None
    except (DecodeError, ValueError):
        return None
    return block if block is not None and usable(block) else None


def _json(block: Acceleration) -> str:
    told = {
        "t_utc_ns": block.t_utc_ns,
        "rate_hz": block.rate_hz,
        "acceleration": block.acceleration[-SAMPLES_MAX:].round(6).tolist(),
        "calibration_sequence": block.calibration_sequence,
    }
    return json.dumps(told, allow_nan=False)
