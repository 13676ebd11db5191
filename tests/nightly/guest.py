"""The virtual machine: QEMU without hardware acceleration, so that it runs wherever QEMU does; and a shell in it."""

from __future__ import annotations

import base64
import re
import shlex
import socket
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
START_S = 180.0  # 5 to 15 s on an idle machine
END = re.compile(rb"<ended with (\d+)>\n")


class GuestError(Exception):
    """The machine did not start, or a command in it failed or took too long."""


class Guest:
    """Context manager of the machine. `directory` holds its sockets and the kernel's messages (console.log)."""

    def __init__(self, image: Path, initramfs: bytes, directory: Path, usb: Path) -> None:
        self.console = directory / "console.log"
        self._initramfs = directory / "initramfs"
        self._initramfs.write_bytes(initramfs)
        self._shell_path = directory / "shell"
        self._command = [
            *("qemu-system-x86_64", "-accel", "tcg", "-cpu", "max", "-M", "q35", "-m", "768", "-smp", "1"),
            *("-nodefaults", "-no-user-config", "-display", "none", "-no-reboot"),
            *("-kernel", str(image), "-initrd", str(self._initramfs)),
            *("-append", "console=ttyS0 panic=-1 quiet loglevel=4 rdinit=/init nokaslr mitigations=off"),
            *("-serial", f"file:{self.console}"),
            *("-chardev", f"socket,id=shell,path={self._shell_path},server=on,wait=off", "-serial", "chardev:shell"),
            *("-virtfs", "local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap"),
            *("-device", "qemu-xhci", "-chardev", f"socket,id=usb,path={usb}", "-device", "usb-redir,chardev=usb"),
        ]

    def __enter__(self) -> Guest:
        self._process = subprocess.Popen(self._command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE)
        self._shell = socket.socket(socket.AF_UNIX)
        try:
            self._connect()
            self._read_to(re.compile(rb"ready\n"), START_S)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._shell.close()
        self._process.kill()
        self._process.communicate()

    def sh(self, command: str, timeout_s: float = 60.0) -> str:
        """Run a line of shell and return its output. Raises GuestError if it fails."""
        self._shell.sendall(command.encode() + b"\n")
        output, end = self._read_to(END, timeout_s)
        if end[1] != b"0":
            raise GuestError(f"{command}: ended with {end[1].decode()}: {output}")
        return output

    def read(self, path: str) -> str:
        """Text of a file."""
        return self.sh(f"cat {path}")

    def write(self, path: str, text: str) -> None:
        """Write text into a file of the kernel."""
        self.sh(f"echo {shlex.quote(text)} > {path}")

    def put(self, path: str, text: str) -> None:
        """Write a file of several lines. `path` is as programs of the host see it (below /run)."""
        self.sh(f"echo {base64.b64encode(text.encode()).decode()} | base64 -d > /host{path}")

    def python(self, *arguments: str, timeout_s: float = 300.0) -> str:
        """Run this Python in the machine, with the same packages and sources as on the host; returns its output."""
        return self.sh(_python(arguments), timeout_s)

    def start_python(self, *arguments: str, output: str) -> None:
        """As `python`, without waiting; the output goes to a file below /run."""
        self.sh(f"{_python(arguments)} > /host{output} 2>&1 &")

    def _connect(self) -> None:
        end_s = time.monotonic() + START_S
        while True:
            try:
                return self._shell.connect(str(self._shell_path))
            except (FileNotFoundError, ConnectionRefusedError):
                if self._process.poll() is not None or time.monotonic() > end_s:
                    _, said = self._process.communicate()
                    raise GuestError(f"QEMU did not start: {said.decode(errors='replace')}") from None
                time.sleep(0.05)

    def _read_to(self, end: re.Pattern[bytes], timeout_s: float) -> tuple[str, re.Match[bytes]]:
        data = b""
        deadline_s = time.monotonic() + timeout_s
        while (found := end.search(data)) is None:
            self._shell.settimeout(max(deadline_s - time.monotonic(), 0.01))
            try:
                part = self._shell.recv(65536)
            except TimeoutError:
                part = b""
            if not part:
                console = self.console.read_text(errors="replace")[-2000:] if self.console.exists() else ""
                raise GuestError(f"no answer within {timeout_s:g} s, so far {data!r}; console: {console}")
            data += part
        return data[: found.start()].decode(errors="replace").strip(), found


def _python(arguments: tuple[str, ...]) -> str:
    inside = f"cd {shlex.quote(str(ROOT))} && {shlex.join([sys.executable, *arguments])}"
    settings = "HOME=/run TMPDIR=/run PYTHONDONTWRITEBYTECODE=1 OPENBLAS_NUM_THREADS=1 PATH=/usr/bin:/bin"
    return f"chroot /host /usr/bin/env -i {settings} /bin/sh -c {shlex.quote(inside)}"
