"""``avsreplay`` and ``python -m avsreplay``: pin the arithmetic, then run the command line."""

from avsreplay import arithmetic


def main() -> None:
    """Entry point of the command."""
    arithmetic.pin()  # before anything imports numpy
    from avsreplay import cli

    cli.entry_point()


if __name__ == "__main__":
    main()
