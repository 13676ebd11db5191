"""Starts programs from a small process, which measures them: `python -S benchmarks/spawner.py`.

The peak memory that Linux reports for a process contains that of the process from which it was forked, until it became
another program. A program that a large process starts therefore never seems smaller than that one.

Each line of standard input is [command, name of the file for its output, address space in bytes, seconds], in JSON;
each line of standard output [exit status, CPU time in s, peak memory in bytes]. The status is negative where a signal
ended the program, as after so many seconds.
"""

import json
import os
import resource
import signal
import sys


def become(command: list[str], output: str, address_space: int, seconds: int) -> None:
    """Be the program. Does not return."""
    try:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        told = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for number in (1, 2):
            os.dup2(told, number)
        resource.setrlimit(resource.RLIMIT_AS, (address_space, address_space))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.alarm(seconds)
        os.execv(command[0], command)
    finally:
        os._exit(70)


def main() -> None:
    """Start and measure one program after the other."""
    for line in sys.stdin:
        asked = json.loads(line)
        pid = os.fork()
        if pid == 0:
            become(*asked)
        _, status, used = os.wait4(pid, 0)
        figures = [os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss << 10]
        print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
