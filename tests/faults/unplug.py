"""The sensor is unplugged and plugged in again, many times in one run."""

from __future__ import annotations

import random
import time
from pathlib import Path

from tests.faults.acquisition import acquisition
from tests.faults.invariants import Ledger
from tests.faults.outcome import Outcome
from tests.faults.rig import stop, witnessed

SEED = 20261121
PLUGGED_S = (0.05, 1.5)  # real time; at ten times the speed up to six rests
UNPLUGGED_S = (0.0, 0.5)
BACK_S = 1.0  # allowed besides the time unplugged: the pause between attempts to open begins at 0.1 s and doubles


def unplugged(directory: Path, times: int) -> Outcome:
    """Hang up the port while the agent runs, at random moments and for random times."""
    moments = random.Random(SEED)
    slowest_s = 0.0
    with witnessed(directory, SEED) as (rig, witness):
        with rig.agent() as agent:
            rig.run(agent, until=lambda: len(witness.received) > 20)
            for _ in range(times):
                rig.run(agent, moments.uniform(*PLUGGED_S))
                rig.device.unplug()
                away_s = moments.uniform(*UNPLUGGED_S)
                rig.run(agent, away_s)
                rig.device.replug()
                back_s = time.monotonic()
                rig.run(agent, until=rig.device.has_reader)
                slowest_s = max(slowest_s, time.monotonic() - back_s - away_s)
            before = len(witness.received)
            lives = rig.run(agent, until=lambda: len(witness.received) > before + 20)
            status = stop(agent)
        ledger = Ledger(rig.data_dir)
        ledger.inspect(witness.before(time.monotonic()))
        read = acquisition(rig.data_dir, rig.speed)
        windows = [record.fields["used"] for record in ledger.records if record.what == "window"]
        outcome = Outcome("sensor unplugged", f"{times} times, seed {SEED}", ledger.findings)
        outcome.also = (
            f"read again {max(slowest_s, 0.0):.2f} s after it is back, besides the time it was away;"
            f" {read.openings} openings in the recording; {sum(windows)} of {len(windows)} windows used"
        )
        outcome.require(lives and status == 0, f"the agent ended with {status}: {rig.output[-300:]}")
        outcome.require(slowest_s < BACK_S, f"it took {slowest_s:.2f} s")
        outcome.require(sum(windows) > times / 4, "hardly a window was used")
        outcome.require("Traceback" not in rig.output, "a traceback was shown")
    return outcome
