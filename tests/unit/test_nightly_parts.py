"""What the nightly comparison with Debian's kernel is made of, as far as it needs no virtual machine."""

from __future__ import annotations

import gzip
import lzma
import socket
import struct
from pathlib import Path

import numpy as np
import pytest

from hw.virtual.kernel import installed
from tests.nightly.answers import answers, held
from tests.nightly.debian_kernel import DebianKernel
from tests.nightly.initramfs import initramfs
from tests.nightly.site import Twins
from tests.nightly.tiny_usb import HEAD, HELLO_HEAD, TinyUsb

NODE = "/dev/i2c-1"
FROM_HOST, TO_HOST = 0x41, 0xC1
CONTROL = struct.Struct("<BBBBHHH")


@pytest.fixture
def twins() -> Twins:
    twins = Twins()
    twins.hold((1, -1, 0))
    return twins


def test_the_stand_in_answers_as_linux_6_12_did(twins: Twins) -> None:
    """Written down from the virtual machine; `make nightly` asks the kernel anew."""
    with installed({NODE: twins.bus}):
        found = answers(NODE)
        twins.bus.claimed.add(0x68)
        found |= held(NODE, 0x68)
    assert {question: found[question] for question in found if found[question].startswith("E")} == {
        "no device, byte": "ENXIO",
        "no device, transfer": "ENXIO",
        "43 messages": "EINVAL",
        "8193 bytes": "EINVAL",
        "no such node": "ENOENT",
        "held by a kernel driver, byte": "EBUSY",
    }
    assert found["4 registers in one transfer"] == "ad1ded01"
    assert found["byte written and read back"] == "[90, 0]"


class Qemu:
    """The other end of the redirection."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(10)
        self._socket.connect(str(path))
        self._socket.sendall(HELLO_HEAD.pack(0, 68, 0) + b"test".ljust(64, b"\0") + struct.pack("<I", 0x70))
        self._number = 0

    def receive(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            data += self._socket.recv(count - len(data))
        return data

    def packet(self) -> tuple[int, int, bytes]:
        kind, length, number = HEAD.unpack(self.receive(HEAD.size))
        return kind, number, self.receive(length)

    def control(self, kind: int, request: int, value: int, index: int, data: bytes | int) -> tuple[int, bytes]:
        """Status and what came back; `data` is what is sent, or how much is wanted."""
        self._number += 1
        length = data if isinstance(data, int) else len(data)
        content = CONTROL.pack(kind & 0x80, request, kind, 0, value, index, length)
        content += b"" if isinstance(data, int) else data
        self._socket.sendall(HEAD.pack(100, len(content), self._number) + content)
        answered, number, content = self.packet()
        assert (answered, number) == (100, self._number)
        return CONTROL.unpack_from(content)[3], content[CONTROL.size :]

    def close(self) -> None:
        self._socket.close()


def test_the_adapter_over_usb_redirection(twins: Twins, tmp_path: Path) -> None:
    with TinyUsb(twins.bus, tmp_path / "usb") as adapter:
        qemu = Qemu(tmp_path / "usb")
        assert HELLO_HEAD.unpack(qemu.receive(HELLO_HEAD.size)) == (0, 68, 0)
        qemu.receive(68)
        assert [qemu.packet()[0] for _ in range(3)] == [4, 5, 1]  # interfaces, endpoints, connected
        status, descriptor = qemu.control(0x80, 6, 0x0100, 0, 18)
        assert (status, descriptor[8:12]) == (0, bytes.fromhex("0304 31c6"))
        assert qemu.control(FROM_HOST, 5, 0, 0x1D, b"\0") == (0, b"")
        assert qemu.control(TO_HOST, 3, 0, 0, 1) == (0, b"\x01")  # acknowledged
        assert qemu.control(TO_HOST, 6, 1, 0x1D, 4) == (0, bytes.fromhex("ad1ded01"))
        assert qemu.control(TO_HOST, 7, 1, 0x55, 4) == (0, bytes(4))
        assert qemu.control(TO_HOST, 3, 0, 0, 1) == (0, b"\x02")  # nobody there
        assert qemu.control(TO_HOST, 0x33, 0, 0, 1)[0] == 4  # stall
        adapter.unplug()
        assert qemu.packet()[0] == 2
        qemu.close()


def test_modules_load_after_what_they_need(tmp_path: Path) -> None:
    modules = tmp_path / "lib" / "modules" / "6.0"
    (modules / "kernel" / "drivers").mkdir(parents=True)
    (tmp_path / "boot").mkdir()
    (tmp_path / "boot" / "vmlinuz-6.0").touch()
    (modules / "modules.builtin").write_text("kernel/drivers/core.ko\n")
    for name, depends in {"a-chip": "bus,core", "bus": "b_ase", "b-ase": ""}.items():
        content = lzma.compress(f"ELF\0depends={depends}\0name={name}\0".encode())
        (modules / "kernel" / "drivers" / f"{name}.ko.xz").write_bytes(content)
    kernel = DebianKernel(tmp_path)
    assert kernel.release == "6.0"
    assert list(kernel.modules(["a_chip", "bus"])) == ["b_ase", "bus", "a_chip"]
    with pytest.raises(KeyError, match="absent"):
        kernel.modules(["absent"])


def test_the_archive_is_what_the_kernel_unpacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    busybox = tmp_path / "busybox"
    busybox.write_bytes(b"five!")
    busybox.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    archive = gzip.decompress(initramfs({"one": b"1", "two": b"22"}))
    found = {}
    at = 0
    while not archive[at + 110 :].startswith(b"TRAILER!!!\0"):
        # newc: magic, then 13 numbers of 8 hexadecimal digits; header with name and content each end at a multiple of 4
        assert archive[at : at + 6] == b"070701"
        numbers = [int(archive[at + 6 + 8 * i : at + 14 + 8 * i], 16) for i in range(13)]
        mode, size, name_size = numbers[1], numbers[6], numbers[11]
        name = archive[at + 110 : at + 109 + name_size].decode()
        begin = at + int(np.ceil((110 + name_size) / 4)) * 4
        found[name] = oct(mode), archive[begin : begin + size]
        at = begin + int(np.ceil(size / 4)) * 4
    assert found["bin"] == found["modules"] == ("0o40755", b"")
    assert found["bin/busybox"] == ("0o100755", b"five!")
    assert found["modules/00-one.ko"][1] == b"1"
    assert found["modules/01-two.ko"][1] == b"22"
    assert found["init"][1].startswith(b"#!/bin/busybox sh\n")
