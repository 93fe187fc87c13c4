"""Where the real recordings are; tests that need one skip with a reason where it is missing."""

import os
from pathlib import Path

import pytest


def shared_data(*parts: str) -> Path:
    """Path of a real recording: under ``VIOFRAME_SHARED_DATA``, or ``../shared/data`` beside the checkout."""
    root = Path(os.environ.get("VIOFRAME_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data"))
    path = root.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"real recording {path} is not here (set VIOFRAME_SHARED_DATA)")
    return path
