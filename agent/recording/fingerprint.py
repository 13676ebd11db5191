"""What the last bit of a result depends on beside the data: CPU kernels, libraries, threads.

numpy and OpenBLAS choose their kernels by the CPU they find; sums then differ in the last bit. Both can be told to
choose as another CPU would, by environment variables that they read when they load.
"""

from __future__ import annotations

import os
import platform
import sys

import numpy as np

# Not public, but where numpy.show_runtime has them from.
from numpy._core._multiarray_umath import __cpu_dispatch__ as _dispatched  # type: ignore[import-not-found]
from numpy._core._multiarray_umath import __cpu_features__ as _features

CORE_TYPE = "OPENBLAS_CORETYPE"
DISABLED_FEATURES = "NPY_DISABLE_CPU_FEATURES"
_AGAIN = "FIELDCAL_KERNELS_CHOSEN"


def versions() -> dict[str, str]:
    """Versions of what computes: python, numpy, scipy."""
    from importlib.metadata import version

    return {"python": platform.python_version(), "numpy": np.__version__, "scipy": version("scipy")}


def fingerprint() -> dict[str, str]:
    """All that must be the same for the same bits: versions, machine, C library, BLAS and its kernel, CPU features."""
    return versions() | {
        "machine": platform.machine(),
        "libc": " ".join(platform.libc_ver()),
        **_blas(),
        # All that numpy was built to make use of, and finds: what it lacks counts as much as what it has.
        "cpu_features": " ".join(name for name in _dispatched if _features[name]),
    }


def environment_for(recorded: dict[str, str]) -> dict[str, str] | None:
    """Environment variables with which a new process would compute as `recorded` did; None where that cannot be.

    The libraries must be the same, and this CPU must have all features of the recorded one: a kernel for a missing
    feature would end the process.
    """
    here = fingerprint()
    choosable = {"blas_kernel", "cpu_features", "blas_threads"}
    if any(recorded.get(name) != here[name] for name in here.keys() - choosable):
        return None
    features, present = (set(f.get("cpu_features", "").split()) for f in (recorded, here))
    if not features <= present:
        return None
    kernel, threads = recorded.get("blas_kernel", ""), recorded.get("blas_threads", "")
    if not kernel.isalnum() or not threads.isdecimal():
        return None
    disabled = " ".join(sorted(present - features))
    return {CORE_TYPE: kernel, "OPENBLAS_NUM_THREADS": threads, DISABLED_FEATURES: disabled}


def compute_as(recorded: dict[str, str]) -> None:
    """Begin this process anew with the kernels of `recorded`, where they differ and can be had; once only."""
    if recorded == fingerprint() or _AGAIN in os.environ:
        return
    chosen = environment_for(recorded)
    if chosen is not None:
        sys.stdout.flush()
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | chosen | {_AGAIN: "1"})


def _blas() -> dict[str, str]:
    """Kernel and threads of the BLAS that numpy loaded (scipy has its own of the same choice, but loads it late)."""
    from threadpoolctl import threadpool_info

    libraries = [info for info in threadpool_info() if info["user_api"] == "blas"]
    own = [info for info in libraries if "numpy" in info["filepath"]] or libraries
    return {
        "blas": " ".join(sorted(f"{info['internal_api']} {info['version']}" for info in own)),
        "blas_kernel": " ".join(sorted(str(info.get("architecture", "")) for info in own)),
        "blas_threads": " ".join(sorted(str(info["num_threads"]) for info in own)),
    }
