"""``avsreplay`` and ``python -m avsreplay``: pin the arithmetic, then run the command line."""

import gc
import sys

from avsreplay import arithmetic


def main() -> None:
    """Entry point of the command."""
    try:
        arithmetic.pin()  # before anything imports numpy
        gc.set_threshold(10_000)  # objects between two searches for cycles, of which there are few
        from avsreplay.cli import main as cli
    except KeyboardInterrupt:
        print("avsreplay: interrupted", file=sys.stderr)  # noqa: T201
        sys.exit(130)
    cli.entry_point()


if __name__ == "__main__":
    main()
