"""A disk that loses power, fills up, turns read-only, fails or is slow. File systems are in loop files; needs root."""

from __future__ import annotations

import fcntl
import os
import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random

from tests.faults.acquisition import LONGEST_S, acquisition
from tests.faults.invariants import Ledger
from tests.faults.outcome import Outcome
from tests.faults.rig import Rig, Witness, stop, strace, witnessed
from tests.scenarios.processes import recordings

SEED = 20261121
FS_IOC_SHUTDOWN = 0x8004587D
# Flag of the shutdown ioctl with which exactly the unsynced data are lost: XFS does not flush its log with 2 (1 would);
# ext4 drops its unwritten journal with 2.
NO_LOG_FLUSH = 2
SIZE_MB = {"ext4": 64, "xfs": 320}  # XFS needs at least 300 MB
MAKE = {"ext4": ["mkfs.ext4", "-q", "-F"], "xfs": ["mkfs.xfs", "-q", "-f"]}
BAD_S = 5.0  # longer than the pause between two attempts to record: 10 s of a clock that runs 10 times as fast, so 1 s
GOOD_AGAIN_S = 60.0  # includes the time to write what waited for the slow disk
# The agent has recovered when so many results came within so many seconds and the last one is recorded. A good disk
# takes 2.5 s for them, a slow one 10 s or more. Stopped on a slow disk, the agent leaves results unrecorded.
AGAIN, AGAIN_S = 20, 5.0
SLOW_MS = 500  # as a worn SD card takes during its garbage collection
# Slow are 17 calls, so 8.5 s, which are 85 s of the sensor's clock: the recorder's queue takes that. With 21 calls the
# queue to the pipeline is filled too, to 53 of its 60 blocks here, and on a slower machine a block was dropped.
SLOW_CALLS = "20..36"
BACKLOG_S = 8.0  # s of results that wait, each of which takes half a second or more to write


def nothing() -> None:
    """Do nothing: the injector begins and ends by itself."""


@dataclass(frozen=True, slots=True)
class Spell:
    """A time in which the disk is bad. `recorded`: whether recording goes on during it."""

    prefix: Sequence[str] = ()
    begin: Callable[[], None] = nothing
    end: Callable[[], None] = nothing
    recorded: bool = False


@contextmanager
def loop_disk(directory: Path, kind: str, size_mb: int = 0) -> Iterator[Path]:
    """Make a new file system in a loop file, mount it and yield its path."""
    image, mount = directory / f"{kind}.image", directory / f"{kind}.mount"
    mount.mkdir(parents=True)
    with open(image, "wb") as file:
        file.truncate((size_mb or SIZE_MB[kind]) << 20)
    _run(*MAKE[kind], str(image))
    _mount(image, mount)
    try:
        yield mount
    finally:
        subprocess.run(["umount", "--lazy", str(mount)], check=False, capture_output=True)
        image.unlink()


def power_cut(directory: Path, kind: str, cuts: int) -> Outcome:
    """Shut the file system down without its journal while the agent runs; mount it again and check what is left."""
    moments = Random(SEED)
    with loop_disk(directory, kind) as mount, witnessed(directory, SEED, data_dir=mount / "data") as (rig, witness):
        ledger = Ledger(rig.data_dir)
        for _ in range(cuts):
            with rig.agent() as agent:
                rig.run_to_a_moment(agent, moments)
                at_s = time.monotonic()
                shut_down(mount)
                agent.kill()
                agent.wait()
            _run("umount", str(mount))
            _mount(directory / f"{kind}.image", mount)
            if rig.data_dir.exists():
                ledger.inspect(witness.before(at_s))
            witness.forget_since(at_s)
        outcome = Outcome(f"power cut on {kind}", f"{cuts} cuts, journal dropped, seed {SEED}", ledger.findings)
        outcome.also = f"{ledger.findings.restored} runs began with the calibration in force before"
    return outcome


def full(directory: Path) -> Outcome:
    """Fill the disk to its last byte while the agent runs, and empty it again."""
    with (
        loop_disk(directory, "ext4", 16) as mount,
        witnessed(directory, SEED, data_dir=mount / "data") as (rig, witness),
    ):

        def fill() -> None:
            with suppress(OSError), open(mount / "ballast", "wb", buffering=0) as file:
                while file.write(bytes(4096)):
                    pass

        spell = Spell(begin=fill, end=(mount / "ballast").unlink, recorded=False)
        return _spell("disk full", f"once, for {BAD_S:g} s", rig, witness, spell)


def read_only(directory: Path) -> Outcome:
    """Make ext4 abort its journal and turn read-only while the agent runs, as after an error of the medium.

    The file system stays read-only until it is mounted again. Results that were not stored by then are missing in the
    store, but consumers have received them.
    """
    with loop_disk(directory, "ext4") as mount, witnessed(directory, SEED, data_dir=mount / "data") as (rig, witness):
        ledger = Ledger(rig.data_dir)
        with rig.agent() as agent:
            rig.run(agent, until=lambda: len(witness.received) > 20)
            at_s = time.monotonic()
            _run("mount", "-o", "remount,abort", str(mount))
            lives = rig.run(agent, BAD_S)
            came = len(witness.received) - len(witness.before(at_s))
            status = stop(agent)
        _run("umount", str(mount))
        _mount(directory / "ext4.image", mount)
        ledger.inspect(witness.before(at_s))
        with rig.agent() as agent:
            rig.run(agent, until=lambda: rig.sensor.speaks)
            stop(agent)
        ledger.inspect(witness.before(at_s))
    outcome = Outcome("disk turns read-only", f"once, for {BAD_S:g} s, then mounted again", ledger.findings)
    outcome.also = f"{came} results published meanwhile, ended with {status}"
    outcome.require(lives, f"the agent ended: {rig.output[-300:]}")
    outcome.require(came > 20, f"only {came} results while the disk was read-only")
    outcome.require("Traceback" not in rig.output, "a traceback was shown")
    return outcome


def sync_fails(directory: Path) -> Outcome:
    """fsync and fdatasync return EIO for a while (strace)."""
    return _injected(directory, "fsync fails with EIO", "error=EIO:when=20..40", recorded=False)


def slow(directory: Path) -> Outcome:
    """fsync and fdatasync take long for a while (strace)."""
    return _injected(directory, "slow disk", f"delay_enter={SLOW_MS * 1000}:when={SLOW_CALLS}", recorded=True)


def slow_at_the_end(directory: Path) -> Outcome:
    """fsync and fdatasync become slow, and the agent is stopped while many events wait for the disk."""
    prefix = strace("fsync,fdatasync", f"delay_enter={SLOW_MS * 1000}:when=20+")
    with witnessed(directory, SEED) as (rig, witness):
        with rig.agent(prefix) as agent:
            rig.run(agent, until=lambda: len(witness.received) > 20)
            rig.run(agent, BACKLOG_S)
            began_s = time.monotonic()
            status = stop(agent)
            took_s = time.monotonic() - began_s
        ledger = Ledger(rig.data_dir)
        ledger.inspect(witness.before(time.monotonic()))
        with rig.agent() as agent:
            rig.run(agent, until=lambda: len(witness.received) > len(ledger.records))
            again = stop(agent)
        ledger.inspect(witness.before(time.monotonic()))
    outcome = Outcome(
        "stop on a slow disk", f"{SLOW_MS} ms for each fsync, {BACKLOG_S:g} s of backlog", ledger.findings
    )
    unrecorded = sum(not record.recorded for record in ledger.records)
    outcome.also = f"ended with {status} after {took_s:.1f} s; {unrecorded} results kept and not recorded"
    outcome.require((status, again) == (0, 0), f"it ended with {status}, then {again}: {rig.output[-300:]}")
    outcome.require(unrecorded > 0 and "too slow to record" in rig.output, "nothing was left to record at the end")
    outcome.require("Traceback" not in rig.output, "a traceback was shown")
    return outcome


def _injected(directory: Path, line: str, how: str, *, recorded: bool) -> Outcome:
    prefix = strace("fsync,fdatasync", how)
    with witnessed(directory, SEED) as (rig, witness):
        return _spell(
            line, f"fsync and fdatasync of each thread: {how}", rig, witness, Spell(prefix, recorded=recorded)
        )


def _spell(line: str, injected: str, rig: Rig, witness: Witness, spell: Spell) -> Outcome:
    """Make the disk bad for a while; the agent must go on, and afterwards no result may be missing."""
    with rig.agent(spell.prefix) as agent:
        rig.run(agent, until=lambda: len(witness.received) > 20)
        began_s = time.monotonic()
        spell.begin()
        lives = rig.run(agent, BAD_S)
        meanwhile = len(witness.received) - len(witness.before(began_s))
        spell.end()
        ended_s = time.monotonic()
        lives = lives and rig.run(agent, GOOD_AGAIN_S, until=lambda: _good_again(witness, ended_s))
        after = len(witness.received) - len(witness.before(ended_s))
        unread_s = rig.unread_s
        status = stop(agent) if lives else agent.wait()
    ledger = Ledger(rig.data_dir)
    ledger.inspect(witness.before(time.monotonic()))
    read = acquisition(rig.data_dir, rig.speed)
    outcome = Outcome(line, injected, ledger.findings)
    unrecorded = sum(not record.recorded for record in ledger.records)
    outcome.also = (
        f"{meanwhile} results published meanwhile, {after} after; {unrecorded} marked as not recorded;"
        f" {unread_s:.2f} s of the text unread at the port; {len(recordings(rig.data_dir))} recordings"
    )
    if spell.recorded:
        outcome.also += f"; {read}"
        outcome.require(read.longest_pause_s < LONGEST_S + rig.late_s, f"reading paused {read.longest_pause_s:.2f} s")
        outcome.require(read.dropped == 0, f"{read.dropped} blocks dropped")
    outcome.require(lives and status == 0, f"the agent ended with {status}: {rig.output[-300:]}")
    outcome.require(unread_s < LONGEST_S + rig.late_s, f"{unread_s:.2f} s of the text were not read")
    outcome.require(meanwhile > 5, f"only {meanwhile} results while the disk was bad")
    outcome.require(after > AGAIN, f"only {after} results after it was good again")
    outcome.require(ledger.records[-1].recorded, "recording did not begin again")
    outcome.require("Traceback" not in rig.output, "a traceback was shown")
    return outcome


def _good_again(witness: Witness, since_s: float) -> bool:
    came = [(came_s, result) for came_s, result in witness.received if came_s > since_s][-AGAIN - 1 :]
    return len(came) > AGAIN and came[-1][0] - came[0][0] < AGAIN_S and bool(came[-1][1].fields["recorded"])


def shut_down(mount: Path) -> None:
    """Stop all writes to the file system and drop its journal, as in a power cut."""
    descriptor = os.open(mount, os.O_RDONLY)
    try:
        fcntl.ioctl(descriptor, FS_IOC_SHUTDOWN, struct.pack("I", NO_LOG_FLUSH))
    finally:
        os.close(descriptor)


def _mount(image: Path, mount: Path) -> None:
    _run("mount", "-o", "loop", str(image), str(mount))


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()}")
