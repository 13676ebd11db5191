"""Whether two gateways publish under one name in turns: copies of one memory card that are never on the bus together.

A copy has the store of the other one, and so goes on with the same numbers under another id of the run. Results say
both, so one number that two runs have used, or a run that comes back after a later one, is the work of two stores. A
restart of one gateway is neither: its next run has later numbers alone. What a stranger on the bus sends can look like
it where results are not verified.
"""

from __future__ import annotations

from bisect import bisect_right

from agent.delivery.presence import GATEWAYS_MAX
from agent.delivery.received import Received

RUNS_MAX = 64  # newest changes of run of one gateway and epoch that are known


class Turns:
    """The runs of each gateway and epoch, by the numbers of the results that were taken.

    `found`: the ids of two runs that cannot be of one gateway, by `<site>/<gateway>`; the newest find.
    """

    def __init__(self) -> None:
        self.found: dict[str, tuple[str, str]] = {}
        self._runs: dict[tuple[str, str], list[tuple[int, str]]] = {}  # (first number, run), as numbers rise

    def taken(self, result: Received) -> None:
        """A result was taken; each later one has a higher number."""
        if not result.confirmed:
            return
        run, of = _run_of(result), (result.address.source, result.epoch)
        runs = self._runs.get(of)
        if runs is None and len(self._runs) < GATEWAYS_MAX:
            runs = self._runs[of] = []
        if not run or runs is None or (runs and runs[-1][1] == run):
            return
        if any(known == run for _, known in runs):
            self.found[result.address.source] = (runs[-1][1], run)
        runs.append((result.sequence, run))
        del runs[:-RUNS_MAX]

    def came_again(self, result: Received) -> None:
        """A result came whose number was taken before."""
        runs, run = self._runs.get((result.address.source, result.epoch), []), _run_of(result)
        place = bisect_right([first for first, _ in runs], result.sequence) - 1
        if run and place >= 0 and runs[place][1] != run:
            self.found[result.address.source] = (runs[place][1], run)


def _run_of(result: Received) -> str:
    run = result.fields.get("run_id", "")
    return run if isinstance(run, str) else ""
