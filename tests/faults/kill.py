"""kill -9, at random moments and at every nth write."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path
from random import Random

from tests.faults.invariants import Ledger
from tests.faults.outcome import Outcome
from tests.faults.rig import Rig, Witness, stop, strace, witnessed
from tests.scenarios.processes import recordings

SEED = 20261121
# The system calls of a commit of SQLite, and those that close or rename a file. `write`, which writes the recordings,
# is tested separately.
SAVING = "pwrite64,fsync,fdatasync,ftruncate,rename,unlink"
SURVIVED = 12  # results of a run in which the nth call did not come: six windows with their calibrations
MOST_CALLS = 2500  # of six windows; more means that what a window writes grows with the number of windows


def at_random_moments(directory: Path, kills: int) -> Outcome:
    """Kill the agent and start it again on the same directory, many times; inspect the directory after each kill."""
    moments = Random(SEED)
    with witnessed(directory, SEED) as (rig, witness):
        ledger = Ledger(rig.data_dir)
        for _ in range(kills):
            with rig.agent() as agent:
                rig.run_to_a_moment(agent, moments)
                agent.kill()
                agent.wait()
            if rig.data_dir.exists():
                ledger.inspect(witness.before(time.monotonic()))
        with rig.agent() as agent:
            rig.run(agent, until=lambda: rig.sensor.speaks)
            status = stop(agent)
        ledger.inspect(witness.before(time.monotonic()))
        outcome = Outcome("kill -9 at random moments", f"{kills} kills, seed {SEED}", ledger.findings)
        outcome.also = (
            f"{ledger.findings.restored} runs began with the calibration in force before, the others with none"
        )
        outcome.require(status == 0, f"the last run ended with {status}")
        outcome.require("Traceback" not in rig.output, "a traceback was shown")
    return outcome


def at_every_write(directory: Path, step: int = 3) -> Outcome:
    """Killed by strace as it enters its nth call that saves, n = 1, 1 + step, ... until a life goes without.

    Calls are counted by name and thread: the main thread's are those of opening the store, the recording thread's those
    of recording and committing.
    """
    kills = 0
    with witnessed(directory, SEED) as (rig, witness):
        ledger = Ledger(rig.data_dir)
        for calls in (SAVING, "write"):
            n, killed = 1, True
            while killed:
                where = _next_recording(rig.data_dir) if calls == "write" else None
                with rig.agent(strace(calls, f"signal=KILL:when={n}", where)) as agent:
                    killed = not _goes_on(rig, agent, witness)
                ledger.inspect(witness.before(time.monotonic()))
                kills += killed
                n += step
                assert n < MOST_CALLS, f"{SURVIVED} results take more than {n} calls of {calls}"
        outcome = Outcome(
            "kill -9 at every nth write of a save", f"{kills} kills, n in steps of {step}", ledger.findings
        )
        outcome.also = f"calls {SAVING}; write to the recording"
        outcome.require("Traceback" not in rig.output, "a traceback was shown")
    return outcome


def _goes_on(rig: Rig, agent: subprocess.Popen[bytes], witness: Witness) -> bool:
    enough = len(witness.received) + SURVIVED
    return rig.run(agent, until=lambda: len(witness.received) >= enough)


def _next_recording(data_dir: Path) -> Path:
    names = [path.name for path in recordings(data_dir)]
    following = int(names[-1].split("-")[1].split(".")[0]) + 1 if names else 1
    return data_dir / f"fieldcal-{following:06d}.mcap.active"
