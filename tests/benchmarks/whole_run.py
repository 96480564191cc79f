"""What a whole run costs beside its registrations: processor time and elapsed time, on one thread
and on several.

python tests/benchmarks/whole_run.py LOG [LOG ...] [--repeats N] [--n-scans N]

Each repeat replays every log twice into a result directory, on one thread and with decoding,
pipeline and writing on threads of their own, in turn; medians of the ratios are printed.
"Registrations" is the processor time inside ``Registrar.register`` and ``Registrar.acquire`` of the
one-thread run. With threads the elapsed time approaches that of ``pipeline.step``, because
decoding, scoring and writing are done meanwhile: step/registrations is the bound. Elapsed times
mean something on an idle machine only.

A log of 600 scans with 10,000 points each is the built-in scenario with more rays:
sed 's/^rays.*/rays = [235, 235]/' avsreplay/simulate/builtin.toml > dense.toml
avsreplay record dense.toml -o dense.mcap
"""

from __future__ import annotations

from avsreplay import arithmetic

if __name__ == "__main__":
    # as the command does: the waiting of OpenBLAS's second thread would count as processor time
    arithmetic.pin()

import argparse
import tempfile
import time
from pathlib import Path
from statistics import median

from avsreplay import pipeline
from avsreplay.log import SourceOptions
from avsreplay.register.registrar import Registrar
from avsreplay.result_dir import ResultDirectory, ResultWriter
from avsreplay.run import Job, Run


def timed(log: Path, n_scans: int | None, prefetch: int) -> tuple[int, float, float, float, float]:
    """Scans; processor and elapsed time of the run [s]; processor time of its registrations
    and of ``step`` [s].
    """
    spent, originals = [0.0], {name: getattr(Registrar, name) for name in ("register", "acquire")}
    depth, chain, step = [0], [0.0], pipeline.step

    def timed_step(*args):
        begun = time.thread_time()
        found = step(*args)
        chain[0] += time.thread_time() - begun
        return found

    def counting(original):
        def counted(self, *args, **named):
            begun = time.thread_time()
            depth[0] += 1
            try:
                return original(self, *args, **named)
            finally:
                depth[0] -= 1
                spent[0] += 0.0 if depth[0] else time.thread_time() - begun

        return counted

    for name, original in originals.items():
        setattr(Registrar, name, counting(original))
    pipeline.step = timed_step
    try:
        job = Job(source=log, options=SourceOptions(n_scans=n_scans), prefetch=prefetch)
        with (
            tempfile.TemporaryDirectory() as folder,
            Run(job) as run,
            ResultWriter(ResultDirectory(Path(folder) / "result"), run) as writer,
        ):
            begun, elapsed = time.process_time(), time.perf_counter()
            rows = list(run.rows(writer.listeners))
            writer.finish({})
            return (
                len(rows),
                time.process_time() - begun,
                time.perf_counter() - elapsed,
                spent[0],
                chain[0],
            )
    finally:
        pipeline.step = step
        for name, original in originals.items():
            setattr(Registrar, name, original)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--n-scans", type=int)
    args = parser.parse_args()
    print("scans  ms/scan  registration  whole/reg  step/reg  threads/one  elapsed/reg  log")
    for log in args.logs:
        timed(log, 3, 0)  # imports
        runs = [
            (timed(log, args.n_scans, 0), timed(log, args.n_scans, 2)) for _ in range(args.repeats)
        ]
        count = runs[0][0][0]
        whole, spent = (1e3 * median(one[k] for one, _ in runs) / count for k in (1, 3))
        ratio = median(one[1] / one[3] for one, _ in runs)
        bound = median(one[4] / one[3] for one, _ in runs)
        threads = median(several[2] / one[2] for one, several in runs)
        elapsed = median(several[2] / one[3] for one, several in runs)
        figures = (
            f"{count:5d} {whole:8.2f} {spent:13.2f} {ratio:10.2f} {bound:9.2f} {threads:12.2f}"
            f" {elapsed:12.2f}"
        )
        print(f"{figures}  {log.name}")


if __name__ == "__main__":
    main()
