"""What a study runs, and what it refuses."""

import pytest
from hydra.errors import ConfigCompositionException

from composing import composed, offered
from vioframe.build import build
from vioframe.errors import ConfigError
from vioframe.study import Study
from vioframe.study.plan import Cell


def study(*overrides: str, name: str = "time_offset") -> Study:
    return build(composed(f"study={name}", *overrides), "study", Study)


@pytest.mark.parametrize("name", [name for name in offered("study") if name != "custom"])
def test_every_study_builds_sets_the_task_and_varies_an_option_that_exists(name):
    config = composed(f"study={name}")
    assert config.task.name == "study"
    plan = build(config, "study", Study)
    assert plan.name == name
    assert plan.reference in plan.all_values()
    if plan.conditions:
        assert plan.conditions[plan.reference] == []
        return
    # The fault's own default is what nothing is wrong with.
    node = composed("faults=default")
    for part in plan.key.split("."):
        node = node[part]
    assert node == plan.reference


def test_cells_are_the_product_seed_by_seed():
    plan = study("study.chosen=[msf,ekf]", "study.values=[0.01,-0.01]", "study.seeds=[3,1]")
    cells = plan.cells()
    assert len(set(cells)) == len(cells) == 2 * 3 * 2
    assert [cell.seed for cell in cells] == [3] * 6 + [1] * 6
    assert cells[:3] == [Cell(variant="msf", value=value, seed=3) for value in (-0.01, 0.0, 0.01)]


def test_values_are_shown_in_the_unit_of_the_axis():
    assert study().shown(-0.005) == "-5"


@pytest.mark.parametrize(
    ("override", "match"),
    [
        ("study.chosen=[ekf,nobody]", r"study\.chosen=.*nobody.* must name variants: ekf"),
        ("study.chosen=[]", r"study\.chosen=\[\] must name variants"),
        ("study.values=[]", r"study\.values=\[\] must hold finite numbers"),
        ("study.values=[a]", r"study\.values=\['a'\] must hold finite numbers"),
        ("study.values=[.inf]", r"study\.values=.*must hold finite numbers"),
        ("study.seeds=[]", r"study\.seeds=\[\]"),
        ("study.seeds=[-1]", r"study\.seeds=\[-1\]"),
        ("study.metrics=[]", r"study\.metrics is empty"),
        ("study.tolerance=0", r"study\.tolerance=0"),
        ("study.workers=0", r"study\.workers=0"),
        ("study.variants.ekf=fuser", r"study\.variants=.*list of overrides"),
    ],
)
def test_wrong_options_are_refused_by_name(override, match):
    with pytest.raises(ConfigError, match=match):
        study(override)


def test_misspelt_option_is_refused():
    with pytest.raises(ConfigCompositionException, match="seed"):
        composed("study=jitter", "study.seed=1")
