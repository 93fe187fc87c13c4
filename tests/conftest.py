"""Fixtures that several test folders share."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

THIRD_PARTY = Path(__file__).parent / "third_party"


@pytest.fixture(scope="session")
def install(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Install a package of ``tests/third_party`` with pip into a folder of its own; gives the folder."""
    done: dict[str, Path] = {}

    def run(name: str) -> Path:
        if name not in done:
            source = tmp_path_factory.mktemp(f"source_{name}") / name
            shutil.copytree(THIRD_PARTY / name, source)
            target = tmp_path_factory.mktemp(f"site_{name}")
            command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
            subprocess.run([*command, "--target", str(target), str(source)], check=True, capture_output=True)
            done[name] = target
        return done[name]

    return run


@pytest.fixture
def cli(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run ``python -m vioframe`` from an empty folder, with extra folders on the import path."""

    def run(*arguments: str, sites: tuple[Path, ...] = (), timeout: float = 240.0, **environment: str):
        path = os.pathsep.join([*map(str, sites), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
        return subprocess.run(
            [sys.executable, "-m", "vioframe", *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": path, "COLUMNS": "160", **environment},
            capture_output=True,
            text=True,
            timeout=timeout,
        )

    return run
