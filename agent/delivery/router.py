"""A Zenoh router in one process, for tests and small sites."""

from __future__ import annotations

import json
import re
from pathlib import Path

import zenoh

from agent.config.files import read_file
from agent.delivery.session import EndpointError, EndpointRefused, check_private_key, closed_in_time, session_config

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
LARGEST_FILE = 1 << 20  # bytes; access rules for a thousand gateways take half of this
DEEPEST = 32  # nested brackets; at some thousand, Zenoh's JSON5 reader overflows its stack and ends the process
ANSWER_S = 0.5  # s; a router on the same machine answers within milliseconds


def router_running(endpoint: str) -> bool:
    """True if a Zenoh router answers at `endpoint`. Raises EndpointError where `endpoint` is not a valid endpoint."""
    config = session_config("client", connect=[endpoint])
    config.insert_json5("connect/timeout_ms", json.dumps(int(ANSWER_S * 1000)))
    try:
        with closed_in_time(zenoh.open(config)) as session:
            return bool(session.info.routers_zid())
    except zenoh.ZError:
        return False


def open_router(listen: str | None, config_file: Path | None = None) -> tuple[zenoh.Session, list[str]]:
    """Open a router; returns its session and the endpoints at which it listens.

    `listen`: endpoint; with port 0 the system chooses a port, which the result names. None: the endpoints in
    `config_file`, or DEFAULT_ENDPOINT without a file. Raises EndpointError, which names the endpoint or the file.
    """
    endpoint = listen or (None if config_file else DEFAULT_ENDPOINT)
    if config_file:
        config = _read_config(config_file)
        config.insert_json5("mode", '"router"')
        if endpoint:
            config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    else:
        config = session_config("router", listen=[endpoint or DEFAULT_ENDPOINT])
    config.insert_json5("adminspace/enabled", "true")  # only the admin space tells the port that was chosen
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        where = endpoint or str(config_file)
        taken = "Address already in use" in str(error)
        raise EndpointRefused(f"{where}: {'another program uses this port' if taken else _first_line(error)}") from None
    for reply in session.get(f"@/{session.zid()}/router"):
        if reply.ok:
            return session, list(json.loads(reply.ok.payload.to_string())["locators"])
    return session, [endpoint] if endpoint else []


def _read_config(path: Path) -> zenoh.Config:
    """Read a file as JSON5, whatever its name ends with. Raises EndpointError, which names the file."""
    try:
        text = read_file(path, LARGEST_FILE).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise EndpointError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    depth = deepest = 0
    for bracket in re.findall(r"[\[{}\]]", text):
        depth += 1 if bracket in "[{" else -1
        deepest = max(deepest, depth)
    if deepest > DEEPEST:
        raise EndpointError(f"{path}: brackets {deepest} deep, more than the limit of {DEEPEST}")
    try:
        config = zenoh.Config.from_json5(text)
        keys = [json.loads(config.get_json(f"transport/link/tls/{side}_private_key")) for side in ("listen", "connect")]
    except zenoh.ZError as error:
        raise EndpointError(f"{path}: {_first_line(error)}") from None
    for key in keys:
        if key is not None:
            check_private_key(Path(key))
    return config


def _first_line(error: zenoh.ZError) -> str:
    # Zenoh appends " at /" and a line of its own source code, which does not help the reader.
    return str(error).splitlines()[0].split(" at /", 1)[0]
