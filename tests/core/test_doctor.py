"""The doctor: what it finds, what it prints, and when it is not satisfied."""

import io
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from vioframe.data.recording import Dataset, Finding, Recording
from vioframe.errors import DataError
from vioframe.tasks.doctor import diagnose, format_findings, has_bad
from vioframe.types import Frame, ImuBlock, ImuNoise, Packet, SensorRig


class Ward(Recording):
    name = "ward"

    def __init__(self, stamps_ns: Sequence[int], corrupt: int = 0) -> None:
        self.stamps_ns = stamps_ns
        self.corrupt = corrupt

    @property
    def rig(self) -> SensorRig:
        return SensorRig(
            cameras=(),
            imu=ImuNoise(gyro_noise=1e-4, gyro_walk=1e-5, accel_noise=1e-3, accel_walk=1e-4, rate_hz=100.0),
        )

    @property
    def frame_count(self) -> int:
        return len(self.stamps_ns)

    @property
    def duration_s(self) -> float:
        return 1.0

    def packets(self) -> Iterator[Packet]:
        for stamp in self.stamps_ns:
            yield ImuBlock(
                stamps_ns=np.array([stamp - 1, stamp + 1]), gyro=np.zeros((2, 3)), accel=np.full((2, 3), 5.0)
            )
            yield Frame(stamp_ns=stamp)

    def findings(self) -> list[Finding]:
        return [Finding(level="good", subject="pulse", text="regular [60]")]

    def counters(self) -> Mapping[str, int]:
        return {"corrupt images": self.corrupt, "missing images": 0}


class Hospital(Dataset):
    def __init__(self, wards: Mapping[str, Ward | DataError]) -> None:
        self.wards = wards

    @property
    def sequences(self) -> Sequence[str]:
        return list(self.wards)

    def open(self, sequence: str) -> Recording:
        ward = self.wards[sequence]
        if isinstance(ward, DataError):
            raise ward
        return ward


def printed(diagnoses: list[tuple[str, list[Finding]]]) -> str:
    from rich.console import Console

    target = io.StringIO()
    format_findings(diagnoses, Console(file=target, width=120))
    return target.getvalue()


def test_a_broken_sequence_is_a_bad_finding_and_the_others_go_on() -> None:
    dataset = Hospital({"first": DataError("data.csv:7: NaN [row]: remove it"), "second": Ward([10, 20, 30])})
    diagnoses = diagnose(dataset)
    assert [name for name, _ in diagnoses] == ["first", "second"]
    assert [(f.level, f.text) for f in diagnoses[0][1]] == [("bad", "data.csv:7: NaN [row]: remove it")]
    assert all(f.level == "good" for f in diagnoses[1][1])
    assert has_bad(diagnoses) and not has_bad(diagnoses[1:])
    text = printed(diagnoses)
    # Square brackets are text, not markup.
    assert "data.csv:7: NaN [row]: remove it" in text and "regular [60]" in text
    assert "2 sequences: 1 bad, 0 to note, 2 good" in text


def test_it_reads_the_recording_through() -> None:
    ((_, findings),) = diagnose(Hospital({"ward": Ward([10, 20, 30])}))
    assert ("reading", "3 of 3 frames and 6 IMU samples") in [(f.subject, f.text) for f in findings]


def test_corrupt_images_are_bad() -> None:
    diagnoses = diagnose(Hospital({"ward": Ward([10, 20, 30], corrupt=2)}))
    (bad,) = [f for f in diagnoses[0][1] if f.level == "bad"]
    assert bad.subject == "corrupt images" and bad.text.startswith("2")


def test_packets_out_of_order_are_bad() -> None:
    diagnoses = diagnose(Hospital({"ward": Ward([10, 30, 20])}))
    (bad,) = [f for f in diagnoses[0][1] if f.level == "bad"]
    assert bad.subject == "order of packets" and bad.text.startswith("2 packets")


def test_a_recording_that_breaks_while_read_is_bad(monkeypatch: pytest.MonkeyPatch) -> None:
    ward = Ward([10, 20])

    def broken() -> Iterator[Packet]:
        yield Frame(stamp_ns=1)
        raise DataError("image_7.png: gone")

    monkeypatch.setattr(ward, "packets", broken)
    diagnoses = diagnose(Hospital({"ward": ward}))
    assert has_bad(diagnoses) and "image_7.png: gone" in printed(diagnoses)


def test_reading_stops_when_the_time_is_up() -> None:
    ((_, findings),) = diagnose(Hospital({"ward": Ward(list(range(10, 100_000, 10)))}), reading_s=0.01)
    (reading,) = [f for f in findings if f.subject == "reading"]
    assert "the rest was not looked at" in reading.text
    ((_, opened_only),) = diagnose(Hospital({"ward": Ward([10, 20])}), reading_s=0.0)
    assert [f.subject for f in opened_only] == ["pulse"]


def test_what_is_bad_comes_first() -> None:
    findings = [
        Finding(level="good", subject="a", text="fine"),
        Finding(level="bad", subject="b", text="broken"),
        Finding(level="note", subject="c", text="odd"),
    ]
    text = printed([("ward", findings)])
    assert text.index("broken") < text.index("odd") < text.index("fine")


def doctor(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "vioframe", "task=doctor", *options],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


def test_a_good_recording_leaves_nothing_behind_and_status_0(tmp_path: Path) -> None:
    done = doctor(tmp_path, "dataset=simulated", "dataset.duration_s=0.5", "rig=blind")
    assert done.returncode == 0, done.stderr
    assert "1 sequence: 0 bad" in done.stdout
    assert not list(tmp_path.iterdir())


def test_a_folder_without_recordings_is_one_sentence_and_status_1(tmp_path: Path) -> None:
    done = doctor(tmp_path, "dataset=euroc", "dataset.root=.")
    assert done.returncode == 1
    (sentence,) = done.stderr.splitlines()
    assert sentence.startswith("ERROR: .: no sequence here") and "dataset.root" in sentence
    assert not list(tmp_path.iterdir())
