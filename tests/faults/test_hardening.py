"""The agent works under the limits of its systemd unit, and the limits are effective. systemd itself is not started."""

from __future__ import annotations

import ctypes.util
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh
from numpy.typing import NDArray

from agent.delivery.router import open_router
from agent.delivery.session import session_config
from hw.virtual.serial_port import PtyDevice, SampleLines
from tests.scenarios.processes import ROOT, results, wait_until

UNIT = ROOT / "deploy" / "fieldcal.service"
NOBODY = 65534
LIBRARIES = """
import os
os.environ["OPENBLAS_NUM_THREADS"] = "1"
import numpy, scipy.linalg, scipy.optimize, scipy.signal, zenoh, prometheus_client, sqlite3, mcap.writer, smbus2, serial
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
a = numpy.random.default_rng(1).normal(size=(300, 300))
assert numpy.allclose(a @ scipy.linalg.inv(a), numpy.eye(300))
assert numpy.allclose(numpy.linalg.lstsq(a, a)[0], numpy.eye(300))
Ed25519PrivateKey.generate().sign(b"")
config = zenoh.Config()
config.insert_json5("scouting/multicast/enabled", "false")
zenoh.open(config).close()
print("all of it works")
"""
NEW_NAMESPACE = """
import ctypes
libc = ctypes.CDLL(None, use_errno=True)
if libc.unshare(0x10000000):
    raise OSError(ctypes.get_errno(), "unshare")
"""
# What an ideal sensor reads in six rests.
RESTS = [[sign * 9.81 if axis == i else 0.0 for i in range(3)] for axis in range(3) for sign in (1, -1)]
REST_S = 3
SENSITIVITY = np.array([[1.01, 0.02, 0.0], [0.0, 0.98, -0.01], [0.03, 0.0, 1.02]])
OFFSET = np.array([0.1, -0.2, 0.3])
RATE_HZ = 100
CONFIG = """
[[devices]]
name = "imu"
driver = "serial-csv"
options = {{ port = "{port}", rate_hz = {rate_hz}, axes = 3, sequence = true, unit = "m/s2" }}
[[channels]]
sensor = "imu"
prior = {{}}
guard_s = 0.2
poses = [{poses}]
poses_repeat_s = {period_s}
[zenoh]
connect = ["{endpoint}"]
[supervision.metrics]
enabled = true
port = {metrics_port}
"""

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(os.geteuid() != 0, reason="limits are taken on by root"),
    pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze names the system calls"),
    pytest.mark.skipif(ctypes.util.find_library("seccomp") is None, reason="libseccomp.so.2 is not installed"),
]


@pytest.fixture
def data_dir() -> Iterator[Path]:
    # Not pytest's temporary directory, which only its owner may enter.
    directory = Path(tempfile.mkdtemp(prefix="fieldcal-", dir="/var/tmp"))
    os.chown(directory, NOBODY, NOBODY)
    yield directory
    shutil.rmtree(directory)


def limited(data_dir: Path, *command: str) -> list[str]:
    launcher = [sys.executable, str(ROOT / "tests" / "faults" / "limits.py")]
    return [*launcher, str(UNIT), str(data_dir), str(NOBODY), "--", *command]


def python(data_dir: Path, program: str) -> subprocess.CompletedProcess[str]:
    command = limited(data_dir, sys.executable, "-c", program)
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)


@pytest.fixture(scope="module", autouse=True)
def namespaces() -> None:
    tried = subprocess.run(["unshare", "--mount", "true"], capture_output=True, text=True, check=False)
    if tried.returncode:
        pytest.skip(f"no mount namespace for this root: {tried.stderr.strip()}")


REFUSED = [  # what an intruder would try, and what it ends with
    ("import mmap; mmap.mmap(-1, 4096, prot=mmap.PROT_WRITE | mmap.PROT_EXEC)", "PermissionError"),
    (f"open({str(ROOT / 'written')!r}, 'w')", "Read-only file system"),
    ("open('/etc/written', 'w')", "Read-only file system"),
    ("import os; os.setuid(0)", "Operation not permitted"),
    ("import os; os.sched_setaffinity(0, {0})", "Operation not permitted"),
    ("import os; os.kill(1, 0)", "Operation not permitted"),
    ("import os; os.stat('/proc/1')", "No such file"),
    ("import socket; socket.socket(socket.AF_PACKET, socket.SOCK_RAW)", "Address family not supported"),
    (NEW_NAMESPACE, "PermissionError"),
    ("import os, pwd; print(os.listdir('/home'), os.listdir(pwd.getpwuid(0).pw_dir + '/.ssh'))", "No such file"),
]  # fmt: skip
TRIES = """
import json
said = []
for attempt in json.loads({attempts!r}):
    try:
        exec(attempt, {{}})
        said.append("it was done")
    except BaseException as error:
        said.append(f"{{type(error).__name__}}: {{error}}")
print(json.dumps(said))
"""


def test_the_limits_are_there(data_dir: Path) -> None:
    ended = python(data_dir, TRIES.format(attempts=json.dumps([attempt for attempt, _ in REFUSED])))
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    assert len(told) == len(REFUSED)
    assert [
        (attempt, said) for (attempt, refused), said in zip(REFUSED, told, strict=True) if refused not in said
    ] == []


def test_the_data_directory_can_be_written(data_dir: Path) -> None:
    assert python(data_dir, f"open({str(data_dir / 'x')!r}, 'w')").stderr == ""


@pytest.mark.thorough
def test_numpy_scipy_zenoh_and_cryptography_start(data_dir: Path) -> None:
    ended = python(data_dir, LIBRARIES)
    assert (ended.stdout, ended.returncode) == ("all of it works\n", 0), ended.stderr


@pytest.fixture
def port(data_dir: Path) -> Iterator[PtyDevice]:
    noise = np.random.default_rng(1)
    began_s: float | None = None

    def values(first: int, n: int) -> NDArray[np.float64]:
        rests = np.array(RESTS)[np.arange(first, first + n) // (REST_S * RATE_HZ) % len(RESTS)]
        return np.asarray(rests @ SENSITIVITY.T + OFFSET + noise.normal(0, 0.01, (n, 3)))

    def samples_due(t_s: float) -> int:
        nonlocal began_s
        if began_s is None and device.has_reader():
            began_s = t_s  # the times of the poses count from the first sample that is read
        return 0 if began_s is None else int((t_s - began_s) * RATE_HZ)

    device = PtyDevice(SampleLines(values, samples_due), link=data_dir / "port")
    device.start()
    os.chown(device.path.resolve(), NOBODY, NOBODY)  # stands for a group whose members may use the port
    yield device
    device.stop()


def free_port() -> int:
    with socket.socket() as asked:
        asked.bind(("127.0.0.1", 0))
        return int(asked.getsockname()[1])


def configuration(port: Path, endpoint: str, metrics_port: int) -> str:
    poses = [
        f"{{ start_s = {REST_S * k}, stop_s = {REST_S * (k + 1)}, gravity_mps2 = {rest} }}"
        for k, rest in enumerate(RESTS)
    ]
    return CONFIG.format(
        port=port, rate_hz=RATE_HZ, poses=", ".join(poses), period_s=REST_S * len(RESTS), endpoint=endpoint,
        metrics_port=metrics_port,
    )  # fmt: skip


class Systemd:
    """Receives notifications as systemd does: without delay, since ten fill the queue of a socket."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.setblocking(False)
        os.chown(path, NOBODY, NOBODY)
        self.environment = {"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": "4000000"}
        self._told: set[str] = set()

    def close(self) -> None:
        self._socket.close()

    def told(self) -> set[str]:
        while True:
            try:
                self._told.add(self._socket.recv(4096).decode())
            except BlockingIOError:
                return self._told


@pytest.fixture
def systemd(data_dir: Path) -> Iterator[Systemd]:
    systemd = Systemd(data_dir / "notify")
    yield systemd
    systemd.close()


def test_the_agent_calibrates_publishes_and_records(data_dir: Path, port: PtyDevice, systemd: Systemd) -> None:
    router, (endpoint,) = open_router("tcp/127.0.0.1:0")
    metrics_port, config, data, log = free_port(), data_dir / "gateway.toml", data_dir / "data", data_dir / "log"
    config.write_text(configuration(port.path, endpoint, metrics_port))
    command = limited(data_dir, sys.executable, "-m", "agent", "run", str(config), "--data-dir", str(data))
    with open(log, "wb") as stderr, zenoh.open(session_config("client", connect=[endpoint])) as client:
        subscriber = client.declare_subscriber("fieldcal/v1/*/*/*/calibration", zenoh.handlers.RingChannel(10))
        environment = os.environ | systemd.environment
        agent = subprocess.Popen([*command, "--log", "json"], cwd=ROOT, stderr=stderr, env=environment)
        try:
            wait_until(lambda: systemd.told() and (agent.poll() or results(data, "calibration")), 60, "S and Q")
            assert agent.poll() is None, log.read_text()
            published = wait_until(subscriber.try_recv, 10, "S and Q on the network")
            with urllib.request.urlopen(f"http://127.0.0.1:{metrics_port}/metrics", timeout=60) as answer:
                scraped = answer.read().decode()
            agent.terminate()
            assert agent.wait(60) == 0
        finally:
            agent.kill()
            agent.wait()
        subscriber.undeclare()
    router.close()
    found = json.loads(published.payload.to_string())
    main = np.diag(SENSITIVITY)
    # Noise of 0.01 over the 260 samples of a rest leaves about 1e-4. One sample from another pose would cause errors of
    # 10 %.
    assert np.abs((np.array(found["sensitivity"]) - SENSITIVITY) / main).max() < 1e-3
    assert np.abs(np.array(found["offset"]) - OFFSET).max() < 5e-3
    assert 'fieldcal_device_up{device="imu"} 1.0' in scraped
    assert [path.suffix for path in data.glob("*.mcap*")] == [".mcap"]
    assert {"READY=1", "WATCHDOG=1", "STOPPING=1"} <= systemd.told()
    for line in log.read_text().splitlines():
        assert json.loads(line)["level"] in ("info", "warning"), line
