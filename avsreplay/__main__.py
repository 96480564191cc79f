"""``python -m avsreplay``."""

from avsreplay.cli import main

if __name__ == "__main__":
    main()
