"""``avsreplay`` and ``python -m avsreplay``: pin the arithmetic, then run the command line."""

import gc

from avsreplay import arithmetic


def main() -> None:
    """Entry point of the command."""
    arithmetic.pin()  # before anything imports numpy
    gc.set_threshold(100_000)  # commands create many objects and few cycles; a full collection visits every object
    from avsreplay import cli

    cli.entry_point()


if __name__ == "__main__":
    main()
