"""The same arithmetic on every x86-64 processor: the variants that libraries choose by the
processor are pinned.

OpenBLAS has one kernel for each generation of processors, numpy has SIMD variants of its functions,
and the C library has variants of the elementary functions with fused multiply-add. They round
differently. Environment variables, read when the libraries are loaded, choose the variants that
every processor with SSE4.2 has. The command line sets them and starts itself once more, because the
C library reads its variable when the process starts. Other processes inherit them.

OpenBLAS runs on one thread on every system, because the result of a product on several threads
depends on their number.

``AVSREPLAY_ARITHMETIC=native`` leaves the choice to the libraries: faster, with bytes that depend
on the processor.
"""

from __future__ import annotations

import importlib
import os
import sys

VARIABLE = "AVSREPLAY_ARITHMETIC"
CHOICES = ("pinned", "native")
# numpy names the variants by feature up to 2.3 and by level of the architecture from 2.4 on; it
# ignores unknown names.
_NUMPY = (
    "AVX F16C FMA3 FMA4 AVX2 AVX512F AVX512CD AVX512_KNL AVX512_KNM AVX512_SKX AVX512_CLX"
    " AVX512_CNL AVX512_ICL"
)
PINS = {
    "OPENBLAS_CORETYPE": "Nehalem",  # Prescott's blocks would depend on the size of the cache
    "NPY_DISABLE_CPU_FEATURES": f"{_NUMPY} AVX512_SPR X86_V3 X86_V4",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX2_Usable,-FMA_Usable,-FMA4_Usable",
}

THREADS = "OPENBLAS_NUM_THREADS"


def has_variants() -> bool:
    """Return whether this system has the variants that ``PINS`` names: Linux with glibc on
    x86-64.
    """
    if not sys.platform.startswith("linux") or os.uname().machine != "x86_64":
        return False
    try:
        return (os.confstr("CS_GNU_LIBC_VERSION") or "").startswith("glibc")
    except (OSError, ValueError):
        return False


def state() -> str:
    """Return ``"pinned"`` or ``"native"`` for this process, for ``run.json``."""
    pinned = has_variants() and all(
        value in os.environ.get(name, "") for name, value in PINS.items()
    )
    return "pinned" if pinned and not _numpy_variants() else "native"


def pin() -> None:
    """Pin the arithmetic of this process and of those that it starts; the process may be replaced
    by a new one.

    It only limits the number of threads if ``AVSREPLAY_ARITHMETIC=native`` is set, if the system
    has no such variants, or if numpy has been imported already. The limit takes effect if numpy is
    loaded later.
    """
    os.environ[THREADS] = "1"  # the sums of a product on several threads depend on their number
    if (
        os.environ.get(VARIABLE) == "native"
        or "numpy" in sys.modules
        or not sys.executable
        or not has_variants()
    ):
        return
    glibc = os.environ.get("GLIBC_TUNABLES", "")
    os.environ.update(PINS)
    if PINS["GLIBC_TUNABLES"] in glibc.split(":"):
        os.environ["GLIBC_TUNABLES"] = glibc
        return
    others = [
        part for part in glibc.split(":") if part and not part.startswith("glibc.cpu.hwcaps=")
    ]
    os.environ["GLIBC_TUNABLES"] = ":".join([*others, PINS["GLIBC_TUNABLES"]])
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _numpy_variants() -> bool:
    """Return whether numpy uses a variant that not every processor has: it may have been
    imported before the pin.
    """
    core = importlib.import_module(
        "numpy._core._multiarray_umath"
    )  # numpy states this nowhere else as data
    variants = [
        name for name in core.__cpu_dispatch__ if name.startswith(("AVX", "FMA", "F16C", "X86_"))
    ]
    return any(core.__cpu_features__[name] for name in variants)
