"""`fieldcal fleet replay` of many recordings: the same bytes whatever the workers, killed and resumed, and its cost.

    python -m benchmarks.fleet_replay [--recordings 200] [--seconds 60] [--turns 3] [--write]

The recordings are drawn: one sensor and its reference on the virtual bench, each with a seed of its own. They are
replayed with one process, with two, and by a Dask cluster of two workers on this machine; the files of results must
have the same bytes. Then a run with two processes is killed when a third of the results is there, and called again.
The cost is the CPU time of `fieldcal fleet replay --workers 1` and of `fieldcal replay` with all recordings, each with
its processes, in turn; the least of each counts.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.page import machine, write_part

FIELDCAL = [sys.executable, "-m", "agent"]
ONE_THREAD = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
CLUSTER = """
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        print(cluster.scheduler_address, flush=True)
        input()
"""
LONGEST_S = 3600.0


def recorded(directory: Path, number: int, seconds: float) -> list[Path]:
    """That many recordings, each of a run of its own."""
    from tests.unit.recorded_bench import record

    found = []
    for seed in range(1, number + 1):
        made = directory / f"made-{seed}"
        record(made, seconds, seed=seed, run_id=f"run-{seed}")
        found.append((made / "fieldcal-000001.mcap").rename(directory / f"gateway-{seed:04}.mcap"))
        shutil.rmtree(made)
    return found


def spent(arguments: list[str]) -> float:
    """CPU time in s of a command and all its processes. Raises CalledProcessError unless its exit status is 0."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([*FIELDCAL, *arguments], check=True, stdout=subprocess.DEVNULL, env=ONE_THREAD, timeout=LONGEST_S)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def written(directory: Path) -> dict[str, bytes]:
    """The whole results in a directory, by the names of their files."""
    return {path.name: path.read_bytes() for path in directory.glob("*.json")}


def by_dask(recordings: Path, out: Path) -> None:
    """Replay by a cluster of two workers, in processes of their own."""
    told = [sys.executable, "-c", CLUSTER]
    with subprocess.Popen(told, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=ONE_THREAD) as cluster:
        assert cluster.stdout is not None
        address = cluster.stdout.readline().strip()
        spent(["fleet", "replay", str(recordings), "-o", str(out), "--scheduler", address])
        cluster.communicate("\n")


def killed(recordings: Path, out: Path, at: int) -> int:
    """Kill a run as soon as `at` results are there; how many are there then."""
    told = [*FIELDCAL, "fleet", "replay", str(recordings), "-o", str(out), "--workers", "2"]
    process = subprocess.Popen(told, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=ONE_THREAD)
    while len(list(out.glob("*.json"))) < at:
        if process.poll() is not None:
            raise RuntimeError(f"the run ended before it was killed, with exit status {process.returncode}")
        time.sleep(0.01)
    process.kill()
    process.wait()
    return len(written(out))


def resumed(recordings: Path, out: Path) -> int:
    """Call it again; how many recordings it did not compute again."""
    told = [*FIELDCAL, "fleet", "replay", str(recordings), "-o", str(out), "--workers", "2", "--json", "-"]
    done = subprocess.run(told, check=True, capture_output=True, env=ONE_THREAD, timeout=LONGEST_S)
    return int(json.loads(done.stdout)["unchanged"])


def measured(number: int, seconds: float, turns: int) -> str:
    """The figures as text. Raises AssertionError where results differ."""
    with tempfile.TemporaryDirectory() as made:
        root = Path(made)
        recordings = root / "recordings"
        files = [str(path) for path in recorded(recordings, number, seconds)]
        replayed_s, alone_s = [], []
        for turn in range(turns):
            out = str(root / f"one-{turn}")
            replayed_s.append(spent(["fleet", "replay", str(recordings), "-o", out, "--workers", "1"]))
            alone_s.append(spent(["replay", *files]))
        one = written(root / "one-0")
        spent(["fleet", "replay", str(recordings), "-o", str(root / "two"), "--workers", "2"])
        by_dask(recordings, root / "dask")
        there = killed(recordings, root / "killed", number // 3)
        unchanged = resumed(recordings, root / "killed")
        others = {name: written(root / name) for name in ("two", "dask", "killed")}
        assert len(one) == number
        assert all(other == one for other in others.values()), "results differ"
        assert unchanged == there
        size_kb = sum(path.stat().st_size for path in recordings.iterdir()) / number / 1e3
    fleet_ms, alone_ms = (1e3 * min(each) / number for each in (replayed_s, alone_s))
    all_of_them = f"{number} of {number}"
    return "\n".join(
        [
            f"{number} recordings of {seconds:g} s, {size_kb:.0f} kB each:",
            "",
            "| quantity | figure |",
            "| --- | --- |",
            f"| results with the same bytes with 1 process, 2 processes, and Dask with 2 workers | {all_of_them} |",
            f"| killed: whole results that were there | {there} |",
            f"| called again: recordings that were computed, the others being unchanged | {number - unchanged} |",
            f"| results with the same bytes as without the kill | {all_of_them} |",
            f"| CPU time a recording, `fieldcal replay` | {alone_ms:.0f} ms |",
            f"| CPU time a recording, `fieldcal fleet replay --workers 1` | {fleet_ms:.0f} ms "
            f"({fleet_ms / alone_ms - 1.0:+.1%}) |",
        ]
    )


def main() -> None:
    """Measure, print, and write into docs/fleet-replay.md with --write."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--recordings", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    text = f"{measured(options.recordings, options.seconds, options.turns)}\n\nMeasured on {machine()}."
    if options.write:
        write_part("fleet-replay", text)
    else:
        print(text)


if __name__ == "__main__":
    main()
