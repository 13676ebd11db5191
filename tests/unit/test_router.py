"""`fieldcal router` as a process, and whether one is there."""

from __future__ import annotations

import json
import resource
import signal
import socket
import time
from pathlib import Path
from typing import Any

import pytest
import zenoh

from agent.delivery import session
from agent.delivery.router import open_router, router_running
from agent.delivery.session import EndpointError, session_config
from tests.unit.zenoh_site import Site, router_process, wait_for

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_it_says_its_real_endpoint_and_ends_at_a_signal(ending: signal.Signals) -> None:
    router = router_process("--listen", "tcp/127.0.0.1:0")
    assert router.stdout is not None
    endpoint = router.stdout.readline().removeprefix("router at ").strip()
    assert endpoint.startswith("tcp/127.0.0.1:")
    assert router_running(endpoint)
    router.send_signal(ending)
    _, faults = router.communicate(timeout=60)
    assert (router.returncode, faults) == (0, "")
    assert not router_running(endpoint)


def test_it_ends_while_somebody_has_connected_and_says_nothing() -> None:
    """Zenoh itself would close in 10 s, and with an error."""
    router = router_process("--listen", "tcp/127.0.0.1:0")
    assert router.stdout is not None
    port = int(router.stdout.readline().rsplit(":", 1)[1])
    with socket.create_connection(("127.0.0.1", port)):
        begin = time.monotonic()
        router.send_signal(signal.SIGTERM)
        _, faults = router.communicate(timeout=60)
    assert time.monotonic() - begin < 9.0  # 1.0 s on a quiet machine
    assert (router.returncode, faults) == (0, "")


def test_it_may_open_as_many_files_as_the_system_allows() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    try:
        router = router_process("--listen", "tcp/127.0.0.1:0")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    try:
        assert router.stdout is not None
        router.stdout.readline()
        assert resource.prlimit(router.pid, resource.RLIMIT_NOFILE) == (hard, hard)
    finally:
        router.kill()
        router.communicate()


def test_a_thousand_gateways_and_more_may_connect(monkeypatch: pytest.MonkeyPatch) -> None:
    """The numbers in the router without a file and in the example of one; with a small number, that it counts."""
    example = ROOT / "deploy" / "zenoh" / "router.json5"
    for config in (session_config("router"), zenoh.Config.from_json5(example.read_text())):
        assert int(config.get_json("transport/unicast/max_sessions")) == 10_000
        assert int(config.get_json("transport/unicast/accept_pending")) == 1000
        assert int(config.get_json("transport/unicast/accept_timeout")) == 30_000
    monkeypatch.setattr(session, "ROUTER_SESSIONS", 2)
    site = Site()
    with site.client(), site.client():
        assert not router_running(site.endpoint), "a third client is refused"
    wait_for(lambda: router_running(site.endpoint))
    site.kill()


def test_a_taken_port_is_one_clear_line_and_status_1() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        router = router_process("--listen", endpoint)
        said, faults = router.communicate(timeout=60)
        assert router.returncode == 1
        assert (said, faults) == ("", f"fieldcal router: {endpoint}: another program uses this port\n")
        assert not router_running(endpoint), "what listens there is no router"


def test_a_router_that_is_there_is_found() -> None:
    site = Site()
    assert router_running(site.endpoint)
    with pytest.raises(EndpointError, match="another program uses this port"):
        open_router(site.endpoint)
    site.kill()


def test_a_configuration_file_is_used_and_its_faults_are_one_line(tmp_path: Path) -> None:
    good = tmp_path / "router.json5"
    good.write_text('{listen: {endpoints: ["tcp/127.0.0.1:0"]}, scouting: {multicast: {enabled: false}}}')
    opened, (endpoint,) = open_router(None, good)
    assert router_running(endpoint)
    opened.close()
    for text in ("{listen: 5}", "{nonsense: true}", "{", "{listen: {endpoints: ['nowhere']}}"):
        good.write_text(text)
        with pytest.raises(EndpointError, match=r"router\.json5: .+") as caught:
            open_router(None, good)
        assert "\n" not in str(caught.value)


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{listen: " + "[" * 100_000 + "]" * 100_000 + "}", "brackets 100001 deep"),
        ("{a:" * 100_000 + "1" + "}" * 100_000, "brackets 100000 deep"),
        ('{mode: "' + "x" * (1 << 20) + '"}', "more than 1048576 bytes"),
        ("{a: " + "9" * 100_000 + "}", "unknown field"),
        ("{" + "a: 1," * 100_000 + "}", "unknown field"),
    ],
)
def test_a_file_that_would_end_the_process_is_one_clear_line(tmp_path: Path, text: str, said: str) -> None:
    """Zenoh's own reader overflows its stack on the first two: each runs in a process of its own."""
    file = tmp_path / "router.json5"
    file.write_text(text)
    router = router_process("--config", str(file))
    _, faults = router.communicate(timeout=60)
    assert (router.returncode, faults.count("\n")) == (2, 1)
    assert said in faults


@pytest.mark.parametrize("endpoint", ["7447", "tcp/127.0.0.1:99999", "pigeon/1:2"])
def test_a_bad_endpoint_is_named(endpoint: str) -> None:
    with pytest.raises(EndpointError, match=endpoint):
        open_router(endpoint)


@pytest.mark.parametrize("arguments", [("--listen", "7447"), ("--config", "/dev/null")])
def test_what_is_no_endpoint_or_configuration_is_status_2(arguments: tuple[str, str]) -> None:
    router = router_process(*arguments)
    said, faults = router.communicate(timeout=60)
    assert (router.returncode, said, faults.count("\n")) == (2, "", 1)


def test_sessions_of_many_gateways_do_not_try_again_at_the_same_moment() -> None:
    """Each draws its first wait, and waits 10 s at most; a session of which there is one only keeps Zenoh's own."""

    def retry(**more: Any) -> Any:
        return json.loads(session_config("client", connect=["tcp/127.0.0.1:1"], **more).get_json("connect/retry"))

    first_ms = [retry(one_of_many=True)["period_init_ms"] for _ in range(100)]
    assert min(first_ms) >= 500
    assert max(first_ms) <= 1500
    assert len(set(first_ms)) > 50
    assert retry(one_of_many=True)["period_max_ms"] == 10_000
    assert retry() == json.loads(zenoh.Config().get_json("connect/retry"))
