"""``avsreplay`` and ``python -m avsreplay``: prepare the process, then run the command line."""

import gc
import os
import sys
import warnings

from avsreplay import arithmetic

LEAST_DESCRIPTORS = 12  # files that a command may have open at once, with those of its libraries


def main() -> None:
    """Entry point of the command."""
    try:
        _open_standard_streams()
        _check_descriptors()
        if not sys.flags.dev_mode:  # warnings of libraries are no errors of the user
            warnings.simplefilter("ignore")
            os.environ["PYTHONWARNINGS"] = "ignore"
        arithmetic.start_pinned()
        arithmetic.pin()  # before anything imports numpy
        gc.set_threshold(10_000)  # objects between two searches for cycles, of which there are few
        from avsreplay.cli import main as cli
    except KeyboardInterrupt:
        from avsreplay.cli import interrupts

        interrupts.forget()
        print("avsreplay: interrupted", file=sys.stderr)  # noqa: T201
        sys.exit(130)
    cli.entry_point()


def _open_standard_streams() -> None:
    """Open the null device in place of closed standard streams: the files that the command opens
    would take their numbers, and receive what is printed.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number, which is this one
        if getattr(sys, name) is None:
            mode = "r" if name == "stdin" else "w"
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115


def _check_descriptors() -> None:
    """End the command where too few files can be opened: a missing module would be reported in
    place of the cause.
    """
    opened: list[int] = []
    try:
        for _ in range(LEAST_DESCRIPTORS):
            opened.append(os.open(os.devnull, os.O_RDONLY))
    except OSError:
        for number in opened:
            os.close(number)
        text = (
            f"avsreplay: fewer than {LEAST_DESCRIPTORS} more files can be opened; raise 'ulimit -n'"
        )
        print(text, file=sys.stderr)  # noqa: T201
        sys.exit(3)
    for number in opened:
        os.close(number)


if __name__ == "__main__":
    main()
