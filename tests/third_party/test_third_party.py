"""A stranger's plugin from a separate pip package, and a broken one that harms nobody."""

import json

import pytest

SHORT = (
    "dataset.duration_s=3",
    "dataset.standstill_s=0",
    "rig=blind",
    "frontend=none",
    "vo=none",
    "init=groundtruth",
    "tracker=none",
)


def test_strangers_fuser_runs_like_one_of_ours(install, cli, tmp_path):
    done = cli("fuser=acme", "fuser.damping=0.0", *SHORT, "hydra.run.dir=out", sites=(install("acme"),))
    assert done.returncode == 0, done.stderr
    row = json.loads((tmp_path / "out" / "metrics.json").read_text())["sequences"][0]
    assert row["completion"] == pytest.approx(1.0, abs=0.1)
    assert row["ate_se3_m"] < 0.2


def test_strangers_component_passes_the_conformance_checks(install, monkeypatch):
    monkeypatch.syspath_prepend(install("acme"))
    from acme_dead_reckoning import AcmeFuser

    from vioframe.testing import check_component

    check_component(AcmeFuser(damping=0.1))


def test_listing_shows_both_and_why_one_does_not_import(install, cli):
    done = cli("task=plugins", sites=(install("acme"), install("broken")))
    assert done.returncode == 0, done.stderr
    assert "acme-dead-reckoning" in done.stdout and "fuser=acme" in done.stdout
    assert "RuntimeError: this plugin needs a licence file" in done.stdout


def test_broken_plugin_harms_nobody_else(install, cli):
    done = cli("fuser=acme", *SHORT, "hydra.run.dir=out", sites=(install("acme"), install("broken")))
    assert done.returncode == 0, done.stderr


def test_choosing_the_broken_plugin_says_which_and_why(install, cli):
    done = cli("fuser=broken", *SHORT, sites=(install("broken"),))
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "broken_plugin (distribution broken-plugin" in done.stderr and "licence file" in done.stderr


def test_two_plugins_with_one_name_are_refused(install, cli, tmp_path):
    twin = tmp_path / "twin"
    (twin / "acme_twin" / "conf" / "fuser").mkdir(parents=True)
    (twin / "acme_twin" / "__init__.py").write_text("")
    (twin / "acme_twin" / "conf" / "fuser" / "acme.yaml").write_text("_target_: acme_twin.Fuser\n")
    info = twin / "acme_twin-2.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-twin\nVersion: 2.0\n")
    (info / "entry_points.txt").write_text("[vioframe.plugins]\ntwin = acme_twin\n")
    done = cli("fuser=acme", sites=(install("acme"), twin))
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "fuser=acme is offered twice" in done.stderr
    assert "acme-dead-reckoning" in done.stderr and "acme-twin" in done.stderr
