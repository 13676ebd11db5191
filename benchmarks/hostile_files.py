"""Hostile files through the commands that read them: exit statuses, tracebacks, memory and CPU time.

    python -m benchmarks.hostile_files --count 100000 [--first 0] [--seconds S] [--program] [--keep DIR] \
        [--kind TITLE] [--quick]

Each file has a number, and its number decides all of it. A case is a file and a command. Each case runs in a process
that is forked from one in which all modules are loaded; with `--program` it runs as `fieldcal`, started anew. Memory
and CPU time are those of the process, above those of the same command on an empty valid file. `--keep`: a directory for
the files of the cases that failed, with their commands. The status is 3 where a case failed.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as every entry point of the product, before numpy loads
os.environ["FIELDCAL_KERNELS_CHOSEN"] = "1"  # an audit does not restart the process for another CPU

from agent.terminal.text import guard_standard_streams
from benchmarks.hostile_inputs import Kind, Use, kinds
from benchmarks.hostile_mutants import bomb, mutated

SEED = 14
BOMBS = 0.03  # share of the files
MEMORY_LIMIT = 600 << 20  # bytes above an empty file, of tables, which hold at most 256 MiB twice; docs/limits.md
RECORDING_LIMIT = 64 << 20  # bytes, of a recording
CPU_LIMIT_S = 10.0  # above an empty file
FIGURES_LIMIT_S = 30.0  # of a report, whose figures of a valid file take 10 s
ADDRESS_SPACE = 4 << 30  # bytes; what asks for more gets MemoryError
HANGS_S = 300  # s after which a process is killed; a fault
SHOWN = 1 << 16  # bytes of the output that are looked at
_CONTROL = re.compile(rb"[\x00-\x08\x0b-\x1f\x7f]")


@dataclass(frozen=True)
class Ran:
    """A process that has ended. `status`: of the command, negative where a signal ended it."""

    status: int
    cpu_s: float
    peak_bytes: int
    output: bytes

    def fault(self, use: Use, empty: Ran, recording: bool) -> str:
        """What must not be, "" where nothing is wrong."""
        if self.status not in (0, 2, 3, 4):
            return f"status {self.status}"
        if b"Traceback" in self.output or b"internal fault" in self.output:
            return "a traceback"
        if found := _CONTROL.search(self.output):
            return f"a control character {found[0]!r} was printed"
        figures = use.arguments[0] == "report"
        most = RECORDING_LIMIT if recording and not figures else MEMORY_LIMIT
        if self.peak_bytes - empty.peak_bytes > most:
            return f"memory {(self.peak_bytes - empty.peak_bytes) / 1e6:.0f} MB above that of an empty file"
        if self.cpu_s - empty.cpu_s > (FIGURES_LIMIT_S if figures else CPU_LIMIT_S):
            return f"CPU time {self.cpu_s:.1f} s"
        return ""


class Program:
    """The real program, started anew for each case by a small process (see benchmarks/spawner.py)."""

    def __init__(self, output: Path) -> None:
        self._output = output
        environment = {k: v for k, v in os.environ.items() if k != "FIELDCAL_KERNELS_CHOSEN"}
        small = [sys.executable, "-S", str(Path(__file__).with_name("spawner.py"))]
        self._spawner = subprocess.Popen(
            small, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True
        )

    def run(self, arguments: Sequence[str]) -> Ran:
        """Run a command."""
        assert self._spawner.stdin is not None
        assert self._spawner.stdout is not None
        command = [sys.executable, "-m", "agent", *arguments]
        self._spawner.stdin.write(json.dumps([command, str(self._output), ADDRESS_SPACE, HANGS_S]) + "\n")
        self._spawner.stdin.flush()
        status, cpu_s, peak_bytes = json.loads(self._spawner.stdout.readline())
        with open(self._output, "rb") as output:
            return Ran(status, cpu_s, peak_bytes, output.read(SHOWN))


def run(arguments: Sequence[str]) -> Ran:
    """Run a command in a process that is forked from this one."""
    with tempfile.TemporaryFile() as output:
        pid = os.fork()
        if pid == 0:
            _become(arguments, output.fileno())
        _, status, used = os.wait4(pid, 0)
        output.seek(0)
        told = output.read(SHOWN)
    return Ran(os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss << 10, told)


def _become(arguments: Sequence[str], output: int) -> None:
    """Be the command, in a process that was just forked. Does not return."""
    status = 70
    try:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number in (1, 2):
            os.dup2(output, number)
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.alarm(HANGS_S)
        sys.argv = sys.orig_argv = ["fieldcal", *arguments]
        os.environ["FIELDCAL_TRACEBACK"] = "1"
        from agent.cli.main import run_cli

        status = run_cli(list(arguments))
    except BaseException:
        traceback.print_exc()
    with suppress(BaseException):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)


@dataclass
class Row:
    """What the cases of one kind of file came to."""

    files: int = 0
    statuses: Counter[int] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    memory_bytes: int = 0  # highest above an empty file
    cpu_s: float = 0.0

    def add(self, ran: Ran, empty: Ran, fault: str) -> None:
        """Count a case."""
        self.statuses[ran.status] += 1
        self.memory_bytes = max(self.memory_bytes, ran.peak_bytes - empty.peak_bytes)
        self.cpu_s = max(self.cpu_s, ran.cpu_s - empty.cpu_s)
        if fault:
            self.faults[fault] += 1


class Cases:
    """Makes files and runs them. `directory`: for the files. `keep`: for those of faults, or None."""

    def __init__(self, directory: Path, *, program: bool, keep: Path | None = None, quick: bool = False) -> None:
        if not program:
            guard_standard_streams()  # before a library keeps them for its warnings
        (directory / "site").mkdir()
        self.kinds = kinds(directory / "site", quick=quick)
        self._at, self._keep = directory, keep
        self._run = Program(directory / "output").run if program else run
        self.rows = {kind.title: Row() for kind in self.kinds}
        if not program:
            self._load()
        self._empty = {(kind.title, use): self._ran(kind, use, kind.empty) for kind in self.kinds for use in kind.uses}

    def _load(self) -> None:
        """Load the modules that the commands load, so that a forked process need not."""
        shown = {(use.arguments[0], kind.how if kind.how != "binary" else kind.title): (kind, use)
                 for kind in self.kinds for use in kind.uses}  # fmt: skip
        for kind, use in shown.values():
            names = self._at / "modules"
            ended = os.fork()
            if ended == 0:
                self._list_modules(kind, use, names)
            os.waitpid(ended, 0)
            for name in names.read_text().split():
                with suppress(Exception):
                    importlib.import_module(name)
        gc.freeze()  # so that the pages of these modules stay shared

    def _list_modules(self, kind: Kind, use: Use, to: Path) -> None:
        try:
            file, out = self._placed(kind, kind.valid[0])
            null = os.open(os.devnull, os.O_RDWR)
            for number in (0, 1, 2):
                os.dup2(null, number)
            from agent.cli.main import run_cli

            run_cli(use.filled(file, out))
        finally:
            to.write_text("\n".join(sys.modules))
            os._exit(0)

    def kind(self, number: int) -> Kind:
        """The kind of the file of this number."""
        return self.kinds[number % len(self.kinds)]

    def make(self, number: int) -> tuple[Kind, bytes]:
        """The file of this number."""
        draw, kind = random.Random(f"{SEED}:{number}"), self.kind(number)
        if draw.random() < BOMBS:
            return kind, bomb(kind.title, kind.how, draw)
        return kind, mutated(kind.how, draw.choice(kind.valid), draw)

    def run(self, number: int) -> list[str]:
        """Run the file of this number through its commands; returns what is wrong."""
        kind, data = self.make(number)
        row = self.rows[kind.title]
        row.files += 1
        found = []
        for use in kind.uses:
            if (number // len(self.kinds)) % use.every:
                continue
            ran, empty = self._ran(kind, use, data), self._empty[kind.title, use]
            fault = ran.fault(use, empty, kind.how == "recording")
            row.add(ran, empty, fault)
            if fault:
                told = f"{number}: {kind.title}: {' '.join(use.filled(Path(kind.name), Path('out')))}: {fault}"
                found.append(told)
                self._save(number, kind, data, f"{told}\n{ran.output.decode(errors='replace')[-3000:]}")
        return found

    def _ran(self, kind: Kind, use: Use, data: bytes) -> Ran:
        file, out = self._placed(kind, data)
        try:
            return self._run(use.filled(file, out))
        finally:
            shutil.rmtree(out, ignore_errors=True)

    def _placed(self, kind: Kind, data: bytes) -> tuple[Path, Path]:
        folder = self._at / "case"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        for path in kind.beside:
            shutil.copy(path, folder)
        (folder / kind.name).write_bytes(data)
        return folder / kind.name, self._at / "out"

    def _save(self, number: int, kind: Kind, data: bytes, told: str) -> None:
        if self._keep is not None:
            self._keep.mkdir(parents=True, exist_ok=True)
            (self._keep / f"{number}-{kind.name}").write_bytes(data)
            (self._keep / f"{number}.txt").write_text(told)

    def table(self) -> str:
        """The result, as Markdown."""
        lines = ["| kind of file | files | runs | 0 | 2 | 3 | other | faults | most memory | most CPU time |",
                 f"|{' --- |' * 10}"]  # fmt: skip
        for title, row in self.rows.items():
            by = row.statuses
            other = by.total() - by[0] - by[2] - by[3]
            lines.append(
                f"| {title} | {row.files} | {by.total()} | {by[0]} | {by[2]} | {by[3]} | {other} |"
                f" {row.faults.total()} | {max(row.memory_bytes, 0) / 1e6:.0f} MB | {max(row.cpu_s, 0.0):.1f} s |"
            )
        return "\n".join(lines)


def main(arguments: Sequence[str]) -> int:
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after so many seconds")
    parser.add_argument("--program", action="store_true", help="start the real program for each case")
    parser.add_argument("--keep", type=Path, metavar="DIR")
    parser.add_argument("--kind", default="", metavar="TITLE", help="only kinds with this in their title")
    parser.add_argument("--quick", action="store_true", help="only kinds that are made and read within a second")
    given = parser.parse_args(arguments)
    if not given.quick:
        os.nice(10)
    end, faults = time.monotonic() + given.seconds, 0
    with tempfile.TemporaryDirectory(prefix="fieldcal-hostile-") as directory:
        cases = Cases(Path(directory), program=given.program, keep=given.keep, quick=given.quick)
        number = given.first
        while number < given.first + given.count and time.monotonic() < end:
            for told in cases.run(number) if given.kind in cases.kind(number).title else ():
                print(told, flush=True)
                faults += 1
            number += 1
            if number % 2000 == 0:
                print(f"files up to {number}\n{cases.table()}", flush=True)
    print(f"files {given.first} to {number - 1}, seed {SEED}\n{cases.table()}")
    return 3 if faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
