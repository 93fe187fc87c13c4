"""Every discovered component keeps the promises of its interface."""

import pytest

from composing import built, offered
from vioframe.pipeline import SLOTS
from vioframe.testing import check_component

# A net keeps the same promises when it is small, in a tenth of the time.
SMALLER = {
    "tsvo": ("backbone=googlenet", "vo.stack=3", "vo.size_px=[160,96]", "vo.width=0.125"),
    "superpoint": ("frontend.weights=null", "encoder=mobilenetv2", "encoder.width=0.25"),
    "pair_encoder": ("frontend.size_px=[160,96]", "frontend.width=0.125"),
    "deepvo": ("vo.size_px=[160,96]", "vo.width=0.125", "vo.hidden=32"),
}
PARTS = [(slot, name) for slot in SLOTS for name in offered(slot) if name != "none"]


@pytest.mark.parametrize(("slot", "name"), PARTS, ids=lambda value: str(value))
def test_component_keeps_its_contract(slot, name):
    check_component(built(slot, name, *SMALLER.get(name, ())))
