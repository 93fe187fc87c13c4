"""Resident memory of a long run: flat after the first minute, or not.

Runs ``python -m vioframe`` with the given overrides, reads the resident size of the process from ``/proc``
every second, and prints it at one minute, at every tenth of the stream, and the growth from the first minute
to the end of the stream. The evaluation that follows needs memory of its own: its peak is told apart.

    python benchmarks/memory.py dataset.duration_s=3600 dataset.camera.rate_hz=5
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

WARM_UP_S = 60.0


def resident_mb(pid: int) -> float:
    """Resident set size of a process, MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "vioframe",
            "tracker=none",
            "progress=false",
            "hydra.run.dir=out",
            *sys.argv[1:],
        ]
        started = time.monotonic()
        process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL)
        samples: list[tuple[float, float]] = []
        peak = 0.0
        written = -1
        while process.poll() is None:
            # The poses go to disk about every second while the stream lasts.
            size = sum(path.stat().st_size for path in (Path(folder) / "out").glob("*.partial.tum"))
            try:
                now = resident_mb(process.pid)
            except (FileNotFoundError, IndexError):
                break
            if size > written or size == 0:
                samples.append((time.monotonic() - started, now))
            written = size
            peak = max(peak, now)
            time.sleep(3.0)
        process.wait()
    if process.returncode:
        print(f"the run failed with status {process.returncode}")
        return 1
    # The file's last growth is its closing, and by then the evaluation has begun.
    warm = [sample for sample in samples[:-1] if sample[0] >= WARM_UP_S]
    if not warm:
        print(f"the stream ended after {samples[-1][0]:.0f} s: make the run longer than {WARM_UP_S:.0f} s")
        return 1
    for index in range(0, len(warm), max(len(warm) // 10, 1)):
        print(f"{warm[index][0]:7.0f} s  {warm[index][1]:7.1f} MB")
    print(f"{warm[-1][0]:7.0f} s  {warm[-1][1]:7.1f} MB")
    growth = warm[-1][1] - warm[0][1]
    print(f"growth after the first minute: {growth:+.1f} MB ({100 * growth / warm[0][1]:+.1f} %)")
    print(f"peak with evaluation and report: {peak:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
