"""Discovery without importing, clashes by name, a broken plugin that harms nobody."""

from pathlib import Path

import pytest

from vioframe.errors import PluginError
from vioframe.plugins import PluginPackage, core_conf, discover, refuse_clashes


def package(name: str, *options: str) -> PluginPackage:
    return PluginPackage(
        name=name, package=name, distribution=f"{name}-dist", version="1", folder=Path("/site") / name, options=options
    )


def test_ours_are_found_by_entry_point():
    names = {found.package for found in discover()}
    assert {"vioframe_klt", "vioframe_msf", "vioframe_recordings"} <= names
    assert all(found.conf is not None for found in discover() if found.distribution == "vioframe")


def test_two_offers_of_one_option_are_refused_by_name_and_distribution():
    with pytest.raises(PluginError) as caught:
        refuse_clashes([package("acme", "fuser/fast"), package("zeta", "fuser/fast")], core_conf())
    message = str(caught.value)
    assert "fuser=fast is offered twice" in message
    assert "acme-dist" in message and "zeta-dist" in message


def test_an_option_of_the_core_cannot_be_taken():
    with pytest.raises(PluginError, match="vioframe itself"):
        refuse_clashes([package("acme", "vo/none")], core_conf())


def test_different_groups_may_share_a_name():
    refuse_clashes([package("acme", "fuser/fast"), package("zeta", "vo/fast")], core_conf())
