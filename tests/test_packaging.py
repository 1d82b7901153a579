"""What is installed: imports stay light, names stay ours, the wheel is complete."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def run_python(code: str, cwd: Path, **environment: str) -> str:
    import os

    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_importing_the_environment_loads_nothing_heavy(tmp_path):
    heavy = ("torch", "cvxpy", "scipy", "piqp", "minari", "h5py", "matplotlib", "pygame")
    code = f"import sys, freeflyer_env; print([name for name in {heavy} if name in sys.modules])"
    assert run_python(code, tmp_path) == "[]"


def test_importing_the_other_packages_is_lazy(tmp_path):
    code = (
        "import sys, art_policy, freeflyer_datasets, art_policy.cli; "
        "print([name for name in ('torch', 'minari', 'h5py', 'cvxpy') if name in sys.modules])"
    )
    assert run_python(code, tmp_path) == "[]"


def test_datasets_is_not_our_name(tmp_path):
    code = "import importlib.util as u; s = u.find_spec('datasets'); print(s and s.origin)"
    assert str(ROOT) not in run_python(code, tmp_path)
    assert not (ROOT / "datasets" / "__init__.py").exists()


def test_the_environment_needs_no_import_of_ours(tmp_path):
    code = (
        "import gymnasium as gym; env = gym.make('freeflyer_env:FreeFlyer-v0'); "
        "print(env.reset(seed=0)[0]['state'].shape)"
    )
    assert run_python(code, tmp_path) == "(6,)"


def test_the_wheel_is_complete_and_works_elsewhere(tmp_path):
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "-o", str(tmp_path), "."]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    target = tmp_path / "site"
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(target)]
    subprocess.run([*install, str(wheel)], check=True, capture_output=True)
    code = (
        "import freeflyer_env, freeflyer_datasets, art_policy\n"
        "from art_policy.model import shipped_models\n"
        "print(freeflyer_env.__file__, freeflyer_datasets.list_recipes(), shipped_models())"
    )
    printed = run_python(code, tmp_path, PYTHONPATH=str(target))
    assert printed.startswith(str(target))
    assert "scene-random-v0" in printed
    assert "art-scene-random" in printed


@pytest.mark.parametrize("name", ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE"])
def test_the_documents_are_there(name):
    assert (ROOT / name).stat().st_size > 200
