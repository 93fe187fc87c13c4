"""The core names no plugin, plugins name no plugin, and every plugin comes in by the door strangers use."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLUGINS = sorted(path for path in (ROOT / "plugins").glob("vioframe_*") if path.is_dir())
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def imported_roots(path: Path) -> set[str]:
    roots = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            roots |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            roots.add(node.module.partition(".")[0])
    return roots


def test_core_never_names_a_plugin():
    names = [plugin.name for plugin in PLUGINS]
    assert names
    for path in (ROOT / "vioframe").rglob("*.py"):
        text = path.read_text()
        assert not [name for name in names if re.search(rf"\b{name}\b", text)], path


@pytest.mark.parametrize("plugin", PLUGINS, ids=lambda plugin: plugin.name)
def test_plugin_imports_no_other_plugin(plugin: Path):
    others = {other.name for other in PLUGINS} - {plugin.name}
    for path in plugin.rglob("*.py"):
        assert not imported_roots(path) & others, path


@pytest.mark.parametrize("plugin", PLUGINS, ids=lambda plugin: plugin.name)
def test_plugin_is_an_entry_point_with_a_readme_and_a_config(plugin: Path):
    assert plugin.name in PROJECT["project"]["entry-points"]["vioframe.plugins"].values()
    assert (plugin / "README.md").read_text().strip()
    assert list((plugin / "conf").rglob("*.yaml"))


def test_plugins_folder_is_a_source_root_and_no_package():
    assert not (ROOT / "plugins" / "__init__.py").exists()


def test_every_package_is_shipped():
    shipped = set(PROJECT["tool"]["setuptools"]["packages"])
    present = {
        ".".join(path.parent.relative_to(root).parts)
        for root, pattern in ((ROOT, "vioframe/**/__init__.py"), (ROOT / "plugins", "*/**/__init__.py"))
        for path in root.glob(pattern)
    }
    assert present <= shipped, f"missing in pyproject.toml: {sorted(present - shipped)}"
    assert "vioframe.conf" in shipped


@pytest.mark.parametrize("folder", ["vioframe", "plugins"])
def test_heavy_libraries_are_imported_where_they_are_needed(folder: str):
    """At module level they would cost every ``--help`` a second or more."""
    heavy = {"mlflow", "matplotlib", "scipy", "rich", "torch", "lightning", "pandas", "rosbags", "rerun"}
    learned = {"torch", "lightning", "safetensors"}
    for path in (ROOT / folder).rglob("*.py"):
        # What works on tensors is imported when a net is; test_packages_import_no_torch holds that.
        tensors = path.name != "__init__.py" and (folder == "plugins" or "learning" in path.parts)
        forbidden = heavy - learned if tensors else heavy | learned
        for node in ast.parse(path.read_text()).body:
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            assert not [name for name in names if name.partition(".")[0] in forbidden], f"{path}:{node.lineno}"


@pytest.mark.parametrize("package", [*(plugin.name for plugin in PLUGINS), "vioframe.interfaces", "vioframe.learning"])
def test_packages_import_no_torch(package: str):
    """A component's module may be imported by ``task=plugins`` and by a pipeline that never runs a net."""
    check = f"import sys, {package}; sys.exit(bool({{'torch', 'lightning', 'safetensors'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr or f"{package} imports torch"
