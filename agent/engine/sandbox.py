"""Starts the process of an engine inside a sandbox: no network, no other process, no file written, bounded memory.

    python -I -S -B sandbox.py MEMORY_BYTES CPU_S DIRECTORY [SITE_PACKAGES...]

This file belongs to the program that audits and not to the engine. It uses the standard library alone, closes the
sandbox, and only then imports `agent.engine.entry` from DIRECTORY.

The filter is a program of seccomp BPF (Linux, Documentation/userspace-api/seccomp_filter.rst). Four decisions:

- what computing and reading files needs is allowed; of `openat`, `clone`, `ioctl` and some others only harmless uses;
- what would change files is refused with EPERM;
- network, other processes, tracing, mounts and the like end the process at once;
- any other system call does not exist (ENOSYS), so that a C library that tries a newer one first takes the older one.
  This is also why `clone3` and `openat2` do not exist: their flags stand behind a pointer, which no filter can read
  (opencontainers/runc, pull request 2750; moby/moby, issue 42680).

A filter that does not look at the architecture can be passed by with the calls of another one; on x86_64 those of x32
have bit 30 set. Root can raise its own limits, so `prlimit64` may only read them.
"""

from __future__ import annotations

import ctypes
import errno
import os
import resource
import signal
import struct
import sys

NO_SANDBOX = 71  # exit status where no sandbox can be made; the reason is on standard error

# Numbers of system calls: Linux, arch/x86/entry/syscalls/syscall_64.tbl and include/uapi/asm-generic/unistd.h.
# A number is None where the architecture does not have the call.
_ALLOWED = {  # name: (x86_64, aarch64)
    "read": (0, 63), "write": (1, 64), "close": (3, 57), "stat": (4, None), "fstat": (5, 80), "lstat": (6, None),
    "poll": (7, None), "lseek": (8, 62), "mmap": (9, 222), "mprotect": (10, 226), "munmap": (11, 215),
    "brk": (12, 214), "rt_sigaction": (13, 134), "rt_sigprocmask": (14, 135), "rt_sigreturn": (15, 139),
    "pread64": (17, 67), "readv": (19, 65), "writev": (20, 66), "access": (21, None), "select": (23, None),
    "sched_yield": (24, 124), "mremap": (25, 216), "mincore": (27, 232), "madvise": (28, 233), "dup": (32, 23),
    "dup2": (33, None), "nanosleep": (35, 101), "getpid": (39, 172), "exit": (60, 93), "uname": (63, 160),
    "getcwd": (79, 17), "readlink": (89, None), "gettimeofday": (96, 169), "getrlimit": (97, 163),
    "getrusage": (98, 165), "sysinfo": (99, 179), "times": (100, 153), "getuid": (102, 174), "getgid": (104, 176),
    "geteuid": (107, 175), "getegid": (108, 177), "getppid": (110, 173), "sigaltstack": (131, 132),
    "statfs": (137, 43), "fstatfs": (138, 44), "arch_prctl": (158, None), "gettid": (186, 178), "time": (201, None),
    "futex": (202, 98), "sched_getaffinity": (204, 123), "getdents64": (217, 61), "set_tid_address": (218, 96),
    "restart_syscall": (219, 128), "fadvise64": (221, 223), "clock_gettime": (228, 113), "clock_getres": (229, 114),
    "clock_nanosleep": (230, 115), "exit_group": (231, 94), "newfstatat": (262, 79), "readlinkat": (267, 78),
    "faccessat": (269, 48), "pselect6": (270, 72), "ppoll": (271, 73), "set_robust_list": (273, 99),
    "dup3": (292, 24), "getcpu": (309, 168), "getrandom": (318, 278), "membarrier": (324, 283), "statx": (332, 291),
    "rseq": (334, 293), "faccessat2": (439, 439),
}  # fmt: skip
_REFUSED = {
    "rename": (82, None), "mkdir": (83, None), "rmdir": (84, None), "creat": (85, None), "link": (86, None),
    "unlink": (87, None), "symlink": (88, None), "chmod": (90, None), "fchmod": (91, 52), "chown": (92, None),
    "fchown": (93, 55), "lchown": (94, None), "truncate": (76, 45), "ftruncate": (77, 46), "fallocate": (285, 47),
    "utime": (132, None), "mknod": (133, None), "setrlimit": (160, 164), "setxattr": (188, 5), "lsetxattr": (189, 6),
    "fsetxattr": (190, 7), "removexattr": (197, 14), "lremovexattr": (198, 15), "fremovexattr": (199, 16),
    "utimes": (235, None), "mkdirat": (258, 34), "mknodat": (259, 33), "fchownat": (260, 54), "futimesat": (261, None),
    "unlinkat": (263, 35), "renameat": (264, 38), "linkat": (265, 37), "symlinkat": (266, 36), "fchmodat": (268, 53),
    "utimensat": (280, 88), "renameat2": (316, 276), "fchmodat2": (452, 452),
}  # fmt: skip
_ENDING = {
    "socket": (41, 198), "connect": (42, 203), "accept": (43, 202), "sendto": (44, 206), "recvfrom": (45, 207),
    "sendmsg": (46, 211), "recvmsg": (47, 212), "bind": (49, 200), "listen": (50, 201), "socketpair": (53, 199),
    "accept4": (288, 242), "recvmmsg": (299, 243), "sendmmsg": (307, 269), "fork": (57, None), "vfork": (58, None),
    "execve": (59, 221), "execveat": (322, 281), "unshare": (272, 97), "setns": (308, 268), "tkill": (200, 130),
    "rt_sigqueueinfo": (129, 138), "rt_tgsigqueueinfo": (297, 240), "pidfd_open": (434, 434),
    "pidfd_send_signal": (424, 424), "pidfd_getfd": (438, 438), "ptrace": (101, 117), "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271), "kcmp": (312, 272), "mount": (165, 40), "umount2": (166, 39),
    "pivot_root": (155, 41), "chroot": (161, 51), "open_tree": (428, 428), "move_mount": (429, 429),
    "fsopen": (430, 430), "fsconfig": (431, 431), "fsmount": (432, 432), "open_by_handle_at": (304, 265),
    "bpf": (321, 280), "perf_event_open": (298, 241), "userfaultfd": (323, 282), "seccomp": (317, 277),
    "io_uring_setup": (425, 425), "io_uring_enter": (426, 426), "io_uring_register": (427, 427),
    "io_setup": (206, 0), "io_submit": (209, 2), "init_module": (175, 105), "finit_module": (313, 273),
    "kexec_load": (246, 104), "reboot": (169, 142), "swapon": (167, 224), "add_key": (248, 217),
    "request_key": (249, 218), "keyctl": (250, 219), "setuid": (105, 146), "setgid": (106, 144),
    "setresuid": (117, 147), "setresgid": (119, 149), "capset": (126, 91), "personality": (135, 92),
}  # fmt: skip
# Calls that are allowed for some values of an argument.
_OPEN, _OPENAT, _CLONE, _IOCTL, _FCNTL, _PRCTL, _PRLIMIT64, _KILL, _TGKILL = (
    (2, None), (257, 56), (56, 220), (16, 29), (72, 25), (157, 167), (302, 261), (62, 129), (234, 131),
)  # fmt: skip
# asm-generic/fcntl.h: O_WRONLY, O_RDWR, O_CREAT, O_TRUNC, O_APPEND, the same for both architectures. O_TMPFILE needs
# one of the first two.
_WRITING = 0o1 | 0o2 | 0o100 | 0o1000 | 0o2000
_THREAD = 0x00010000  # linux/sched.h: CLONE_THREAD
_NAMESPACES = 0x7E020000  # the flags CLONE_NEW...
_IOCTLS = (0x5401, 0x5413, 0x5450, 0x5451)  # asm-generic/ioctls.h: TCGETS, TIOCGWINSZ, FIONCLEX, FIOCLEX
_FCNTLS = (0, 1, 2, 3, 4, 1030)  # linux/fcntl.h: F_DUPFD, F_GETFD, F_SETFD, F_GETFL, F_SETFL, F_DUPFD_CLOEXEC
_PRCTLS = (15, 16, 0x53564D41)  # linux/prctl.h: PR_SET_NAME, PR_GET_NAME, PR_SET_VMA (a name for memory)

_ARCHITECTURES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}  # column above, AUDIT_ARCH of linux/audit.h
_X32 = 0x40000000
# linux/bpf_common.h: BPF_LD|BPF_W|BPF_ABS, BPF_JMP|BPF_JEQ|BPF_K, |BPF_JGE, |BPF_JSET, BPF_RET|BPF_K
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
# linux/seccomp.h
_ALLOW, _ERROR, _END = 0x7FFF0000, 0x00050000, 0x80000000
_NUMBER, _ARCHITECTURE, _ARGUMENTS = 0, 4, 16  # offsets in struct seccomp_data; both architectures are little-endian
_SET_NO_NEW_PRIVS, _SET_SECCOMP, _FILTER_MODE = 38, 22, 2  # linux/prctl.h, linux/seccomp.h

_Instruction = tuple[int, int, int, int]  # code, jump where true, jump where false, constant


class SandboxError(Exception):
    """No sandbox can be made on this machine. The message says why."""


def filter_program(machine: str, process: int) -> bytes:
    """The filter for a process with this number, as an array of struct sock_filter. Raises SandboxError."""
    if machine not in _ARCHITECTURES:
        raise SandboxError(f"there is no filter for the architecture {machine}, only for {', '.join(_ARCHITECTURES)}")
    column, audit = _ARCHITECTURES[machine]
    refuse = _ERROR | errno.EPERM
    program: list[_Instruction] = [
        (_LOAD, 0, 0, _ARCHITECTURE), (_EQUAL, 1, 0, audit), (_RETURN, 0, 0, _END),
        (_LOAD, 0, 0, _NUMBER), (_AT_LEAST, 0, 1, _X32), (_RETURN, 0, 0, _END),
    ]  # fmt: skip
    for calls, decision in ((_ALLOWED, _ALLOW), (_REFUSED, refuse), (_ENDING, _END)):
        for numbers in calls.values():
            program += _for_call(numbers[column], [(_RETURN, 0, 0, decision)])
    # What is looked at is 32 bits wide in the kernel, but for the flags of `clone`, whose upper half has no meaning,
    # and for the pointer of `prlimit64`.
    allow, end = (_RETURN, 0, 0, _ALLOW), (_RETURN, 0, 0, _END)
    program += _for_call(_OPEN[column], [*_where_set(1, _WRITING, refuse), allow])
    program += _for_call(_OPENAT[column], [*_where_set(2, _WRITING, refuse), allow])
    program += _for_call(_CLONE[column], [*_where_set(0, _NAMESPACES, _END), *_where_set(0, _THREAD, _ALLOW), end])
    program += _for_call(_IOCTL[column], _one_of(1, _IOCTLS, refuse))
    program += _for_call(_FCNTL[column], _one_of(1, _FCNTLS, refuse))
    program += _for_call(_PRCTL[column], _one_of(0, _PRCTLS, refuse))
    low, high = _ARGUMENTS + 8 * 2, _ARGUMENTS + 8 * 2 + 4
    reading = [(_LOAD, 0, 0, low), (_EQUAL, 0, 2, 0), (_LOAD, 0, 0, high), (_EQUAL, 1, 0, 0), (_RETURN, 0, 0, refuse)]
    program += _for_call(_PRLIMIT64[column], [*reading, allow])
    for call in (_KILL, _TGKILL):
        program += _for_call(call[column], _one_of(0, (process,), _END))
    program.append((_RETURN, 0, 0, _ERROR | errno.ENOSYS))
    return b"".join(struct.pack("<HBBI", *instruction) for instruction in program)


def _for_call(number: int | None, then: list[_Instruction]) -> list[_Instruction]:
    """`then`, which ends with a return, where the loaded number is that of the call."""
    return [] if number is None else [(_EQUAL, 0, len(then), number), *then]


def _where_set(argument: int, bits: int, decision: int) -> list[_Instruction]:
    """A decision where any of the bits is set in an argument; elsewhere the program goes on."""
    return [(_LOAD, 0, 0, _ARGUMENTS + 8 * argument), (_ANY_BIT, 0, 1, bits), (_RETURN, 0, 0, decision)]


def _one_of(argument: int, values: tuple[int, ...], otherwise: int) -> list[_Instruction]:
    """Allow where an argument has one of the values."""
    load = (_LOAD, 0, 0, _ARGUMENTS + 8 * argument)
    tests = [(_EQUAL, len(values) - index, 0, value) for index, value in enumerate(values)]
    return [load, *tests, (_RETURN, 0, 0, otherwise), (_RETURN, 0, 0, _ALLOW)]


def close_sandbox(memory_bytes: int, cpu_s: int) -> None:
    """Limit this process and install the filter. Both last until it ends. Raises SandboxError."""
    if struct.calcsize("P") != 8:
        raise SandboxError("this Python is a 32-bit program")
    limits = {"AS": memory_bytes, "CPU": cpu_s, "FSIZE": 0, "CORE": 0, "NOFILE": 64}
    for name, value in limits.items():
        limit: int = getattr(resource, f"RLIMIT_{name}")
        hard = resource.getrlimit(limit)[1]
        lowest = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(limit, (lowest, hard if name == "CPU" else lowest))  # at its hard limit of CPU it is killed
    signal.alarm(2 * cpu_s)  # it must not outlive the program that started it, even where it sleeps
    _install(filter_program(os.uname().machine, os.getpid()))
    try:
        os.close(os.open(os.devnull, os.O_WRONLY))
    except PermissionError:
        return
    raise SandboxError("this kernel accepts a filter of system calls but does not apply it")


def _install(program: bytes) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    prctl = libc.prctl
    prctl.argtypes = [ctypes.c_int, *[ctypes.c_ulong] * 4]
    code = ctypes.create_string_buffer(program, len(program))
    header = ctypes.create_string_buffer(struct.pack("@HP", len(program) // 8, ctypes.addressof(code)))
    if prctl(_SET_NO_NEW_PRIVS, 1, 0, 0, 0) or prctl(_SET_SECCOMP, _FILTER_MODE, ctypes.addressof(header), 0, 0):
        number = ctypes.get_errno()
        raise SandboxError(f"this kernel or container installs no filter of system calls: {os.strerror(number)}")


def main() -> None:
    """Close the sandbox and run the engine; see the top of this file."""
    memory_bytes, cpu_s, directory, *packages = sys.argv[1:]
    try:
        close_sandbox(int(memory_bytes), int(cpu_s))
    except (SandboxError, OSError, ValueError) as error:
        print(error, file=sys.stderr)
        sys.exit(NO_SANDBOX)
    sys.path[:0] = [directory]
    sys.path += packages
    from agent.engine import entry  # that of the engine

    entry.main()


if __name__ == "__main__":
    main()
