"""From a scenario to a log that can be replayed: simulated ones are recorded, data of others are
checked and brought into a form that the program reads.

What is made is kept in a folder under a name with the hash of its content, so that it is made once.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import avsreplay
from avsreplay import toml_document
from avsreplay.benchmark.prepared import Prepared
from avsreplay.benchmark.real import READERS, used_files
from avsreplay.benchmark.suite import Suite, SuiteScenario
from avsreplay.errors import UnreadableInput
from avsreplay.files import output_folder, output_path
from avsreplay.log import SourceOptions
from avsreplay.record import RecordOptions, record_scenario
from avsreplay.simulate.scenario import scenario_of

DIGEST = 12  # hexadecimal digits in the name of what is made


def prepare(
    suite: Suite, scenario: SuiteScenario, seed: int, repeat: int, folder: Path, data: Path
) -> Prepared:
    """Return a scenario with its log.

    Args:
        suite: the suite.
        scenario: one of its scenarios.
        seed: of everything that is drawn.
        repeat: number of the motion, from 0.
        folder: where logs are kept.
        data: folder of the recordings of others.

    Raises:
        UnreadableInput: the log cannot be written.
    """
    if scenario.data:
        return _real(suite, scenario, seed, repeat, folder, data)
    return _simulated(suite, scenario, seed, repeat, folder)


def _simulated(
    suite: Suite, scenario: SuiteScenario, seed: int, repeat: int, folder: Path
) -> Prepared:
    text = suite.scenario_text(scenario, seed, repeat)
    models = _models(suite, folder)
    digest = _digest([avsreplay.__version__, suite.sha256, text])
    log = folder / f"{scenario.name}-{digest[:DIGEST]}.mcap"
    params = scenario_of(toml_document.parse(text, scenario.name), folder=models)
    if not log.exists():
        with output_path(log) as part:
            record_scenario(params, part, RecordOptions(overwrite=True))
    model = models / f"{scenario.model or scenario.body}.obj"
    scaled = bool(scenario.model) or scenario.model_scale != 1.0
    given = SourceOptions(model=model, model_scale=scenario.model_scale)
    return Prepared(
        scenario.name,
        scenario.group,
        repeat,
        str(log),
        digest,
        given if scaled else SourceOptions(),
        pushes_s=tuple(push.at_s for push in params.params.motion.push),
        loaded=bool(params.params.motion.load),
    )


def _models(suite: Suite, folder: Path) -> Path:
    """The folder with the meshes of the suite."""
    place = folder / f"bodies-{suite.sha256[:DIGEST]}"
    if not place.exists():
        with output_folder(place) as part:
            for body in suite.bodies.iterdir():
                (part / body.name).write_bytes(body.read_bytes())
    return place


def _real(
    suite: Suite, scenario: SuiteScenario, seed: int, repeat: int, folder: Path, data: Path
) -> Prepared:
    found = suite.data_of(scenario)
    home = data / found.name
    known = Prepared(scenario.name, scenario.group, repeat)
    files = used_files(found.name, home)
    if not files:
        return _without(known, "not available")
    if (digest := files_digest(home, files)) != found.sha256:
        return _without(known, f"other files than those of the suite (sha256 {digest[:DIGEST]})")
    place = folder / f"{scenario.name}-{digest[:DIGEST]}-{seed}-{repeat}"
    return READERS[found.name](known, home, place, seed, digest)


def _without(known: Prepared, why: str) -> Prepared:
    return replace(known, missing=why)


def files_digest(home: Path, files: list[Path]) -> str:
    """Return one hash of some files and their names.

    Args:
        home: folder to which the names are relative.
        files: the files.

    Raises:
        UnreadableInput: a file cannot be read.
    """
    try:
        sums = {
            file.relative_to(home).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
            for file in files
        }
    except OSError as error:
        raise UnreadableInput(
            error.strerror or "cannot be read", where=str(home), hint="check the folder"
        ) from None
    return _digest(sorted(sums.items()))


def _digest(content: object) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()
