"""The same input gives the same bytes: in repeated runs, for any hash seed and any number of
threads.
"""

import filecmp

import pytest

POSES = ("estimate.tum", "registration.tum", "smoothed.tum", "truth.tum")
RESULTS = ("rows.jsonl", *POSES, "beliefs.npz", "result.mcap", "view.npz", "run.json")
ELSEWHERE = {
    "PYTHONHASHSEED": "77",
    "OMP_NUM_THREADS": "4",
    "OPENBLAS_NUM_THREADS": "3",
    "MKL_NUM_THREADS": "2",
}


@pytest.fixture(scope="module")
def once(cli, fixtures_folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("once") / "r"
    assert (
        cli("run", fixtures_folder / "tumble.mcap", "-o", out, env={"PYTHONHASHSEED": "0"}).code
        == 0
    )
    return out


@pytest.mark.parametrize(
    "settings",
    [(), ("--set", "register.threads=2")],
    ids=["other hash seed and libraries' threads", "two threads"],
)
def test_two_runs_give_the_same_bytes(settings, once, cli, fixtures_folder, tmp_path):
    again = tmp_path / "again"
    assert (
        cli("run", fixtures_folder / "tumble.mcap", "-o", again, *settings, env=ELSEWHERE).code == 0
    )
    same = RESULTS[:-1] if settings else RESULTS  # run.json names the thread count
    match, mismatch, errors = filecmp.cmpfiles(once, again, same, shallow=False)
    assert sorted(match) == sorted(same), (mismatch, errors)


def test_json_is_the_same_too(cli, fixtures_folder):
    first = cli("run", fixtures_folder / "spin-raster.mcap", "--json", env={"PYTHONHASHSEED": "1"})
    second = cli("run", fixtures_folder / "spin-raster.mcap", "--json", env=ELSEWHERE)
    assert first.code == 0
    assert first.out == second.out
