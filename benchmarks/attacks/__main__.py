"""Directed attacks on a signed data directory of the real pipeline: what does the audit say to each?

    python -m benchmarks.attacks [--kinds WORD] [--places 10] [--show] [--json -]

Each kind of attack is tried at ten places or in ten variants (`kinds.py`). Each audit is a process of its own with
2 GiB of address space more than it begins with, with the key of the gateway and a head that was kept elsewhere;
forgeries without signatures are audited with neither. The table gives how many audits ended with each exit status, the
longest time and the largest memory. An attack counts as a fault where its audit ends with 0 or a traceback, after
SECONDS or above MEMORY.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as in every entry point of the product; before numpy is loaded

from benchmarks.attacks.kinds import KINDS, Kind
from benchmarks.attacks.site import Site
from tests.attacks.chain_site import public_pem

PLACES = 10
SECONDS = 60.0  # that an audit may take
MEMORY = 1 << 30  # bytes that an audit may need


@dataclass
class Outcome:
    """What came of the audits of one kind. `faults`: the places where an audit passed, was late or needed too much."""

    statuses: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    longest_s: float = 0.0
    largest_bytes: int = 0


def audit(arguments: list[str], output: Path) -> tuple[str, float, int]:
    """(exit status or the signal, s, bytes of memory) of `fieldcal audit`, in a process of its own."""
    from agent.cli.main import run_cli

    begin = time.monotonic()
    space, resident = (
        int(pages) * resource.getpagesize() for pages in Path("/proc/self/statm").read_text().split()[:2]
    )
    if not (child := os.fork()):
        with open(output, "w") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        signal.alarm(int(SECONDS))
        resource.setrlimit(resource.RLIMIT_AS, (space + (2 << 30), space + (2 << 30)))
        status = 70
        try:
            status = run_cli(["audit", *arguments])
        finally:
            sys.stdout.flush()
            os._exit(status)
    _, ended, used = os.wait4(child, 0)
    how = str(os.waitstatus_to_exitcode(ended)) if os.WIFEXITED(ended) else signal.Signals(os.WTERMSIG(ended)).name
    return how, time.monotonic() - begin, max(0, (used.ru_maxrss << 10) - resident)


def attack(kind: Kind, place: int, site: Site, directory: Path, kept: list[str]) -> tuple[str, float, int, str]:
    """What `audit` gives for one attack, and its output."""
    data, output = directory / "data", directory / "output"
    shutil.copytree(site.true, data)
    kind.attack(data, site, place)
    outcome = audit([str(data), "--jobs", "1", *(kept if kind.keyed else [])], output)
    shutil.rmtree(data)
    return *outcome, output.read_text(errors="replace")


def run(kinds: Sequence[str], places: Sequence[int], *, show: bool = False) -> dict[str, Outcome]:
    """The outcomes by kind. `show`: print each audit."""
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        site = Site.make(directory)
        (directory / "key.pem").write_bytes(public_pem())
        (directory / "kept.json").write_bytes(site.heads[-1])
        kept = ["--public-key", str(directory / "key.pem"), "--head", str(directory / "kept.json")]
        unharmed = attack(Kind(lambda *_: None), 0, site, directory, kept)
        if unharmed[0] != "0":
            raise RuntimeError(f"the directory does not pass without an attack: {unharmed}")
        outcomes = {}
        for kind in kinds:
            outcomes[kind] = outcome = Outcome()
            for place in places:
                status, seconds, memory, text = attack(KINDS[kind], place, site, directory, kept)
                outcome.statuses[status] += 1
                outcome.longest_s = max(outcome.longest_s, seconds)
                outcome.largest_bytes = max(outcome.largest_bytes, memory)
                if status not in ("2", "3", "4") or "Traceback" in text or memory > MEMORY:
                    outcome.faults.append(f"place {place}: exit status {status}, {seconds:.1f} s, {memory >> 20} MiB")
                if show:
                    print(
                        f"=== {kind}, place {place}: {status}, {seconds:.1f} s, {memory >> 20} MiB\n{text}", flush=True
                    )
        return outcomes


def main(arguments: Sequence[str]) -> int:
    """Print the table; the status is 3 where an attack passes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", default="", metavar="WORD", help="only the kinds with this word in their name")
    parser.add_argument("--places", type=int, default=PLACES, choices=range(1, PLACES + 1), metavar="N")
    parser.add_argument("--show", action="store_true", help="print what each audit says")
    parser.add_argument("--json", choices=["-"])
    given = parser.parse_args(arguments)
    chosen = [kind for kind in KINDS if given.kinds in kind]
    outcomes = run(chosen, range(given.places), show=given.show)
    if given.json:
        rows = {kind: {"statuses": o.statuses, "faults": o.faults} for kind, o in outcomes.items()}
        print(json.dumps(rows))
    else:
        print("| kind | places | 0 | 2 | 3 | 4 | longest, s | memory, MiB |\n" + "| --- " * 8 + "|")
        for kind, o in outcomes.items():
            counts = " | ".join(str(o.statuses[status]) for status in "0234")
            print(f"| {kind} | {o.statuses.total()} | {counts} | {o.longest_s:.1f} | {o.largest_bytes >> 20} |")
        for kind, o in outcomes.items():
            for fault in o.faults:
                print(f"{kind}, {fault}")
    return 3 if any(o.faults for o in outcomes.values()) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
