"""A Zenoh router in one process, for tests and small sites."""

from __future__ import annotations

import json
import re
from pathlib import Path

import zenoh

from agent.delivery.session import EndpointError, EndpointRefused, session_config

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
LARGEST_FILE = 1 << 20  # bytes; access rules for a thousand gateways have half of it
DEEPEST = 32  # Zenoh's reader of JSON5 overflows its stack, and ends the process, some thousand brackets deep
ANSWER_S = 0.5  # a router on the same machine answers within milliseconds


def router_running(endpoint: str) -> bool:
    """True if a Zenoh router answers at `endpoint`. Raises EndpointError where it is not an endpoint."""
    config = session_config("client", connect=[endpoint])
    config.insert_json5("connect/timeout_ms", json.dumps(int(ANSWER_S * 1000)))
    try:
        session = zenoh.open(config)
    except zenoh.ZError:
        return False
    try:
        return bool(session.info.routers_zid())
    finally:
        session.close()


def open_router(listen: str | None, config_file: Path | None = None) -> tuple[zenoh.Session, list[str]]:
    """A router and the endpoints it listens at, with the port that the system chose where `listen` says port 0.

    Without `listen` it is what the file says, or DEFAULT_ENDPOINT. Raises EndpointError naming the endpoint or file.
    """
    endpoint = listen or (None if config_file else DEFAULT_ENDPOINT)
    if config_file:
        config = _read_config(config_file)
        config.insert_json5("mode", '"router"')
        if endpoint:
            config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    else:
        config = session_config("router", listen=[endpoint or DEFAULT_ENDPOINT])
    config.insert_json5("adminspace/enabled", "true")  # it alone tells the real port
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        where = endpoint or str(config_file)
        taken = "Address already in use" in str(error)
        raise EndpointRefused(f"{where}: {'the port is taken' if taken else _first_line(error)}") from None
    for reply in session.get(f"@/{session.zid()}/router"):
        if reply.ok:
            return session, list(json.loads(reply.ok.payload.to_string())["locators"])
    return session, [endpoint] if endpoint else []


def _read_config(path: Path) -> zenoh.Config:
    """JSON5, whatever the file is called. Raises EndpointError naming the file."""
    try:
        with open(path, "rb") as file:
            text = file.read(LARGEST_FILE + 1).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise EndpointError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(text) > LARGEST_FILE:
        raise EndpointError(f"{path}: more than {LARGEST_FILE} bytes, no configuration")
    depth = deepest = 0
    for bracket in re.findall(r"[\[{}\]]", text):
        depth += 1 if bracket in "[{" else -1
        deepest = max(deepest, depth)
    if deepest > DEEPEST:
        raise EndpointError(f"{path}: brackets {deepest} deep, more than {DEEPEST}")
    try:
        return zenoh.Config.from_json5(text)
    except zenoh.ZError as error:
        raise EndpointError(f"{path}: {_first_line(error)}") from None


def _first_line(error: zenoh.ZError) -> str:
    # What follows " at /" is a place in Zenoh's own source.
    return str(error).splitlines()[0].split(" at /", 1)[0]
