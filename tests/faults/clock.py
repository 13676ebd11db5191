"""UTC is stepped by hours and by decades, while the agent runs and between two runs."""

from __future__ import annotations

import struct
import subprocess
import time
from itertools import pairwise
from pathlib import Path

from agent.delivery.history import FILE_NAME, StoredResult
from tests.faults.acquisition import LONGEST_S, acquisition
from tests.faults.invariants import Ledger, read_store
from tests.faults.outcome import Outcome
from tests.faults.rig import stop, witnessed

SEED = 20261121
HOUR_S, YEARS_30_S = 3600, 30 * 365 * 86400
STEPS_S = {"+1 h": HOUR_S, "-1 h": -HOUR_S, "-30 years": -YEARS_30_S, "back": 0}
BETWEEN_S = 4.0  # 16 rests
SHIM = Path(__file__).with_name("clock_shim.c")


def stepped(directory: Path) -> Outcome:
    """One run in which UTC makes all steps; then two runs with UTC 30 years earlier, the last without a state file."""
    directory.mkdir(exist_ok=True)
    step = directory / "step"
    variables = clock_shim(directory, step)
    with witnessed(directory, SEED) as (rig, witness):
        with rig.agent(variables=variables) as agent:
            lives = rig.run(agent, until=lambda: len(witness.received) > 20)
            for seconds in STEPS_S.values():
                step_clock(step, seconds)
                lives &= rig.run(agent, BETWEEN_S)
            status = stop(agent)
        ledger = Ledger(rig.data_dir)
        ledger.inspect(witness.before(time.monotonic()))
        read = acquisition(rig.data_dir, rig.speed)
        first_run = ledger.records
        step_clock(step, -YEARS_30_S)
        with rig.agent(variables=variables) as agent:
            lives &= rig.run(agent, until=lambda: rig.sensor.speaks) and rig.run(agent, BETWEEN_S)
            status |= stop(agent)
        ledger.inspect(witness.before(time.monotonic()))
        numbers = [record.sequence for record in ledger.records]
        for path in rig.data_dir.glob(f"{FILE_NAME}*"):
            path.unlink()
        before = len(witness.received)
        with rig.agent(variables=variables) as agent:
            lives &= rig.run(agent, until=lambda: rig.sensor.speaks) and rig.run(agent, BETWEEN_S)
            status |= stop(agent)
        anew = len(witness.received) - before
        outcome = Outcome(
            "UTC stepped",
            f"{', '.join(STEPS_S)}; then a start 30 years earlier; then one without a state file",
            ledger.findings,
        )
        windows = [record.fields for record in first_run if record.what == "window"]
        torn = [fields for fields in windows if not fields["used"]]
        backwards = sum(b.t_utc_ns < a.t_utc_ns for a, b in pairwise(first_run))
        outcome.also = (
            f"UTC ran backwards between results {backwards} times; {len(windows) - len(torn)} of {len(windows)} windows"
            f" used; {read}; the calibration in force was restored in {ledger.findings.restored} of 1 later runs;"
            f" the store made anew counted on, {anew} results came"
        )
        outcome.require(backwards == 2, f"UTC ran backwards {backwards} times: the steps were not felt")
        outcome.require(not torn or read.missing > 0, f"windows torn: {torn[:2]}")
        outcome.require(read.openings == 1, f"the sample times began anew {read.openings - 1} times")
        outcome.require(read.longest_pause_s < LONGEST_S + rig.late_s, f"reading paused {read.longest_pause_s:.2f} s")
        outcome.require(read.dropped == 0, f"{read.dropped} blocks dropped")
        outcome.require(ledger.findings.restored == 1, "the later run began without the calibration in force")
        outcome.require(read_store(rig.data_dir)[-1].sequence > numbers[-1], "a store made anew counts from before")
        outcome.require(anew > 5, f"{anew} results came of a store made anew")
        outcome.require(_rising(ledger.records, first_run), "the later run's numbers do not go on")
        outcome.require(lives and status == 0, f"the agent ended with {status}: {rig.output[-300:]}")
        outcome.require("Traceback" not in rig.output, "a traceback was shown")
    return outcome


def clock_shim(directory: Path, step: Path) -> dict[str, str]:
    """Build the clock shim in `directory`. Returns the environment of processes whose UTC `step_clock(step, ...)` is to
    shift. Needs gcc."""
    library = directory / "clock_shim.so"
    subprocess.run(["gcc", "-O2", "-shared", "-fPIC", "-o", str(library), str(SHIM)], check=True)
    step_clock(step, 0)
    return {"LD_PRELOAD": str(library), "FIELDCAL_CLOCK_STEP": str(step)}


def step_clock(path: Path, seconds: int) -> None:
    """Shift UTC by `seconds`, from now on, for all processes that have loaded the clock shim with the file `path`."""
    if not path.exists():
        path.write_bytes(bytes(8))
    with open(path, "r+b", buffering=0) as file:
        file.write(struct.pack("q", seconds * 10**9))


def _rising(records: list[StoredResult], before: list[StoredResult]) -> bool:
    later = [record for record in records if record.run_id != before[0].run_id]
    return bool(later) and min(record.sequence for record in later) > max(record.sequence for record in before)
