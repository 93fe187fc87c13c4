"""What ``task=matrix`` tries beside every combination of parts."""

from composing import composer
from vioframe.tasks.matrix import Combination, enumerate_choices, enumerate_variations

CHOICES = {"synchronizer": "interpolate", "frontend": "klt", "vo": "none", "integrator": "preintegration"}


def test_every_combination_of_the_five_slots_is_tried_once():
    tried = [tuple(sorted(choices.items())) for choices in enumerate_choices()]
    assert len(tried) == len(set(tried))
    assert tuple(sorted({**CHOICES, "fuser": "window"}.items())) in tried


def test_cameras_and_further_groups_are_varied_where_something_ran():
    ran = [Combination(choices={**CHOICES, "fuser": fuser}, outcome="ran") for fuser in ("window", "msckf")]
    again = Combination(choices={**CHOICES, "fuser": "window", "synchronizer": "nearest"}, outcome="ran")
    refused = Combination(choices={**CHOICES, "fuser": "ekf"}, outcome="refused")
    with composer():
        varied = list(enumerate_variations([*ran, again, refused]))
    told = {(one["fuser"], *(f"{k}={v}" for k, v in one.items() if k in ("rig", "loop"))) for one in varied}
    rigs = {(fuser, f"rig={rig}") for fuser in ("window", "msckf") for rig in ("mono", "blind")}
    assert told == {*rigs, ("window", "loop=bow")}
    assert len(varied) == len(told)
