"""Every discovered component keeps the promises of its interface."""

import pytest

from composing import composed, offered
from vioframe.build import build
from vioframe.pipeline import SLOTS
from vioframe.testing import check_component

PARTS = [(slot, name) for slot in SLOTS for name in offered(slot) if name != "none"]


@pytest.mark.parametrize(("slot", "name"), PARTS, ids=lambda value: str(value))
def test_component_keeps_its_contract(slot, name):
    check_component(build(composed(f"{slot}={name}"), slot, SLOTS[slot], name))
