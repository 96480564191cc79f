"""Reading of files takes the memory of their content."""

from __future__ import annotations

import pytest

from avsreplay.binary_files import read_limited
from avsreplay.errors import UnreadableInput


def test_reading_a_file_allocates_its_size_and_not_the_limit(tmp_path):
    """``read(n)`` allocates n bytes; Windows refuses 16 GiB, the limit of a checkpoint."""
    path = tmp_path / "file"
    path.write_bytes(b"seven")
    assert read_limited(path, 1 << 62, "") == b"seven"
    with pytest.raises(UnreadableInput, match="larger than 0 MiB"):
        read_limited(path, 4, "")
