"""Makes a recording with each earlier revision, and audits it with and without the engines of that time.

    .venv/bin/python -m deploy.engines.recordings DIRECTORY [--seconds 80] [--jobs 4]

Each revision of deploy/engines/earlier.py runs its own `fieldcal run` on its own virtual bench, in real time, signed
where it can be. DIRECTORY then holds `engines`, a directory for each recording, and `gateway.pub`. The program of today
audits each recording twice, and prints the table of docs/recording-evidence.md. An old revision may end with a fault of
its own on a busy machine: delete its recording and run this again, which makes what is missing.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from agent.engine.identity import ROOT
from deploy.engines.earlier import REVISIONS, Revision, checkout, keep

# Writes a configuration for the driver `virtual`; it runs with the modules of the revision.
CONFIGURATION = """
import sys
from hw.virtual.bench import Bench
from hw.virtual.presets import plain
bench = Bench(plain(1), 1)
poses = (
    f"{{start_s = {p.start_s}, stop_s = {p.stop_s}, theta_deg = {p.theta_deg}, alpha_deg = {p.alpha_deg}}}"
    for p in bench.poses
)
devices = "".join(
    f'[[devices]]\\nname = "{name}"\\ndriver = "virtual"\\noptions = {{role = "{role}", preset = "plain", seed = 1}}\\n'
    for name, role in (("mems", "sensor"), ("reference", "reference"))
)
print(f'''
[gateway]
site = "virtual"
name = "bench"
[zenoh]
enabled = false
[recording]
signing_key = "{sys.argv[1]}"
{devices}
[[channels]]
sensor = "mems"
reference = "reference"
prior = {{sensitivity = {bench.parameters.sensor.nominal_sensitivity}, u_main_pct = 3.0}}
poses_repeat_s = {bench.parameters.schedule.period_s}
poses = [{", ".join(poses)}]
''')
"""


def record(revision: Revision, directory: Path, seconds: float) -> None:
    """Let a revision record, unless it did so before. Raises CalledProcessError, NoEngineError, OSError."""
    data_dir = directory / str(revision.number)
    if data_dir.exists():
        return
    with checkout(revision.commit) as root:
        run = partial(
            subprocess.run, cwd=root, env=os.environ | {"PYTHONPATH": str(root)}, check=True, stdout=subprocess.PIPE
        )
        arguments = []
        if (root / "hw/virtual/device.py").exists():
            made = run([sys.executable, "-P", "-c", CONFIGURATION, str(directory / "gateway.key")])
            arguments = [str(directory / f"{revision.number}.toml")]
            Path(arguments[0]).write_bytes(made.stdout)
        command = [sys.executable, "-P", "-m", "agent", "run", *arguments, "--data-dir", str(data_dir)]
        run([*command, "--duration", str(seconds)])


def audit(revision: Revision, directory: Path, *options: str) -> tuple[int, dict[str, Any]]:
    """The exit status of an audit by the program of today, and what it says of the recording."""
    files = sorted((directory / str(revision.number)).glob("*.mcap"))
    key = ["--public-key", str(directory / "gateway.pub")] if is_signed(revision, directory) else []
    command = [sys.executable, "-m", "agent", "audit", "--json", "-", *key, *options, *map(str, files)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, check=False)
    return done.returncode, json.loads(done.stdout)["files"][0]


def is_signed(revision: Revision, directory: Path) -> bool:
    """Whether a revision had a configuration, and so a key."""
    return (directory / f"{revision.number}.toml").exists()


def row(revision: Revision, directory: Path) -> str:
    """The line of the table."""
    without, told = audit(revision, directory)
    status, passed = audit(revision, directory, "--engines", str(directory / "engines"))
    departure, replay = told["replay"]["departure"], passed["replay"]
    differs, decision = f"{departure['largest_in_u']:.2g} U", departure["decision"].partition(":")[0] or "none"
    if told["replay"]["refused"]:
        differs, decision = "cannot be replayed", ""
    exact = "bit for bit" if replay["tolerance"] == 0.0 else f"within {replay['tolerance']:g}"
    by = f"{replay['replayed_by']}: {replay['results']} results {exact}" if status == 0 else ""
    signed = "yes" if is_signed(revision, directory) else "no"
    return f"| {revision.commit} | {signed} | {without} | {differs} | {decision} | {status} | {by} |"


def main() -> None:
    """Build the engines, record, audit, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("directory", type=Path)
    parser.add_argument("--seconds", type=float, default=80.0, help="of each recording")
    parser.add_argument("--jobs", type=int, default=4, help="how many revisions run at the same time")
    given = parser.parse_args()
    directory = given.directory.resolve()
    directory.mkdir(parents=True, exist_ok=True)
    key, public = directory / "gateway.key", directory / "gateway.pub"
    if not key.exists():
        subprocess.run(["openssl", "genpkey", "-algorithm", "ed25519", "-out", key], check=True)
        subprocess.run(["openssl", "pkey", "-in", key, "-pubout", "-out", public], check=True)
    for revision in REVISIONS:
        keep(revision, directory / "engines")
    with ThreadPoolExecutor(given.jobs) as pool:
        list(pool.map(lambda revision: record(revision, directory, given.seconds), REVISIONS))
    print("| revision | signed | exit without | values differ by at most | another decision | exit with | by engine |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for revision in REVISIONS:
        print(row(revision, directory), flush=True)


if __name__ == "__main__":
    main()
