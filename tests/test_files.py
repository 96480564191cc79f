"""Outputs of every kind of file node, failures while writing, and numpy archives and JSON that are
not as declared.
"""

from __future__ import annotations

import errno
import io
import json
import os
import re
import shutil
import stat
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest

from avsreplay import files
from avsreplay.binary_files import read_npz
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.files import check_output, output_folder, output_path, output_text
from avsreplay.report.jsonl import parse_json

posix = pytest.mark.skipif(os.name != "posix", reason="file nodes of POSIX")


def write(path: Path, text: str = "new", **options: bool) -> None:
    with output_text(path, **options) as stream:
        stream.write(text)


def only(folder: Path, *names: str) -> bool:
    return sorted(p.name for p in folder.iterdir()) == sorted(names)


def test_a_file_is_replaced_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    path.chmod(0o640)
    with output_text(path) as stream:
        stream.write("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert os.name == "nt" or stat.S_IMODE(path.stat().st_mode) == 0o640
    assert only(tmp_path, "a.txt")


def test_a_failure_keeps_the_old_file_and_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail() -> None:
        with output_text(path) as stream:
            stream.write("new")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "old"
    assert only(tmp_path, "a.txt")


def test_a_full_disk_is_one_line_and_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with (
        pytest.raises(UnreadableInput, match="No space left on device; nothing was changed"),
        output_path(path),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert path.read_text() == "old"


def test_an_error_in_a_file_of_a_folder_names_the_folder_and_not_its_temporary_name(
    tmp_path: Path,
) -> None:
    with (
        pytest.raises(
            UnreadableInput,
            match=rf"{re.escape(str(tmp_path / 'result' / 'a.txt'))}: cannot be written",
        ),
        output_folder(tmp_path / "result") as part,
        output_path(part / "a.txt"),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


@posix
def test_a_device_is_written_and_never_replaced(tmp_path: Path) -> None:
    node = tmp_path / "null"
    node.symlink_to("/dev/null")
    for path in (Path("/dev/null"), node):
        write(path)
        assert stat.S_ISCHR(path.stat().st_mode)
    assert node.is_symlink()
    assert only(tmp_path, "null")
    with pytest.raises(UnreadableInput, match="No space left"):
        write(Path("/dev/full"), "x" * 100_000)
    assert stat.S_ISCHR(Path("/dev/full").stat().st_mode)


@posix
def test_a_fifo_receives_the_output(tmp_path: Path) -> None:
    fifo, got = tmp_path / "fifo", []
    os.mkfifo(fifo)
    reader = threading.Thread(target=lambda: got.append(fifo.read_text()))
    reader.start()
    write(fifo, "through the pipe")
    reader.join(10)
    assert got == ["through the pipe"]
    assert stat.S_ISFIFO(fifo.stat().st_mode)


@posix
def test_a_symbolic_link_is_followed_and_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    target, link = tmp_path / "there" / "target.txt", tmp_path / "link"
    link.symlink_to(target)
    write(link, "one")  # a link to a file that does not exist yet
    write(link, "two")
    assert link.is_symlink()
    assert target.read_text() == "two"
    assert only(tmp_path / "there", "target.txt")
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    with pytest.raises(UsageError, match="symbolic link"):
        check_output(tmp_path / "a")


@pytest.mark.parametrize(
    "name", ["", ".", "..", "x" * 256, "a\0b", "a\udcff", "missing/a", "file/a", "folder"]
)
def test_names_that_cannot_be_written_are_refused_before_any_work(
    name: str, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    path = tmp_path / name if name.strip(".") else Path(name)
    with pytest.raises(UsageError) as refused:
        check_output(path)
    assert "\n" not in str(refused.value)
    str(refused.value).encode("utf-8")
    assert only(tmp_path, "file", "folder")


@pytest.mark.parametrize("name", ["", ".", "/", "-", "file", "x" * 256])
def test_folders_that_cannot_be_written_are_refused_before_any_work(
    name: str, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    path = tmp_path / name if name in ("file", "x" * 256) else Path(name)
    with pytest.raises(UsageError):
        check_output(path, folder=True)


def test_an_existing_output_needs_overwrite(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.touch()
    with pytest.raises(UsageError, match="--overwrite"):
        check_output(path, overwrite=False)


def test_two_writers_at_once_leave_one_complete_file(tmp_path: Path) -> None:
    path, texts, done = tmp_path / "a.txt", [str(k) * 200_000 for k in range(8)], []
    threads = [
        threading.Thread(target=lambda text: done.append(write(path, text)), args=(text,))
        for text in texts
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(done) == len(texts)
    assert path.read_text() in texts
    assert only(tmp_path, "a.txt")


def test_a_file_that_appears_meanwhile_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"

    def both() -> None:
        with output_text(path, overwrite=False) as stream:
            stream.write("mine")
            path.write_text("theirs")

    with pytest.raises(UsageError, match="appeared"):
        both()
    assert path.read_text() == "theirs"
    assert only(tmp_path, "a.txt")


@posix
def test_the_parts_of_a_killed_process_are_removed_and_those_of_a_living_one_kept(
    tmp_path: Path,
) -> None:
    code = (
        "import sys; from pathlib import Path; from avsreplay.files import output_text\n"
        "with output_text(Path(sys.argv[1])) as stream:\n"
        "    stream.write('half'); stream.flush(); print('ready', flush=True); sys.stdin.read()"
    )
    path = tmp_path / "a.txt"
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert other.stdout is not None
    assert other.stdout.readline() == "ready\n"
    write(path)
    assert len(list(tmp_path.glob(".a.txt.*.part"))) == 1
    other.kill()
    other.wait()
    code = (
        "import sys; from avsreplay.files import output_text\n"
        "with output_text(sys.argv[1]) as stream: stream.write('new')"
    )
    subprocess.run([sys.executable, "-c", code, str(path)], check=True)
    assert only(tmp_path, "a.txt")


@posix
@pytest.mark.parametrize("locked", [False, True])
@pytest.mark.parametrize("output", [output_path, output_folder])
def test_a_part_that_another_process_takes_for_a_leftover_is_made_again(
    tmp_path, monkeypatch, output, locked
) -> None:
    """The other process comes between the creation and the lock, or waits for the lock."""
    lock, taken = files.lock, []

    def late(part, **options):
        if taken:
            return lock(part, **options)
        taken.append(part)
        made = lock(part, **options) if locked else None
        shutil.rmtree(part) if part.is_dir() else part.unlink()
        return made if locked else lock(part, **options)

    monkeypatch.setattr(files, "lock", late)
    with output(tmp_path / "x") as part:
        (part / "file" if part.is_dir() else part).write_text("complete")
    assert taken
    assert (
        tmp_path / "x" / "file" if output is output_folder else tmp_path / "x"
    ).read_text() == "complete"
    assert only(tmp_path, "x")


@posix
def test_a_folder_that_another_process_writes_is_refused_before_any_work(tmp_path: Path) -> None:
    """Neither result may replace the other unseen; another folder beside it may be written."""
    code = (
        "import sys; from pathlib import Path; from avsreplay.files import output_folder\n"
        "with output_folder(Path(sys.argv[1])) as part:\n"
        "    print('ready', flush=True); sys.stdin.readline(); (part / 'rows').write_text('theirs')"
    )
    place, entered = tmp_path / "result", []

    def write_folder(name: str) -> None:
        with output_folder(tmp_path / name) as part:
            entered.append(name)
            (part / "rows").write_text("mine")

    command = [sys.executable, "-c", code, str(place)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "ready\n"
        with pytest.raises(UsageError, match="result: another process is writing it"):
            write_folder("result")
        write_folder("results")
        assert entered == ["results"]
        other.communicate("\n")
    assert (place / "rows").read_text() == "theirs"
    assert only(tmp_path, "result", "results")
    write_folder("result")  # the other process has ended
    assert (place / "rows").read_text() == "mine"


def test_a_folder_is_replaced_when_it_is_complete(tmp_path: Path) -> None:
    place = tmp_path / "result"
    for text in ("one", "two"):
        with output_folder(place) as part:
            (part / "file").write_text(text)
        assert (place / "file").read_text() == text

    def fail() -> None:
        with output_folder(place) as part:
            (part / "file").write_text("three")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert (place / "file").read_text() == "two"
    assert only(tmp_path, "result")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems have no such call")
def test_a_folder_is_replaced_in_one_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that is killed leaves the former folder or the new one, never none."""
    place = tmp_path / "result"
    place.mkdir()
    (place / "file").write_text("one")
    monkeypatch.setattr(Path, "rename", None)
    with output_folder(place) as part:
        (part / "file").write_text("two")
    assert (place / "file").read_text() == "two"
    assert only(tmp_path, "result")


def test_a_folder_that_the_system_cannot_exchange_is_replaced_in_two_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_exchange", lambda *_: False)
    for text in ("one", "two"):
        with output_folder(tmp_path / "result", ["file"]) as part:
            (part / "file").write_text(text)
    assert (tmp_path / "result" / "file").read_text() == "two"
    assert only(tmp_path, "result")


@posix
def test_a_link_to_a_folder_is_followed(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there")
    with output_folder(tmp_path / "link") as part:
        (part / "file").touch()
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "there" / "file").is_file()


SHAPES = {"n": ("i8", ()), "x": ("f8", (2,))}  # of each record


def archive(tmp_path: Path, **arrays: np.ndarray) -> Path:
    path = tmp_path / "a.npz"
    np.savez(path, **arrays)
    return path


def test_arrays_come_back_as_they_were_written(tmp_path: Path) -> None:
    n, x = np.arange(5, dtype=np.int32), np.random.default_rng(1).normal(size=(3, 2))
    found = read_npz(archive(tmp_path, n=n, x=x), SHAPES, limit=1 << 20, hint="hint")
    assert np.array_equal(found["n"].read(0, 5), n)
    assert np.array_equal(found["x"].read(0, 3), x)


@pytest.mark.parametrize(
    "arrays",
    [
        {"n": np.arange(3)},
        {"n": np.arange(3.0), "x": np.zeros((3, 2))},
        {"n": np.arange(3), "x": np.zeros((3, 3))},
        {"n": np.arange(3), "x": np.zeros(6)},
        {"n": np.arange(3), "x": np.array([["a", "b"]])},
        {"n": np.arange(3), "x": np.array([[{}, 1]], dtype=object)},
    ],
)
def test_other_arrays_than_declared_are_refused(
    arrays: dict[str, np.ndarray], tmp_path: Path
) -> None:
    with pytest.raises(UnreadableInput):
        read_npz(archive(tmp_path, **arrays), SHAPES, limit=1 << 20, hint="hint")


def test_every_damaged_archive_is_one_line(tmp_path: Path) -> None:
    whole = archive(tmp_path, n=np.arange(50), x=np.zeros((50, 2))).read_bytes()
    rng, lines = np.random.default_rng(3), list[str]()
    for k in range(400):
        data = bytearray(whole)
        if k % 4 == 0:
            data = data[: rng.integers(len(data))]
        for _ in range(rng.integers(1, 5)):
            if data:
                data[rng.integers(len(data))] = rng.integers(256)
        path = tmp_path / "damaged.npz"
        path.write_bytes(data)
        try:
            read_npz(path, SHAPES, limit=1 << 20, hint="hint")
        except UnreadableInput as error:
            lines.append(str(error))
    assert len(lines) > 100
    assert not any("\n" in line for line in lines)


def test_an_archive_that_declares_too_much_is_refused(tmp_path: Path) -> None:
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000, 2), }\n"
    member = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(64)
    for name, data in (("x.npy", member), ("x.npy", bytes(200 << 20))):
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as zipped:
            zipped.writestr("n.npy", b"")
            zipped.writestr(name, data)
        path = tmp_path / "a.npz"
        path.write_bytes(buffer.getvalue())
        with pytest.raises(UnreadableInput):
            read_npz(path, {"x": SHAPES["x"]}, limit=1 << 30, hint="hint")


@pytest.mark.parametrize(
    "text", ["NaN", "1e999", "9" * 400, '"\\ud800"', "[" * 100_000, "{", b"\xff", '{"\\udc00": 1}']
)
def test_json_that_this_program_cannot_use(text: str | bytes) -> None:
    with pytest.raises(UnreadableInput):
        parse_json(text, where="a.json", hint="hint")


def test_json_comes_back_as_it_was_written() -> None:
    value = {"a": [1, -2.5, None, True, "ä", 2**63], "b": {}}
    assert parse_json(json.dumps(value), where="a.json", hint="hint") == value
