"""The same arithmetic on every x86-64 processor: the variants that libraries choose by the
processor are pinned.

OpenBLAS has one kernel for each generation of processors, numpy has SIMD variants of its functions,
and the C library has variants of the elementary functions with fused multiply-add. They round
differently. Environment variables, read when the libraries are loaded, choose the variants that
every processor with SSE4.2 has. ``pin`` sets them before numpy is loaded. The C library reads its
variable when the process starts: the command is started once more with it before it reads anything;
a script is not, and states that its arithmetic is native unless the variable was set from outside.
Other processes inherit them.

OpenBLAS runs on one thread on every system, because the result of a product on several threads
depends on their number.

``AVSREPLAY_ARITHMETIC=native`` leaves the choice to the libraries: faster, with bytes that depend
on the processor.
"""

from __future__ import annotations

import importlib
import os
import sys
import warnings

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
    set_ = all(value in os.environ.get(name, "") for name, value in PINS.items())
    pinned = has_variants() and set_ and _is_started_pinned()
    return "pinned" if pinned and not _numpy_variants() else "native"


def pin() -> str:
    """Pin the arithmetic of this process, as far as that is possible in a running process, and of
    those that it starts.

    OpenBLAS and numpy read their variables when they are loaded; the C library reads its variable
    when the process starts, so that it must be set from outside: ``python -m avsreplay.arithmetic``
    prints the variables for a shell. Nothing is changed if ``AVSREPLAY_ARITHMETIC=native`` is set,
    if the system has no such variants, or if numpy has been imported already; only the number of
    threads is limited, where numpy is loaded later.

    Returns:
        "pinned", or "native" where the bytes of results may depend on the processor.
    """
    os.environ[THREADS] = "1"  # the sums of a product on several threads depend on their number
    chosen = os.environ.get(VARIABLE) != "native" and has_variants()
    if chosen and "numpy" not in sys.modules:
        os.environ.update(_variables())
        # Where a user turns warnings into errors, numpy's about names of other versions are none.
        warnings.filterwarnings("ignore", "During parsing environment variable", ImportWarning)
    return "pinned" if chosen and _is_started_pinned() and "numpy" not in sys.modules else "native"


def start_pinned() -> None:
    """Replace this process by one that is started with the variable of the C library.

    Only for a command that has not read its input yet; a program that is not a regular file, such
    as one that is read from standard input, could not be read again and is not replaced.
    """
    chosen = os.environ.get(VARIABLE) != "native" and has_variants() and "numpy" not in sys.modules
    again = sys.executable and os.path.isfile(sys.argv[0])  # noqa: PTH113 (pathlib takes 5 ms)
    if chosen and again and not _is_started_pinned():
        os.environ.update(_variables())
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _variables() -> dict[str, str]:
    """The variables that pin the arithmetic; other tunables of the C library are kept."""
    parts = os.environ.get("GLIBC_TUNABLES", "").split(":")
    others = [part for part in parts if part and not part.startswith("glibc.cpu.hwcaps=")]
    return PINS | {"GLIBC_TUNABLES": ":".join([*others, PINS["GLIBC_TUNABLES"]])}


def _is_started_pinned() -> bool:
    """Return whether the C library has found its variable at the start of this process."""
    try:
        with open("/proc/self/environ", "rb") as stream:  # noqa: PTH123 (as above)
            found = stream.read()
    except OSError:
        return False
    given = [line for line in found.split(b"\0") if line.startswith(b"GLIBC_TUNABLES=")]
    return bool(given) and PINS["GLIBC_TUNABLES"].encode() in given[-1].partition(b"=")[2].split(
        b":"
    )


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


if __name__ == "__main__":
    for name, value in _variables().items():
        print(f"export {name}='{value}'")  # noqa: T201
