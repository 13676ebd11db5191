"""Starts a program under the limits that a systemd unit states, without systemd: `limits.py UNIT DATA_DIR UID -- ...`.

Needs root and libseccomp. Mounts as ProtectSystem=strict leaves them, MemoryDenyWriteExecute by prctl and by systemd's
older filter, no capabilities, no new privileges, the unit's system call groups, address families and no namespaces.
Devices are not restricted here.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import socket
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

MS_REC, MS_PRIVATE, MS_BIND = 0x4000, 1 << 18, 0x1000
CLONE_NEWNS, CLONE_NEW_ANY = 0x20000, 0x7E020080
AT_FDCWD, AT_RECURSIVE, MOUNT_ATTR_RDONLY, SYS_MOUNT_SETATTR = -100, 0x8000, 1, 442
PR_CAPBSET_DROP, PR_SET_NO_NEW_PRIVS, PR_SET_MDWE, LAST_CAPABILITY = 24, 38, 65, 40
KILL, ERRNO, ALLOW = 0x80000000, 0x00050000, 0x7FFF0000
EQ, GREATER, MASKED_EQ = 4, 6, 7
FAMILIES_END = 46  # AF_MAX of today's kernels


class Comparison(ctypes.Structure):
    """scmp_arg_cmp of libseccomp: argument `arg` compared by `op`."""

    _fields_ = (("arg", ctypes.c_uint), ("op", ctypes.c_int), ("a", ctypes.c_uint64), ("b", ctypes.c_uint64))


class MountAttributes(ctypes.Structure):
    """mount_attr(2type)."""

    _fields_ = (
        ("set", ctypes.c_uint64), ("clear", ctypes.c_uint64), ("propagation", ctypes.c_uint64), ("fd", ctypes.c_uint64),
    )  # fmt: skip


LIBC = ctypes.CDLL(None, use_errno=True)


def directives(unit: Path) -> dict[str, list[str]]:
    """All values of each key in the unit file, in order."""
    found: dict[str, list[str]] = {}
    for line in unit.read_text().splitlines():
        key, separator, value = line.partition("=")
        if separator and not line.startswith("#"):
            found.setdefault(key, []).append(value)
    return found


def system_calls(filters: Iterable[str]) -> list[str]:
    """The system calls that SystemCallFilter lines allow, groups resolved; systemd adds @default to an allow-list."""
    allowed = expand("@default")
    for line in filters:
        for name in line.removeprefix("~").split():
            allowed = allowed - expand(name) if line.startswith("~") else allowed | expand(name)
    return sorted(allowed)


def expand(name: str) -> set[str]:
    """A single system call, or all calls of a group and of the groups in it."""
    if not name.startswith("@"):
        return {name}
    told = subprocess.run(["systemd-analyze", "syscall-filter", name], capture_output=True, text=True, check=True)
    lines = [line.strip() for line in told.stdout.splitlines()[1:]]
    return set().union(*(expand(line) for line in lines if line and not line.startswith("#")))


class Filter:
    """A seccomp filter. Where several filters are loaded, all of them apply."""

    def __init__(self, default: int) -> None:
        self._library = ctypes.CDLL("libseccomp.so.2")
        self._library.seccomp_init.restype = ctypes.c_void_p
        self._library.seccomp_rule_add_array.argtypes = (
            ctypes.c_void_p, ctypes.c_uint32, ctypes.c_int, ctypes.c_uint, ctypes.POINTER(Comparison),
        )  # fmt: skip
        self._context = ctypes.c_void_p(self._library.seccomp_init(ctypes.c_uint32(default)))

    def add(self, action: int, call: str, *where: tuple[int, int, int, int]) -> None:
        """Add `action` for a call with arguments as in `where`; a call that this machine does not have is ignored."""
        number = self._library.seccomp_syscall_resolve_name(call.encode())
        if number >= 0:
            comparisons = (Comparison * len(where))(*(Comparison(*one) for one in where))
            check(-self._library.seccomp_rule_add_array(self._context, action, number, len(where), comparisons))

    def load(self) -> None:
        """Load the filter; it also applies after exec."""
        check(-self._library.seccomp_load(self._context))


def check(error: int) -> None:
    """Raise OSError where the return value of a C call says that it failed."""
    if error:
        raise OSError(error, os.strerror(error))


def mount(source: str, target: str, kind: str, flags: int, options: str = "") -> None:
    """mount(2)."""
    if LIBC.mount(source.encode(), target.encode(), kind.encode(), flags, options.encode()):
        check(ctypes.get_errno())


def set_read_only(path: str, read_only: bool) -> None:
    """Set all mounts below a path read-only or writable."""
    attributes = MountAttributes(set=read_only * MOUNT_ATTR_RDONLY, clear=(not read_only) * MOUNT_ATTR_RDONLY)
    size = ctypes.sizeof(attributes)
    if LIBC.syscall(SYS_MOUNT_SETATTR, AT_FDCWD, path.encode(), AT_RECURSIVE, ctypes.byref(attributes), size):
        check(ctypes.get_errno())


def limit_files(writable: list[str], kept: Iterable[str]) -> None:
    """Make files read-only except /dev and `writable`; hide others' processes, and home directories except `kept`."""
    if LIBC.unshare(CLONE_NEWNS):
        check(ctypes.get_errno())
    mount("", "/", "", MS_REC | MS_PRIVATE)
    mount("proc", "/proc", "proc", 0, "hidepid=invisible")
    in_homes = [path for path in kept if path.startswith(("/home/", "/root/"))]
    seen = {path: os.open(path, os.O_PATH) for path in in_homes}
    for home in ("/home", "/root"):
        mount("tmpfs", home, "tmpfs", 0, "mode=755")
    for path, descriptor in seen.items():
        os.makedirs(path, exist_ok=True)
        mount(f"/proc/self/fd/{descriptor}", path, "", MS_BIND | MS_REC)
    for path in writable:
        mount(path, path, "", MS_BIND | MS_REC)
    set_read_only("/", True)
    for path in ("/dev", *writable):
        set_read_only(path, False)


def limit_rights(uid: int) -> None:
    """Change to the user `uid` without capabilities and without a way to get any."""
    for capability in range(LAST_CAPABILITY + 1):
        LIBC.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)
    os.setgroups([])
    os.setresgid(uid, uid, uid)
    os.setresuid(uid, uid, uid)
    check(LIBC.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) and ctypes.get_errno())


def limit_memory() -> None:
    """Forbid memory that is both writable and executable, as the kernel can since 6.3 and as systemd did before."""
    check(LIBC.prctl(PR_SET_MDWE, 1, 0, 0, 0) and ctypes.get_errno())
    both = mmap.PROT_WRITE | mmap.PROT_EXEC
    rules = Filter(ALLOW)
    rules.add(ERRNO | errno.EPERM, "mmap", (2, MASKED_EQ, both, both))
    for call in ("mprotect", "pkey_mprotect"):
        rules.add(ERRNO | errno.EPERM, call, (2, MASKED_EQ, mmap.PROT_EXEC, mmap.PROT_EXEC))
    rules.load()


def limit_calls(filters: list[str], families: list[str], refusal: int) -> None:
    """Allow only the system calls of the unit's groups, sockets of its address families, and no namespaces."""
    rules = Filter(ALLOW)
    known = {int(getattr(socket, family)) for family in families}
    for family in set(range(FAMILIES_END)) - known:
        rules.add(ERRNO | errno.EAFNOSUPPORT, "socket", (0, EQ, family, 0))
    rules.add(ERRNO | errno.EAFNOSUPPORT, "socket", (0, GREATER, FAMILIES_END - 1, 0))
    rules.add(ERRNO | errno.ENOSYS, "clone3")  # a filter cannot see its flags; after ENOSYS glibc calls clone
    for bit in (1 << n for n in range(32) if CLONE_NEW_ANY >> n & 1):
        rules.add(ERRNO | errno.EPERM, "clone", (0, MASKED_EQ, bit, bit))
        rules.add(ERRNO | errno.EPERM, "unshare", (0, MASKED_EQ, bit, bit))
    rules.add(ERRNO | errno.EPERM, "setns")
    rules.load()
    groups = Filter(refusal)
    for call in system_calls(filters):
        groups.add(ALLOW, call)
    groups.load()


def main() -> None:
    """Apply the limits and execute the program."""
    unit, data_dir, uid, _, *command = sys.argv[1:]
    said = directives(Path(unit))
    assert said["ProtectSystem"] == ["strict"]
    assert said["MemoryDenyWriteExecute"] == said["NoNewPrivileges"] == said["RestrictNamespaces"] == ["yes"]
    assert said["CapabilityBoundingSet"] == [""]
    paths = [path.removeprefix("-") for line in said.get("ReadWritePaths", []) for path in line.split()]
    filters, families = said["SystemCallFilter"], said["RestrictAddressFamilies"][0].split()
    limit_files(
        [data_dir, *(path for path in paths if Path(path).exists())],
        {sys.prefix, sys.base_prefix, os.getcwd(), data_dir},
    )
    limit_rights(int(uid))
    limit_memory()
    refusal = ERRNO | int(getattr(errno, said["SystemCallErrorNumber"][0])) if "SystemCallErrorNumber" in said else KILL
    limit_calls(filters, families, refusal)
    os.execvp(command[0], command)


if __name__ == "__main__":
    main()
